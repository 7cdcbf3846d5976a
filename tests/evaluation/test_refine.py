from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.core.capture import Clock, Split
from sharpfield.core.errors import OptionError
from sharpfield.evaluation.options import Refinement
from sharpfield.evaluation.refine import aligned_poses, refine_poses, training_pose_errors
from sharpfield.geometry import se3
from sharpfield.geometry.normalise import moved
from sharpfield.geometry.space import Similarity
from sharpfield.geometry.trajectory import Stamped
from tests.evaluation.fake import Sky, capture

TEST = (0, 4)
QUICK = Refinement(steps=40, pixels=200, rate=1e-3, every=20)


def own_poses(scene):
    """By frame."""
    return dict(zip(TEST, scene.frame_pose(np.array(TEST)), strict=True))


def turned(pose, by):
    """A pose turned by so many rad about each axis of its camera."""
    return se3.compose(pose, se3.exp(torch.tensor([*by, 0.0, 0.0, 0.0])))


def angle(one, other):
    return se3.log(se3.compose(se3.inverse(one), other))[:3].norm()


@pytest.fixture(scope="module")
def refined():
    model = Sky(capture())
    start = {f: turned(pose, (0.02, -0.01, 0.015)) for f, pose in own_poses(capture()).items()}
    return model, start, refine_poses(model, capture(), options=QUICK, start=start)


def test_poses_come_back_to_where_the_images_were_taken(refined):
    _, start, found = refined
    for frame, truth in own_poses(capture()).items():
        assert angle(start[frame], truth) > 0.025
        assert angle(found.poses[frame], truth) < 0.005
        assert found.after[frame] > found.before[frame] + 6


def test_the_model_is_left_as_it_was(refined):
    model, _, _ = refined
    assert model.gain == 1.0
    assert model.gain.requires_grad
    assert model.gain.grad is None


def test_the_choice_is_stated(refined):
    _, _, found = refined
    stated = found.protocol["pose_refinement"]
    assert "optimistic" in stated["chosen"]
    assert (stated["steps"], stated["pixels"], stated["rate"]) == (40, 200, 1e-3)


def test_it_never_ends_below_where_it_began():
    """At the true pose with a wild rate, every step makes things worse."""
    wild = Refinement(steps=4, pixels=50, rate=0.3, every=2)
    found = refine_poses(Sky(capture()), capture(), options=wild)
    assert found.after == found.before
    for frame, truth in own_poses(capture()).items():
        torch.testing.assert_close(found.poses[frame], truth)


def test_a_model_in_colour_is_refined_against_grey_frames():
    one = capture()
    frames = one.needed_frames
    middle = {"images": frames.images[..., 1:2], "truth": frames.truth[..., 1:2]}
    grey = replace(one, frames=replace(frames, **middle))
    found = refine_poses(Sky(grey), grey, options=replace(QUICK, steps=2, every=1))
    assert all(found.after[frame] >= found.before[frame] > 5 for frame in TEST)


def test_without_full_renders_the_last_pose_is_taken():
    model = Sky(capture())
    blind = replace(QUICK, every=0, steps=3)
    found = refine_poses(model, capture(), options=blind)
    assert found.before == found.after == {}
    assert angle(found.poses[4], own_poses(capture())[4]) > 1e-4
    assert found.protocol["pose_refinement"]["chosen"] == "pose after the last step"


def test_the_gradient_does_not_depend_on_how_many_rays_fit():
    whole = refine_poses(Sky(capture()), capture(), options=replace(QUICK, steps=3, every=0))
    parts = refine_poses(
        Sky(capture()), capture(), options=replace(QUICK, steps=3, every=0, rays=64)
    )
    for frame in TEST:
        torch.testing.assert_close(parts.poses[frame], whole.poses[frame], atol=1e-5, rtol=0)


def test_the_seed_decides():
    short = replace(QUICK, steps=5, every=0)
    one, same, other = (
        refine_poses(Sky(capture()), capture(), options=short, seed=seed).poses[4]
        for seed in (1, 1, 2)
    )
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


def test_views_far_off_draw_pixels_where_the_error_is(monkeypatch):
    seen = []
    model = Sky(capture())
    render = model.render
    monkeypatch.setattr(model, "render", lambda rays: (seen.append(len(rays)), render(rays))[1])
    start = {4: turned(own_poses(capture())[4], (0.3, 0.2, 0.0))}
    hard = replace(QUICK, steps=20, every=20, hard_psnr=50.0)
    found = refine_poses(model, capture(), options=hard, start=start)
    assert seen.count(200) == 2 * 20  # two views
    assert found.after[4] > found.before[4]


def test_progress_is_told():
    told = []
    short = replace(QUICK, steps=3, every=0)
    refine_poses(
        Sky(capture()), capture(), options=short, progress=lambda *state: told.append(state)
    )
    assert told == [(1, 3), (2, 3), (3, 3)]


def elsewhere(scene):
    """The scene in another world."""
    about, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    about *= np.sign(np.linalg.det(about))
    return moved(scene, Similarity(2.5, about, np.array([1.0, -2.0, 3.0])))


def test_a_similarity_takes_measured_poses_to_the_space_of_the_model():
    scene = capture()
    model = Sky(elsewhere(scene))
    found = aligned_poses(model, scene)
    for frame, expected in own_poses(model.capture).items():
        torch.testing.assert_close(found[frame], expected, atol=1e-4, rtol=0)


def on_a_slider():
    """The scene with its cameras on a line."""
    scene = capture()
    poses = scene.trajectory.poses.copy()
    poses[:, 1:, 3] = 0
    return replace(scene, trajectory=Stamped(scene.trajectory.times_us, poses, Clock(0, 1_000_000)))


def test_cameras_on_a_line_fix_no_similarity():
    scene = on_a_slider()
    model = Sky(elsewhere(scene))
    found = aligned_poses(model, scene)
    for frame, expected in own_poses(model.capture).items():
        torch.testing.assert_close(found[frame], expected)


def test_what_cannot_be_refined():
    with pytest.raises(OptionError, match="a model of events alone"):
        refine_poses(Sky(capture().without(frames=True)), capture())
    nothing = replace(capture(), split=Split(np.arange(6), np.zeros(0, np.int64)))
    with pytest.raises(OptionError, match="no frame is held out"):
        refine_poses(Sky(nothing), nothing)


def test_refined_training_poses_are_compared_with_the_captures():
    still = capture()
    assert training_pose_errors(Sky(still), still) is None, "poses that did not move"
    rng = np.random.default_rng(0)
    poses = still.trajectory.poses.copy()
    poses[:, :, 3] += 0.01 * rng.standard_normal((len(poses), 3))
    moved = replace(still, trajectory=Stamped(still.trajectory.times_us, poses, still.clock))
    found = training_pose_errors(Sky(moved), still)
    assert found is not None and found["frames"] == len(still.split.train)
    assert 0.001 < found["absolute"]["translation"] < 0.03
    assert found["relative"]["rotation_deg"] >= 0


def test_another_world_is_no_error():
    still = capture()
    doubled = still.trajectory.poses * np.array([1, 1, 1, 2.0])
    other = replace(still, trajectory=Stamped(still.trajectory.times_us, doubled, still.clock))
    assert training_pose_errors(Sky(other), still) is None
