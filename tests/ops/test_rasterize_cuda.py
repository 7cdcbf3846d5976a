"""Drawing by gsplat, with a stand-in of plain torch that has its interface and its conventions.

It tells whether poses, corners, shifts and opacities are handed over rightly; whether gsplat's own
kernels agree with the definition is tested in `test_parity.py` where there is a GPU.
"""

import sys
from dataclasses import replace
from types import ModuleType

import pytest
import torch
from torch import Tensor

from sharpfield.core.errors import MissingExtra, OptionError
from sharpfield.ops import _dispatch
from sharpfield.ops import rasterizer as definition
from sharpfield.ops._dispatch import using
from sharpfield.ops.rasterizer import WIDEN, Canvas, Splats, rasterize
from tests.ops.test_rasterizer import CAMERA, scene

POSES = torch.eye(3, 4).repeat(2, 1, 1)
POSES[1] = torch.tensor([[0.96, 0, -0.28, 0.3], [0, 1, 0, -0.1], [0.28, 0, 0.96, 0.2]])
CORNERS, SIZE = torch.tensor([[0, 0], [5, 3]]), (30, 15)


def fully_fused_projection(
    means: Tensor, covars: None, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, *, eps2d: float, near_plane: float, calc_compensations: bool,
    opacities: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]:  # fmt: skip
    """Camera-from-world matrices in, positions in pixels of the whole image out."""
    assert covars is None and (eps2d, near_plane) == (WIDEN, 0.01) and not opacities.requires_grad
    rim = (width - CAMERA.width) // 2  # more than splats are shifted
    assert (width, height) == (CAMERA.width + 2 * rim, CAMERA.height + 2 * rim) and rim in (0, 1)
    camera = replace(
        CAMERA, width=width, height=height, cx_px=CAMERA.cx_px + rim, cy_px=CAMERA.cy_px + rim
    )
    lens = [camera.fx_px, 0, camera.cx_px, 0, camera.fy_px, camera.cy_px, 0, 0, 1]
    assert torch.equal(Ks, torch.tensor(lens).reshape(1, 3, 3).expand(2, 3, 3))
    assert viewmats[:, 3].tolist() == [[0, 0, 0, 1]] * 2
    inward = viewmats[:, :3, :3]
    # Not the transpose: gradients of rotations also point to where they are none any more.
    centre = -torch.linalg.solve(inward, viewmats[:, :3, 3:])
    poses = torch.cat([inward.mT, centre], -1)
    whole = Canvas(camera, torch.zeros(2, 2, dtype=torch.int64), (width, height), True)
    ones = torch.ones(len(means))
    seen = definition.project(means, quats, scales, ones, poses, whole)
    reach = torch.full((2, len(means), 2), 9, dtype=torch.int32)
    thinned = seen.opacity if calc_compensations else None
    return reach, seen.centre, seen.depth, seen.conic, thinned


def isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, size: int, across: int, down: int
) -> tuple[None, Tensor, Tensor]:
    assert (size, across, down) == (16, 2, 1) and radii.dtype == torch.int32
    return None, torch.zeros(7, dtype=torch.int64), depths.argsort(1).int()


def isect_offset_encode(isect_ids: Tensor, n_images: int, across: int, down: int) -> Tensor:
    return torch.zeros(n_images, down, across, dtype=torch.int32)


def rasterize_to_pixels(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, width: int, height: int,
    tile_size: int, isect_offsets: Tensor, flatten_ids: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Features of each view in, their sums and the opacity, with an axis of its own, out."""
    assert opacities.is_contiguous() and flatten_ids.dtype == torch.int32
    splats = Splats(means2d, conics, colors[..., -1], opacities)
    canvas = Canvas(CAMERA, CORNERS, (width, height))
    drawn = definition._blend(splats, colors, canvas)
    return drawn.light, drawn.opacity[..., None]


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    made = ModuleType("gsplat")
    functions = fully_fused_projection, isect_tiles, isect_offset_encode, rasterize_to_pixels
    for function in functions:
        setattr(made, function.__name__, function)
    monkeypatch.setitem(sys.modules, "gsplat", made)


def arguments(count: int = 40) -> list[Tensor]:
    made = [argument.float() for argument in scene(count)]
    return [*made[:4], torch.cat([made[4], 1 - made[4]]), POSES]


def by_gsplat(leaves: list[Tensor], canvas: Canvas, shift: Tensor | None = None):
    needs, version = rasterize.fast()["cuda"]
    assert needs == "gsplat"
    return version(*leaves, canvas, shift)


@pytest.mark.parametrize("antialiased", [True, False])
@pytest.mark.parametrize("shifted", [True, False])
def test_what_is_handed_over_makes_the_definition(
    stand_in: None, antialiased: bool, shifted: bool
) -> None:
    canvas = Canvas(CAMERA, CORNERS, SIZE, antialiased)
    found = []
    for draw in (by_gsplat, rasterize.reference):
        leaves = [argument.clone().requires_grad_() for argument in arguments()]
        shift = torch.full((2, 40, 2), 0.5, requires_grad=True) if shifted else None
        drawn = draw(leaves, canvas, shift) if draw is by_gsplat else draw(*leaves, canvas, shift)
        made = torch.Generator().manual_seed(1)
        loss = sum((image * torch.randn(image.shape, generator=made)).sum() for image in drawn)
        asked = [*leaves, shift] if shift is not None else leaves
        found.append([*drawn, *torch.autograd.grad(loss, asked)])
    for one, other in zip(*found, strict=True):
        assert one.shape == other.shape
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-3)


def test_no_gaussians_and_double_precision_are_left_to_the_definition() -> None:
    canvas = Canvas(CAMERA, CORNERS, SIZE)
    none = [argument[:0] for argument in arguments()[:4]]
    drawn = by_gsplat([*none, torch.zeros(2, 0, 3), POSES], canvas)
    assert drawn.light.shape == (2, 15, 30, 3) and not drawn.opacity.any()
    double = [argument.double() for argument in arguments()]
    wanted = rasterize.reference(*double, canvas)
    assert torch.equal(by_gsplat(double, canvas).light, wanted.light)


def test_without_gsplat_the_definition_runs_unless_a_fast_version_is_demanded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_dispatch, "_installed", lambda package: package != "gsplat")
    monkeypatch.setattr(rasterize, "used", set())
    with using("auto"):
        assert rasterize.pick("cuda") is rasterize.reference
    assert rasterize.used == {"reference (cuda)"}
    with using("fast"), pytest.raises(OptionError, match="install 'gsplat'"):
        rasterize.pick("cuda")


def test_with_gsplat_it_is_picked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_dispatch, "_installed", lambda package: True)
    with using("auto"):
        assert rasterize.pick("cuda") is rasterize.fast()["cuda"][1]


def test_a_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(MissingExtra, match=r"gpu"):
        by_gsplat(arguments(), replace(Canvas(CAMERA, CORNERS, SIZE), antialiased=False))
