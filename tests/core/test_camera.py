import cv2
import numpy as np
import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.core.errors import CaptureError
from sharpfield.core.seed import generator

PINHOLE = Camera(64, 48, 50.0, 55.0, 30.0, 25.0)
BARREL = Camera(64, 48, 30.0, 31.0, 32.5, 23.0, "brown", (-0.4, 0.2, 3e-3, -2e-3, -0.01))
PINCUSHION = Camera(64, 48, 40.0, 41.0, 31.0, 24.5, "brown", (0.5, 0.1, -2e-3, 1e-3, 0.05))
FISHEYE = Camera(64, 48, 26.0, 27.0, 32.0, 24.0, "fisheye", (0.1, -0.05, 0.02, -0.004))
CAMERAS = pytest.mark.parametrize("camera", [PINHOLE, BARREL, PINCUSHION, FISHEYE])


def inside(camera: Camera, count: int = 200) -> torch.Tensor:
    """Pixel positions everywhere in the image, the corners among them."""
    made = generator(0, 0, "camera test")
    corners = torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]], dtype=torch.float64)
    unit = torch.rand(count, 2, generator=made, dtype=torch.float64)
    return torch.cat([corners, unit]) * torch.tensor(camera.size)


@CAMERAS
def test_a_direction_is_projected_onto_its_pixel(camera: Camera):
    xy = inside(camera)
    torch.testing.assert_close(camera.project(3 * camera.direction(xy)), xy, rtol=0, atol=1e-8)
    single = xy.float()
    found = camera.project(3 * camera.direction(single))
    torch.testing.assert_close(found, single, rtol=0, atol=2e-4)


@CAMERAS
def test_directions_are_unit_and_look_forward(camera: Camera):
    direction = camera.direction(inside(camera))
    torch.testing.assert_close(direction.norm(dim=-1), torch.ones(204, dtype=torch.float64))
    assert (direction[:, 2] > 0).all()


@CAMERAS
def test_the_principal_point_sees_straight_ahead(camera: Camera):
    centre = torch.tensor([camera.cx_px, camera.cy_px])
    assert camera.direction(centre).tolist() == [0, 0, 1]
    assert camera.project(torch.tensor([0.0, 0.0, 2.0])).tolist() == centre.tolist()


@pytest.mark.parametrize("factor", [0.5, 2.0])
@CAMERAS
def test_a_scaled_camera_sees_the_same(camera: Camera, factor: float):
    half = camera.scaled(factor)
    assert half.size == (64 * factor, 48 * factor)
    xy = inside(camera)
    torch.testing.assert_close(half.direction(factor * xy), camera.direction(xy))


@CAMERAS
def test_projection_is_opencvs(camera: Camera):
    points = 4 * camera.direction(inside(camera)).numpy()
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    still = np.zeros(3)
    bent = np.array(camera.distortion)
    if camera.lens == "fisheye":
        wanted, _ = cv2.fisheye.projectPoints(points[:, None], still, still, matrix, bent)
    else:
        wanted, _ = cv2.projectPoints(points, still, still, matrix, bent)
    found = camera.project(torch.from_numpy(points))
    np.testing.assert_allclose(found, wanted[:, 0], rtol=0, atol=1e-9)


@CAMERAS
def test_gradients(camera: Camera):
    xy = inside(camera, 3).requires_grad_()
    assert torch.autograd.gradcheck(camera.direction, (xy,), atol=1e-6)
    points = camera.direction(xy).detach().requires_grad_()
    assert torch.autograd.gradcheck(camera.project, (points,))


@CAMERAS
def test_gradients_are_finite_at_the_principal_point(camera: Camera):
    xy = torch.tensor([camera.cx_px, camera.cy_px], requires_grad=True)
    direction = camera.direction(xy)
    camera.project(direction).sum().backward()
    assert xy.grad is not None and xy.grad.isfinite().all()


def test_a_fisheye_sees_sideways():
    point = torch.tensor([1.0, 0.0, 0.0], requires_grad=True)
    wide = Camera(64, 48, 20.0, 20.0, 32.0, 24.0, "fisheye", (0.0, 0.0, 0.0, 0.0))
    seen = wide.project(point)
    assert seen.tolist() == pytest.approx([32 + 20 * np.pi / 2, 24])
    seen.sum().backward()
    assert point.grad is not None and point.grad.isfinite().all()


def test_the_grid_holds_the_centres_of_all_pixels():
    grid = Camera(3, 2, 1.0, 1.0, 1.0, 1.0).grid()
    assert grid.tolist() == [
        [[0.5, 0.5], [1.5, 0.5], [2.5, 0.5]],
        [[0.5, 1.5], [1.5, 1.5], [2.5, 1.5]],
    ]


def test_no_pixels():
    assert PINHOLE.direction(torch.zeros(0, 2)).shape == (0, 3)
    assert FISHEYE.project(torch.zeros(0, 3)).shape == (0, 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "CaptureError: image size must be positive\n  got    0x48"),
        (
            {"fy_px": 0.0},
            "CaptureError: focal length must be positive\n  got    fx 50.0, fy 0.0 px",
        ),
        (
            {"cx_px": 70.0},
            "CaptureError: principal point lies outside the image\n"
            "  got    (70.0, 25.0) in 64x48\n"
            "  do     give it in pixels of this image size",
        ),
        (
            {"lens": "brown", "distortion": (0.1,)},
            "CaptureError: unknown lens model or wrong number of distortion coefficients\n"
            "  got    'brown' with 1\n"
            "  do     use one of pinhole (0), brown (5), fisheye (4)",
        ),
    ],
)
def test_impossible_cameras_are_refused(change: dict, message: str):
    with pytest.raises(CaptureError) as refused:
        Camera(**{**vars(PINHOLE), **change})
    assert str(refused.value) == message
