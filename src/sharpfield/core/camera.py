"""A camera: lens and sensor, and nothing about where it is.

Axes are OpenCV's: x right, y down, z forward. Pixel coordinates are continuous, in pixels, with
the centre of the first pixel at (0.5, 0.5). Lens models are those of `core.lenses`: `pinhole`,
`brown` (Brown-Conrady with k1, k2, p1, p2, k3), `fisheye` (Kannala-Brandt with k1, k2, k3, k4).
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.errors import CaptureError
from sharpfield.core.lenses import LENSES


@dataclass(frozen=True)
class Camera:
    """Lens and sensor of a camera; pixels to directions and back."""

    width: int
    height: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    lens: str = "pinhole"
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise CaptureError("image size must be positive", got=f"{self.width}x{self.height}")
        if not (self.fx_px > 0 and self.fy_px > 0):
            raise CaptureError(
                "focal length must be positive", got=f"fx {self.fx_px}, fy {self.fy_px} px"
            )
        if not (0 <= self.cx_px <= self.width and 0 <= self.cy_px <= self.height):
            raise CaptureError(
                "principal point lies outside the image",
                got=f"({self.cx_px}, {self.cy_px}) in {self.width}x{self.height}",
                do="give it in pixels of this image size",
            )
        lens = LENSES.get(self.lens)
        if lens is None or len(self.distortion) != len(lens.coefficients):
            known = [f"{x.name} ({len(x.coefficients)})" for x in LENSES.working().values()]
            raise CaptureError(
                "unknown lens model or wrong number of distortion coefficients",
                got=f"{self.lens!r} with {len(self.distortion)}",
                do=f"use one of {', '.join(known)}",
            )

    def __repr__(self) -> str:
        lens = f", {self.lens} {self.distortion}" if self.distortion else ""
        focal = f"f {self.fx_px:.4g} {self.fy_px:.4g} px, c {self.cx_px:.4g} {self.cy_px:.4g} px"
        return f"Camera({self.width}x{self.height}, {focal}{lens})"

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width, self.height

    def scaled(self, factor: float) -> "Camera":
        """The same camera with an image `factor` times as large."""
        return self.resized(round(self.width * factor), round(self.height * factor))

    def resized(self, width: int, height: int) -> "Camera":
        """The same camera with an image of another size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx_px=self.fx_px * sx,
            fy_px=self.fy_px * sy,
            cx_px=self.cx_px * sx,
            cy_px=self.cy_px * sy,
        )

    def direction(self, xy: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 3"]:
        """Unit directions, in camera axes, seen by pixel positions."""
        centre = xy.new_tensor([self.cx_px, self.cy_px])
        plane = (xy - centre) / xy.new_tensor([self.fx_px, self.fy_px])
        ray = LENSES[self.lens].unproject(plane, self.distortion)
        return torch.nn.functional.normalize(ray, dim=-1)

    def project(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 2"]:
        """Pixel positions of points in camera axes; meaningless behind the camera (z <= 0)."""
        plane = LENSES[self.lens].project(points, self.distortion)
        return plane * plane.new_tensor([self.fx_px, self.fy_px]) + plane.new_tensor(
            [self.cx_px, self.cy_px]
        )

    def grid(self, device: torch.device | str = "cpu") -> Float[Tensor, "h w 2"]:
        """Centres of all pixels."""
        y, x = torch.meshgrid(
            torch.arange(self.height, device=device) + 0.5,
            torch.arange(self.width, device=device) + 0.5,
            indexing="ij",
        )
        return torch.stack([x, y], -1)
