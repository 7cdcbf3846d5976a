"""Fields that move: the numbers of D-NeRF's networks, the canonical instant, any field inside."""

import pytest
import torch

from sharpfield.fields.mlp import MLPField, MLPHead
from sharpfield.fields.plane_grid import HeadSize, PlaneField
from sharpfield.fields.warp import AtZero, Deformation, Warped
from sharpfield.ops.encoding import frequencies_width


def made() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def count(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_published_sizes():
    """Widths of encodings and numbers of parameters, as released."""
    assert [frequencies_width(3, 10), frequencies_width(1, 10), frequencies_width(3, 4)] == [
        63,
        21,
        27,
    ]
    deformation = Deformation(generator=made())
    canonical = MLPField(generator=made(), colours=1, networks=1)
    assert (count(deformation), count(canonical)) == (499_203, 595_586)
    assert count(Warped(canonical, deformation)) == 1_094_789
    assert count(MLPHead(generator=made())) == 595_586 + 2 * 129


def points(rays: int = 3, samples: int = 5) -> torch.Tensor:
    return torch.rand(rays, samples, 3, generator=made()) - 0.5


@pytest.mark.parametrize("at_zero", ["exactly", "smoothly"])
def test_the_canonical_scene_is_that_of_time_zero(at_zero: AtZero):
    deformation = Deformation(generator=made(), width=16, at_zero=at_zero)
    time = torch.tensor([0.0, 0.5, 0.0])
    moved = deformation(points(), time)
    assert not moved[[0, 2]].any()
    assert moved[1].all()


def test_only_the_smooth_one_is_continuous_at_zero():
    just_after = torch.full((3,), 1e-6)
    sizes = {}
    for at_zero in ("exactly", "smoothly"):
        deformation = Deformation(generator=made(), width=16, at_zero=at_zero)
        sizes[at_zero] = float(deformation(points(), just_after).abs().max())
    assert sizes["smoothly"] < 1e-6 < sizes["exactly"]


@pytest.mark.parametrize("kind", ["mlp", "planes"])
def test_a_field_is_looked_at_where_points_came_from(kind: str):
    """A deformation that is the same everywhere equals a still field, shifted."""
    if kind == "mlp":
        field = MLPField(generator=made(), width=8, depth=4)
    else:
        box = torch.tensor([[-2.0, -2, -2], [2, 2, 2]])
        size = HeadSize(hidden=8, feature=4, colour=8)
        field = PlaneField(
            box,
            (5**3, 9**3),
            generator=made(),
            heads=(size, size),
            features=6,
            channels=(4, 4, 4),
            octaves=(2, 1),
        )
    shift = torch.tensor([0.3, -0.2, 0.1])

    def away(points: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        return (time[:, None, None] * shift).expand(points.shape)

    warped, time = Warped(field, away), torch.ones(3)
    old, new = points(), points(3, 4) + 0.05
    seen = warped.coarse_features(old, time)
    expected = field.coarse_features(old + shift, time)
    for mine, theirs in zip(
        warped.coarse.density(seen, old), field.coarse.density(expected, old + shift), strict=True
    ):
        torch.testing.assert_close(mine, theirs)
    closer = warped.fine_features(seen, old, new, time)
    both = torch.cat([old, new], -2)
    truly = field.fine_features(expected, old + shift, new + shift, time)
    found, hidden = warped.fine.density(closer, both)
    wanted, _ = field.fine.density(truly, both + shift)
    torch.testing.assert_close(found, wanted)
    direction = torch.nn.functional.normalize(torch.ones(3, 3), dim=-1)
    colour = warped.fine.colour(warped.fine.feature(hidden), direction)
    assert colour.shape == (3, 9, 3)


def test_gradients_reach_the_deformation():
    field = MLPField(generator=made(), width=8, depth=4)
    warped = Warped(field, Deformation(generator=made(), width=8))
    seen = warped.coarse_features(points(), torch.ones(3))
    warped.coarse.density(seen, points())[0].sum().backward()
    assert all(p.grad is not None and p.grad.any() for p in warped.deformation.parameters())
