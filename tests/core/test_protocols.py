import numpy as np
import torch

from sharpfield.core.protocols import Field, Head, Renderer, Trajectory
from sharpfield.core.seed import generator
from sharpfield.fields.mlp import MLPField
from sharpfield.geometry.space import EvenDepth, Similarity
from sharpfield.geometry.trajectory import BSpline, LearnedKnots, Moved, Stamped, Still, Tracks
from sharpfield.rendering.coarse_to_fine import CoarseToFine
from tests.core.test_capture import CLOCK, Rail, capture

POSES = np.eye(3, 4)[None]


def test_trajectories():
    still = Still(POSES)
    same = Similarity(1.0, np.eye(3), np.zeros(3))
    paths = [
        Rail(),
        still,
        Stamped(np.zeros(1, np.int64), POSES, CLOCK),
        Tracks([], POSES),
        BSpline(torch.eye(3, 4).expand(4, 3, 4), 0, 1, CLOCK),
        LearnedKnots(still, knots=4),
        Moved(still, same),
    ]
    assert all(isinstance(path, Trajectory) for path in paths)


def test_fields_heads_and_renderers():
    field = MLPField(generator=generator(0, 0, "field"), width=4, depth=2)
    made = capture()
    assert isinstance(field, Field) and isinstance(field.coarse, Head)
    assert isinstance(CoarseToFine(field, EvenDepth(made.camera, 1.0, 2.0)), Renderer)


def test_others_do_not_pass():
    assert not isinstance(torch.nn.Linear(1, 1), Trajectory | Field | Head)
