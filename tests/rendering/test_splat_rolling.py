"""Gaussians seen by a rolling shutter."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.tone import tone_of
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.geometry import se3
from sharpfield.rendering.splat import Splatting, row_shift, whole
from tests.rendering.test_splat_lens import BARREL, FISH, IDEAL, dots, draw, middle_of

TURN = torch.tensor([0.03, -0.2, 0.05, 0.1, 0.05, 0.0])
"""Twist over the readout."""
CAMERAS = {"pinhole": IDEAL, "barrel": BARREL, "fisheye": FISH}


def swing(part: Tensor) -> Tensor:
    """World-from-camera when that part of the rows is read."""
    return se3.exp((part[..., None] - 0.5) * TURN)


def rows(knots: int = 9) -> Tensor:
    return swing(torch.linspace(0, 1, knots))


def shown(camera: Camera, cloud: Gaussians, knots: int = 9):
    view = whole(camera, swing(torch.tensor(0.5)), 0.0, rows(knots))
    return Splatting(camera, tone_of("linear").decode)(cloud, view)[0]


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("xy", [(31.0, 21.0), (10.0, 6.0), (50.0, 37.0)])
def test_a_dot_is_where_its_row_sees_it(camera: Camera, xy: tuple[float, float]):
    part = torch.tensor(xy[1] / camera.height)
    ray = 3 * camera.direction(torch.tensor(xy))
    point = se3.act(swing(part), ray)
    light = shown(camera, dots(point[None])).rgb[..., 0, 0]
    torch.testing.assert_close(middle_of(light, camera), torch.tensor(xy), atol=0.07, rtol=0)


def test_it_is_like_each_row_taken_from_a_view_of_its_own():
    """Oracle: draw the image once for each row, and keep that row."""
    made = torch.Generator().manual_seed(0)
    points = torch.randn(50, 3, generator=made) * torch.tensor([1.2, 0.9, 0.3])
    cloud = dots(points + torch.tensor([0.0, 0.0, 3.0]), 0.15)
    linear = tone_of("linear").decode

    def at(part: float) -> Tensor:
        view = whole(IDEAL, swing(torch.tensor(part)), 0.0)
        return Splatting(IDEAL, linear)(cloud, view)[0].rgb.detach()

    wanted = torch.stack([at((row + 0.5) / 44)[row] for row in range(44)])
    found, still = shown(IDEAL, cloud).rgb.detach(), at(0.5)
    off, before = (float((seen - wanted).abs().mean()) for seen in (found, still))
    assert off < 0.25 * before, "one pose for all rows is far worse"


def test_a_camera_that_stands_still_shows_what_it_always_shows():
    cloud = dots(torch.tensor([[0.3, 0.2, 2.0], [-0.6, 0.1, 2.5], [0.0, 0.0, -1.0]]), 0.2)
    pose = torch.eye(3, 4)
    view = whole(IDEAL, pose, 0.0, pose.expand(3, 3, 4))
    seen = Splatting(IDEAL, tone_of("gamma2.2").decode)(cloud, view)[0]
    torch.testing.assert_close(seen.rgb, draw(IDEAL, cloud, pose).rgb)


def test_parts_roll_with_the_whole():
    cloud = dots(torch.tensor([[0.3, 0.2, 2.0], [-0.6, 0.1, 2.5]]), 0.2)
    view = whole(IDEAL, swing(torch.tensor(0.5)), 0.0, rows())
    splatting = Splatting(IDEAL, tone_of("linear").decode)
    part = replace(view, corner=torch.tensor([[[10, 20]]]), size=(30, 16))
    wanted = splatting(cloud, view).rgb[:, 20:36, 10:40]
    torch.testing.assert_close(splatting(cloud, part).rgb, wanted, atol=1e-5, rtol=1e-4)


def test_poses_of_all_rows_learn():
    """Slopes agree with finite differences, in float64; rows that see nothing have none."""
    means = torch.tensor([[0.4, -0.5, 2.0], [-0.3, 0.6, 2.5], [0.1, 0.0, -2.0]]).double()
    start = torch.zeros(5, 6).double()

    def shift(means: Tensor, twists: Tensor) -> Tensor:
        moved = se3.compose(rows(5).double(), se3.exp(twists))
        pose = swing(torch.tensor(0.5)).double()
        return row_shift(means, pose[None], moved[None], IDEAL, IDEAL)

    seen = shift(means, start)
    assert seen[0, :2].abs().min() > 0.05 and not seen[0, 2].any(), "nothing is behind the camera"
    assert torch.autograd.gradcheck(shift, (means.requires_grad_(), start.requires_grad_()))


def test_a_drift_of_the_scene_is_like_the_opposite_drift_of_the_camera():
    """Law: only the motion of one against the other is seen."""
    made = torch.Generator().manual_seed(1)
    means = torch.randn(40, 3, generator=made) * 0.5 + torch.tensor([0.0, 0.0, 3.0])
    drift = torch.tensor([0.4, -0.3, 0.2])
    still = torch.eye(4)[:3].expand(1, 5, 3, 4)
    moved = still.clone()
    moved[0, :, :, 3] = -torch.linspace(-0.5, 0.5, 5)[:, None] * drift
    pose = still[:, 2]
    by_scene = row_shift(means, pose, still, IDEAL, IDEAL, drift.expand(40, 3))
    by_camera = row_shift(means, pose, moved, IDEAL, IDEAL)
    torch.testing.assert_close(by_scene, by_camera, atol=1e-4, rtol=0)
    assert by_scene.abs().max() > 1
