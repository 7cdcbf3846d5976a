"""Voxels over space and time."""

from dataclasses import replace

import torch

from sharpfield.core.rays import Rays
from sharpfield.fields.voxels import VoxelField, VoxelSizes, moving_shapes, static_shapes
from sharpfield.ops._dispatch import using
from sharpfield.ops.voxel_march import march_voxels
from sharpfield.rendering.voxels import BoxSteps, through_box

SIZE = VoxelSizes(static=8, moving=6, moments=5)


def rays(count: int = 6) -> Rays:
    made = torch.Generator().manual_seed(1)
    origin = torch.tensor([0.0, 0.0, -3.0]) + 0.3 * torch.rand(count, 3, generator=made)
    direction = torch.nn.functional.normalize(
        torch.tensor([0.0, 0.0, 1.0]) + 0.2 * torch.randn(count, 3, generator=made), dim=-1
    )
    return Rays(origin, direction, torch.rand(count, generator=made), torch.ones(count))


def field_of(where: list[torch.Tensor] | None = None, raw_density: float = 0.0) -> VoxelField:
    every = [torch.ones(moments, n, n, n).bool() for moments, n in moving_shapes(SIZE)]
    cells = where or every
    return VoxelField(static_shapes(SIZE), cells, raw_density=raw_density, background=True)


def filled(tensor: torch.Tensor) -> torch.Tensor:
    return 3 * torch.randn(tensor.shape, generator=torch.Generator().manual_seed(len(tensor)))


def test_moving_voxels_that_are_alike_at_all_moments_stand_still():
    seen, grid = rays(), filled(torch.zeros(4, 5, 6, 4))
    place = torch.linspace(1.5, 5, 12).expand(6, -1).contiguous()
    still = march_voxels(seen.origin, seen.direction, place, [grid], opaque_end=False)
    zeros = torch.zeros(2, 2, 2, 4)
    rows = torch.arange(grid[..., 0].numel(), dtype=torch.int32).view(grid.shape[:3])
    always = rows.expand(3, -1, -1, -1)
    given = (seen.origin, seen.direction, place, [zeros], [grid.view(-1, 4)], [always])
    found = march_voxels(*given, 2 * seen.time - 1, opaque_end=False)
    torch.testing.assert_close(found, still, atol=1e-5, rtol=0)


def test_at_a_moment_only_its_own_cells_count():
    field = field_of()
    with torch.no_grad():
        rows = field.rows[0][2].long()
        field.moving[0][rows] = filled(field.moving[0][rows])
    view = BoxSteps(field, step=0.1)
    empty = BoxSteps(field_of(), step=0.1)
    for moment, changed in ((0.25, False), (0.5, True), (0.75, False), (0.6, True)):
        at = rays().map(lambda tensor, _: tensor)
        at = Rays(at.origin, at.direction, torch.full((6,), moment), at.weight)
        differs = (view(at).rgb - empty(at).rgb).abs().max() > 1e-4
        assert bool(differs) == changed, moment


def test_rays_of_one_measurement_are_shifted_alike():
    field = field_of()
    with torch.no_grad():
        field.static[0].copy_(filled(field.static[0]))
    both = rays().reshape(6, 1)
    both = Rays.cat([both, both]).reshape(2, 6)
    pairs = both.map(lambda tensor, _: tensor.transpose(0, 1))
    light = BoxSteps(field, step=0.1)(pairs, torch.Generator().manual_seed(3)).rgb
    assert torch.equal(light[:, 0], light[:, 1])
    again = BoxSteps(field, step=0.1)(pairs, torch.Generator().manual_seed(4)).rgb
    assert not torch.equal(light, again)


def test_the_fast_march_is_the_plain_one():
    """With gradients of voxels and times, as in training; cells without values among them."""
    where = [torch.rand(5, 6, 6, 6, generator=torch.Generator().manual_seed(5)) < 0.4]
    where.append(torch.ones(2, 4, 4, 4).bool())
    field, found = field_of(where), {}
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.copy_(filled(parameter))
    for choice in ("reference", "auto"):
        field.zero_grad()
        with using(choice):
            when = rays().time.requires_grad_()
            seen = BoxSteps(field, step=0.1)(replace(rays(), time=when))
        (seen.rgb.square().sum() + seen.depth.sum() + seen.opacity.sum()).backward()
        found[choice] = [seen.rgb, seen.depth, when.grad, *(p.grad for p in field.parameters())]
    for plain, fast in zip(found["reference"], found["auto"], strict=True):
        torch.testing.assert_close(fast, plain, atol=2e-4, rtol=1e-3)


def test_where_rays_enter_and_leave():
    straight = Rays(
        torch.tensor([[0.0, 0, -3], [0, 0, 0.5], [0, 5, -3]]),
        torch.tensor([[0.0, 0, 1], [0, 0, 1], [0, 0, 1]]),
        torch.zeros(3),
        torch.ones(3),
    )
    enter, leave = through_box(straight)
    torch.testing.assert_close(enter, torch.tensor([2.0, 0.0, 0.0]))
    torch.testing.assert_close(leave, torch.tensor([4.0, 0.5, 0.0]))


def test_cells_without_values_stay_zero():
    where = [torch.zeros(5, 6, 6, 6).bool(), torch.ones(2, 4, 4, 4).bool()]
    where[0][2, 3:] = True
    field = field_of(where)
    assert len(field.moving[0]) == 3 * 6 * 6
    field.fill(torch.ones(5, 6, 6, 6).bool(), 7.0)
    values, held = field.moments(0, 5)
    assert torch.equal(held, where[0])
    assert (values[..., 0][held] == 7).all() and not values[~held].any()
    points = torch.tensor([[0.0, 0, 0.9], [0, 0, -0.9]])
    torch.testing.assert_close(field.raw_density(points, 0.5), torch.tensor([7.0, 0.0]))
    torch.testing.assert_close(field.raw_density(points, 0.625), torch.tensor([3.5, 0.0]))


def test_it_may_start_nearly_empty():
    clear = BoxSteps(field_of(raw_density=-4.0), step=0.1)(rays()).opacity.max()
    fog = BoxSteps(field_of(), step=0.1)(rays()).opacity.max()
    assert clear < 0.01 < 0.1 < fog
