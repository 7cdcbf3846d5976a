import numpy as np
import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.core.rays import Rays
from sharpfield.geometry import se3
from sharpfield.geometry.space import (
    EvenDepth,
    Frustum,
    Similarity,
    average_pose,
    forward_facing,
    ndc,
    normalisation,
)
from sharpfield.ops.grid import grid_shape
from tests.geometry.toy import points, poses

DAVIS = Camera(346, 260, 450.0020724445828, 450.0020724445828, 173.0, 130.0)
"""The camera of Ev-DeblurCDAVIS."""


def ahead(count: int) -> Rays:
    """Float64 rays of cameras near the origin that look forward."""
    origin = 0.2 * points(count)
    sideways = 0.3 * points(2, count)[1]
    direction = torch.nn.functional.normalize(sideways + sideways.new_tensor([0, 0, 1.5]), dim=-1)
    ones = torch.ones(count, dtype=torch.float64)
    return Rays(origin, direction, ones, ones)


def test_ndc_golden():
    """The published convention has y up and looks along -z; ours is its mirror image."""
    xy = torch.tensor([100.5, 50.5], dtype=torch.float64)
    seen = DAVIS.direction(xy)
    seen = seen / seen[2]
    assert seen.tolist() == pytest.approx([-0.16111037, -0.17666585, 1], abs=1e-8)
    start, toward = ndc(torch.tensor([0.05, 0.02, -0.01], dtype=torch.float64), seen, DAVIS)
    assert start.tolist() == pytest.approx([-0.29320749, -0.54842276, -1], abs=1e-8)
    assert toward.tolist() == pytest.approx([-0.12586765, -0.06311570, 2], abs=1e-8)


def test_box_and_grids_golden():
    both = torch.eye(3, 4, dtype=torch.float64).repeat(2, 1, 1)
    both[:, 0, 3] = torch.tensor([-0.3, 0.3], dtype=torch.float64)
    low, high = box = Frustum(DAVIS).box(both)
    assert low.tolist() == pytest.approx([-1.79035041, -1.01, -1.0001], abs=1e-8)
    assert high.tolist() == pytest.approx([1.78457007, 1.00230769, 1.0001], abs=1e-8)
    assert grid_shape(box, 16_777_248) == (376, 211, 210)
    assert grid_shape(box, 134_217_984) == (752, 423, 421)


def test_a_ray_in_ndc_is_the_ray():
    """Each point of the warped ray is the projection of the world's point at that depth."""
    rays, space = ahead(50), Frustum(DAVIS)
    start, toward = space.warp(rays)
    for z in (0.0, 0.3, 0.9):
        depth = space.depth(torch.full((50,), z, dtype=torch.float64))
        torch.testing.assert_close(depth, torch.full_like(depth, 1 / (1 - z)))
        reach = (depth - rays.origin[:, 2]) / rays.direction[:, 2]
        world = rays.origin + reach[:, None] * rays.direction
        xy = DAVIS.project(world)
        wanted = torch.stack([xy[:, 0] / 173 - 1, xy[:, 1] / 130 - 1, 1 - 2 / depth], -1)
        torch.testing.assert_close(start + z * toward, wanted)


def test_ndc_sees_neither_length_nor_start_of_a_ray():
    rays = ahead(20)
    wanted = ndc(rays.origin, rays.direction, DAVIS)
    found = ndc(rays.origin + 0.7 * rays.direction, 3 * rays.direction, DAVIS)
    torch.testing.assert_close(found, wanted)


def test_a_metric_space_changes_nothing():
    rays, space = ahead(5), EvenDepth(DAVIS, 1.0, 4.0)
    assert space.warp(rays) == (rays.origin, rays.direction)
    assert torch.equal(space.depth(rays.time), rays.time)


def test_a_metric_box_holds_what_the_corners_see():
    seen = poses(6, turn=0.4)
    low, high = EvenDepth(DAVIS, 0.5, 4.0).box(seen)
    corners = torch.tensor([[0, 0], [345, 0], [0, 259], [345, 259]], dtype=torch.float64)
    for pose in seen:
        for z in (0.5, 4.0):
            there = se3.act(pose.expand(4, 3, 4), z * DAVIS.direction(corners))
            assert ((there >= low - 1e-9) & (there <= high + 1e-9)).all()


def test_similarities_move_points_with_cameras():
    change = Similarity(0.4, poses(1)[0, :, :3].numpy(), np.array([1.0, 2, -3]))
    world, seen = points(30), poses(30, stream="seen")
    before = se3.act(se3.inverse(seen), world)
    moved = torch.from_numpy(change.poses(seen.numpy()))
    after = se3.act(se3.inverse(moved), torch.from_numpy(change.points(world.numpy())))
    torch.testing.assert_close(after, 0.4 * before)  # the same directions, all else scaled


def test_a_similarity_can_be_undone():
    change = Similarity(0.4, poses(1)[0, :, :3].numpy(), np.array([1.0, 2, -3]))
    world, seen = points(30).numpy(), poses(30, stream="seen").numpy()
    np.testing.assert_allclose(change.inverse().points(change.points(world)), world, atol=1e-12)
    np.testing.assert_allclose(change.inverse().poses(change.poses(seen)), seen, atol=1e-12)


def test_normalisation_puts_the_average_camera_at_the_origin():
    seen = poses(12, turn=0.5).numpy()
    change = normalisation(seen, near=2.0)
    assert change.scale == pytest.approx(1 / 1.5)
    np.testing.assert_allclose(average_pose(change.poses(seen)), np.eye(3, 4), atol=1e-12)


def test_the_average_of_one_is_itself():
    np.testing.assert_allclose(average_pose(poses(1).numpy()), poses(1)[0], atol=1e-12)


def test_the_average_moves_with_the_world():
    seen, change = poses(7, turn=0.5), poses(1, stream="change")
    moved = se3.compose(change.expand(7, 3, 4), seen).numpy()
    wanted = se3.compose(change[0], torch.from_numpy(average_pose(seen.numpy())))
    np.testing.assert_allclose(average_pose(moved), wanted, atol=1e-12)


def test_the_average_is_the_published_one():
    """LLFF: z from the sum of axes, x across up and z, y across z and x, in y-up axes."""
    seen = poses(7, turn=0.5).numpy()
    up, back = -seen[:, :, 1].sum(0), -seen[:, :, 2].sum(0)
    z = back / np.linalg.norm(back)
    x = np.cross(up, z) / np.linalg.norm(np.cross(up, z))
    wanted = np.stack([x, -np.cross(z, x), -z, seen[:, :, 3].mean(0)], 1)
    np.testing.assert_allclose(average_pose(seen), wanted, atol=1e-12)


@pytest.mark.parametrize(("degrees", "facing"), [(0, True), (59, True), (61, False), (170, False)])
def test_forward_facing(degrees: float, facing: bool):
    angle = np.radians(degrees) * np.array([-1.0, 0, 1])
    twist = np.zeros((3, 6))
    twist[:, 1] = angle
    assert forward_facing(se3.exp(torch.from_numpy(twist)).numpy()) == facing


def test_a_ring_has_no_mean_direction_but_an_average_camera():
    """Directions cancel; the first camera's stand for them, and nothing divides by zero."""
    quarter = np.radians([0, 90, 180, 270])
    twist = np.zeros((4, 6))
    twist[:, 1] = quarter
    ring = se3.exp(torch.from_numpy(twist)).numpy()
    assert not forward_facing(ring)
    np.testing.assert_allclose(average_pose(ring), ring[0], atol=1e-12)


def test_gradients():
    rays = ahead(3)
    inputs = rays.origin.requires_grad_(), rays.direction.requires_grad_()
    assert torch.autograd.gradcheck(lambda o, d: ndc(o, d, DAVIS), inputs)


def test_depth_at_infinity_is_large_and_finite():
    far = Frustum(DAVIS).depth(torch.tensor([1.0]))
    assert far.isfinite().all() and far.item() > 1e5
