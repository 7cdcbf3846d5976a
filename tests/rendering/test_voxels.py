"""Light through a voxel grid."""

import torch

from sharpfield.core.camera import Camera
from sharpfield.core.rays import Rays
from sharpfield.core.seed import generator
from sharpfield.fields.voxels import VoxelField, shapes_in
from sharpfield.geometry.space import EvenDepth, Frustum
from sharpfield.rendering.voxels import EvenSteps

CAMERA = Camera(16, 12, 15.0, 15.0, 8.0, 6.0)
BOX = torch.tensor([[-1.1, -1.1, 1.0], [1.1, 1.1, 3.0]])


def field(box: torch.Tensor, voxels: int) -> VoxelField:
    return VoxelField(shapes_in(box, voxels), box=box)


def forward(count: int) -> Rays:
    """Parallel rays along z."""
    origin = torch.zeros(count, 3)
    origin[:, 0] = torch.linspace(-0.5, 0.5, count)
    ahead = torch.tensor([0.0, 0.0, 1.0]).expand(count, 3)
    return Rays(origin, ahead, torch.zeros(count), torch.ones(count))


def test_an_empty_frustum_is_closed_by_its_end() -> None:
    box = Frustum(CAMERA).box(torch.eye(3, 4)[None])
    view = EvenSteps(field(box, 1000), Frustum(CAMERA), 16)
    seen = view(forward(5))
    assert torch.allclose(seen.opacity, torch.ones(5), atol=1e-4)
    assert torch.allclose(seen.rgb, torch.full((5, 3), 0.5), atol=1e-4)


def test_a_wall_is_seen_where_it_stands_in_its_colour() -> None:
    grid = field(BOX, 8000)
    with torch.no_grad():
        grid.static[0][..., 0] = -20.0
        middle = grid.static[0].shape[0] // 2
        grid.static[0][middle:, :, :, 0] = 20.0
        grid.static[0][..., 1] = 3.0
        grid.static[0][..., 2:] = -3.0
    seen = EvenSteps(grid, EvenDepth(CAMERA, 1.0, 3.0), 128)(forward(4))
    assert torch.allclose(seen.opacity, torch.ones(4), atol=1e-4)
    assert torch.allclose(seen.depth, torch.full((4,), 2.0), atol=0.1)
    assert torch.allclose(seen.rgb[:, 0], torch.tensor(3.0).sigmoid(), atol=1e-3)
    assert torch.allclose(seen.rgb[:, 1], torch.tensor(-3.0).sigmoid(), atol=1e-3)


def test_nothing_is_seen_beside_the_box() -> None:
    grid = field(BOX, 1000)
    rays = forward(3)
    aside = Rays(rays.origin + 10.0, rays.direction, rays.time, rays.weight)
    seen = EvenSteps(grid, EvenDepth(CAMERA, 1.0, 3.0), 16)(aside)
    assert not seen.opacity.detach().any()


def test_jitter_comes_from_the_generator_alone() -> None:
    grid = field(BOX, 1000)
    torch.nn.init.normal_(grid.static[0], generator=torch.Generator().manual_seed(0))
    view = EvenSteps(grid, EvenDepth(CAMERA, 1.0, 3.0), 16)
    one, same, other = (view(forward(6), generator(0, step, "x")).rgb for step in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
    assert torch.equal(view(forward(6)).rgb, view(forward(6)).rgb)


def test_shape_and_weights_of_the_rays_are_kept() -> None:
    rays = forward(6).reshape(2, 3)
    seen = EvenSteps(field(BOX, 1000), EvenDepth(CAMERA, 1.0, 3.0), 8)(rays)
    assert seen.rgb.shape == (2, 3, 3)
    assert seen.weight is not None
    assert seen.coarse is None
