"""3D Gaussians in the `.ply` layout that splat viewers read.

Vertices have the position `x y z`, an unused normal `nx ny nz`, spherical harmonics (SH) of degree
0 `f_dc_0..2`, higher ones `f_rest_*` (all of red, then green, then blue), the logit of the
`opacity`, the natural log of the scales `scale_0..2` and a quaternion `rot_0..3` (w x y z). The SH
include the Condon-Shortley phase, so those of odd order m have the opposite sign of ours. The
colour of degree 0 is 0.5 + 0.282 f_dc.

Source: released code of "3D Gaussian splatting for real-time radiance field rendering" (SIGGRAPH
2023), which made this layout.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from sharpfield.core.errors import CaptureError
from sharpfield.storage.ply import Ply, columns, read_ply, write_ply

POSITION, NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
BASE = tuple(f"f_dc_{i}" for i in range(3))
SCALES = tuple(f"scale_{i}" for i in range(3))
ROTATION = tuple(f"rot_{i}" for i in range(4))

COUNTS = [3 * ((degree + 1) ** 2 - 1) for degree in range(4)]
"""Number of higher SH coefficients of three colours, for degrees 0 to 3."""


@dataclass(frozen=True)
class SplatTable:
    """Gaussians as in such files, but with our signs and order of SH coefficients."""

    means: Float32[np.ndarray, "n 3"]
    quaternions: Float32[np.ndarray, "n 4"]
    """w x y z."""
    log_scales: Float32[np.ndarray, "n 3"]
    opacity_logits: Float32[np.ndarray, "n"]
    harmonics: Float32[np.ndarray, "n k 3"]
    """Ordered by degree, then by order m from -l to l, see `ops/encoding.py`."""
    comments: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"SplatTable({len(self.means):,} Gaussians, {self.harmonics.shape[1]} harmonics)"


def write_splats(path: Path, splats: SplatTable) -> None:
    """Write Gaussians of SH degree 0 to 3; the file appears whole or not at all."""
    count, k, _ = splats.harmonics.shape
    harmonics = splats.harmonics * _signs(k)
    higher = harmonics[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (k - 1))
    values = np.concatenate(
        [
            splats.means,
            np.zeros_like(splats.means),
            harmonics[:, 0],
            higher,
            splats.opacity_logits[:, None],
            splats.log_scales,
            splats.quaternions,
        ],
        -1,
    )
    names = [*POSITION, *NORMAL, *BASE, *_higher(higher.shape[1]), "opacity", *SCALES, *ROTATION]
    rows = np.ascontiguousarray(values).view([(name, "f4") for name in names])[:, 0]
    write_ply(path, Ply(rows, splats.comments))


def read_splats(path: Path) -> SplatTable:
    """Read Gaussians.

    Raises:
        CaptureError: The file is missing or truncated, or does not hold Gaussians.
    """
    ply = read_ply(path)
    names = ply.rows.dtype.names or ()
    count = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names)
    if count not in COUNTS:
        raise CaptureError(
            "unexpected number of SH coefficients",
            where=path,
            got=f"{count} properties f_rest_*",
            do=f"there must be {', '.join(map(str, COUNTS[:-1]))} or {COUNTS[-1]}, by degree",
        )

    def read(wanted: tuple[str, ...]) -> Float32[np.ndarray, "n m"]:
        values = columns(ply, wanted, where=path).astype(np.float32)
        if not np.isfinite(values).all():
            raise CaptureError(
                "Gaussians are not finite",
                where=path,
                got=f"in {', '.join(wanted[:3])}",
                do="export them again",
            )
        return values

    higher = read(_higher(count)).reshape(len(ply.rows), 3, count // 3).transpose(0, 2, 1)
    harmonics = np.concatenate([read(BASE)[:, None], higher], 1)
    return SplatTable(
        means=read(POSITION),
        quaternions=read(ROTATION),
        log_scales=read(SCALES),
        opacity_logits=read(("opacity",))[:, 0],
        harmonics=harmonics * _signs(harmonics.shape[1]),
        comments=ply.comments,
    )


def _higher(count: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(count))


def _signs(count: int) -> Float32[np.ndarray, "k 1"]:
    """The Condon-Shortley phase of each harmonic: (-1)^m."""
    orders = [m for degree in range(math.isqrt(count)) for m in range(-degree, degree + 1)]
    return np.where(np.array(orders) % 2, -1, 1).astype(np.float32)[:, None]
