import torch

from sharpfield.core.camera import Camera
from sharpfield.geometry import se3
from sharpfield.geometry.rays import cast
from tests.geometry.toy import points, poses

CAMERA = Camera(64, 48, 40.0, 41.0, 31.0, 24.5, "brown", (0.1, 0.02, -2e-3, 1e-3, 0.0))


def test_a_ray_meets_what_its_pixel_shows():
    pose = poses(30)
    inside = points(30) * 0.3 + torch.tensor([0, 0, 3.0])
    world = se3.act(pose, inside)
    time = torch.rand(30, dtype=torch.float64)
    rays = cast(CAMERA, pose, CAMERA.project(inside), time, 2 * time)
    along = ((world - rays.origin) * rays.direction).sum(-1, keepdim=True)
    torch.testing.assert_close(rays.origin + along * rays.direction, world)
    assert (along > 0).all()
    torch.testing.assert_close(rays.origin, pose[..., 3])
    torch.testing.assert_close(rays.direction.norm(dim=-1), torch.ones(30, dtype=torch.float64))
    assert torch.equal(rays.time, time) and torch.equal(rays.weight, 2 * time)


def test_rays_of_one_pixel_share_its_direction():
    pose, time = poses(5, 3), torch.zeros(5, 3, dtype=torch.float64)
    xy = torch.rand(5, 1, 2, dtype=torch.float64) * 40
    shared = cast(CAMERA, pose, xy, time, time)
    apart = cast(CAMERA, pose, xy.expand(5, 3, 2), time, time)
    torch.testing.assert_close(shared.direction, apart.direction)
    assert shared.shape == (5, 3)


def test_gradients_reach_the_pose():
    pose = poses(2).requires_grad_()
    xy = torch.tensor([[3.0, 40.0], [31.0, 24.5]], dtype=torch.float64)
    zero = torch.zeros(2, dtype=torch.float64)

    def moved(p: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        rays = cast(CAMERA, p, xy, zero, zero)
        return rays.origin, rays.direction

    assert torch.autograd.gradcheck(moved, (pose,))


def test_no_pixels():
    none = torch.zeros(0)
    assert len(cast(CAMERA, torch.zeros(0, 3, 4), torch.zeros(0, 2), none, none)) == 0
