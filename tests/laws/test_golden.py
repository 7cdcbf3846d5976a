"""Numbers computed once, independently, in float64: whoever changes one has changed the method."""

import pytest
import torch

from sharpfield.core.seed import generator
from sharpfield.formation.events import LogContrast
from sharpfield.formation.ray_kernels import RigidMotions
from sharpfield.formation.response import FixedResponse, LearnedResponse
from sharpfield.geometry import se3
from sharpfield.losses.events import contrast_error
from tests.formation.toy import CAMERA, lit, pairs, still


def test_a_small_rigid_motion():
    twist = torch.tensor([0.01, -0.02, 0.03, 0.1, 0.0, -0.05], dtype=torch.float64)
    motion = se3.exp(twist)
    assert motion[:, 3].tolist() == pytest.approx([0.10047578, 0.00175146, -0.04899095], abs=1e-8)
    row = [0.99935008, -0.03009299, -0.01984535]
    assert motion[0, :3].tolist() == pytest.approx(row, abs=1e-8)


def test_a_motion_without_rotation():
    motion = se3.exp(torch.tensor([0, 0, 0, 0.1, 0.2, 0.3], dtype=torch.float64))
    assert torch.equal(motion[:, :3], torch.eye(3, dtype=torch.float64))
    assert motion[:, 3].tolist() == pytest.approx([0.1, 0.2, 0.3])


def test_a_grey_pixel_that_brightens():
    light = torch.tensor([[[0.2] * 3, [0.25] * 3]], dtype=torch.float64)
    weight = torch.tensor([[-1.0, 1.0]], dtype=torch.float64)
    contrast = LogContrast(CAMERA, still(), FixedResponse())
    change = contrast.observe(lit(light, weight), pairs(1))
    assert change.item() == pytest.approx(0.223134, abs=5e-7)
    loss = contrast_error(change, torch.tensor([0.2], dtype=torch.float64))
    assert loss.item() == pytest.approx(5.35e-4, abs=5e-7)


@pytest.mark.parametrize(
    ("network", "parameters"),
    [
        (lambda: RigidMotions(0, generator=generator(0, 0, "golden")), 5280),
        (lambda: RigidMotions(1, generator=generator(0, 0, "golden")), 5280 + 32),
        (lambda: LearnedResponse(steps=1), 625),
    ],
)
def test_parameters(network, parameters):
    assert sum(p.numel() for p in network().parameters()) == parameters
