"""A camera: lens and sensor, and nothing about where it is.

Axes are OpenCV's: x right, y down, z forward. Pixel coordinates are continuous, in pixels, with
the centre of the first pixel at (0.5, 0.5). Lens models follow OpenCV: `brown` is Brown-Conrady
with (k1, k2, p1, p2, k3), `fisheye` is Kannala-Brandt with (k1, k2, k3, k4).
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.errors import CaptureError

LENSES = {"pinhole": 0, "brown": 5, "fisheye": 4}
"""Lens models, and how many distortion coefficients each has."""

UNDISTORT_STEPS = 12
"""Newton steps; real lenses need four or five for float32."""

AXIS = 1e-9
"""Distance from the optical axis below which a direction is along it."""


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
        if self.lens not in LENSES or len(self.distortion) != LENSES[self.lens]:
            raise CaptureError(
                "unknown lens model or wrong number of distortion coefficients",
                got=f"{self.lens!r} with {len(self.distortion)}",
                do=f"use one of {LENSES} (model: coefficients)",
            )

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width, self.height

    def scaled(self, factor: float) -> "Camera":
        """The same camera with an image `factor` times as large."""
        width, height = round(self.width * factor), round(self.height * factor)
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
        plane = self._on_plane(xy)
        if self.lens == "pinhole":
            ray = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
        elif self.lens == "brown":
            ideal = _invert_brown(plane, self.distortion)
            ray = torch.cat([ideal, torch.ones_like(ideal[..., :1])], -1)
        else:
            ray = _fisheye_direction(plane, self.distortion)
        return torch.nn.functional.normalize(ray, dim=-1)

    def project(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 2"]:
        """Pixel positions of points in camera axes; meaningless behind the camera (z <= 0)."""
        if self.lens == "fisheye":
            plane = _fisheye_plane(points, self.distortion)
        else:
            plane = points[..., :2] / points[..., 2:]
            if self.lens == "brown":
                plane = distort_brown(plane, self.distortion)
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

    def _on_plane(self, xy: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        centre = xy.new_tensor([self.cx_px, self.cy_px])
        return (xy - centre) / xy.new_tensor([self.fx_px, self.fy_px])


def distort_brown(
    plane: Float[Tensor, "*b 2"], coefficients: tuple[float, ...]
) -> Float[Tensor, "*b 2"]:
    """Where a real lens images ideal positions on the plane z = 1 (Brown-Conrady).

    Args:
        plane: Ideal positions x/z, y/z.
        coefficients: k1, k2, p1, p2, k3, as in OpenCV.
    """
    k1, k2, p1, p2, k3 = coefficients
    x, y = plane.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return torch.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )


def _invert_brown(
    seen: Float[Tensor, "*b 2"], coefficients: tuple[float, ...]
) -> Float[Tensor, "*b 2"]:
    """Ideal positions whose distorted image is `seen`, by Newton's method."""
    k1, k2, p1, p2, k3 = coefficients
    plane = seen
    for _ in range(UNDISTORT_STEPS):
        x, y = plane.unbind(-1)
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial / d x = slope * x
        xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
        wrong_x, wrong_y = (distort_brown(plane, coefficients) - seen).unbind(-1)
        determinant = xx * yy - xy * xy
        step = torch.stack([yy * wrong_x - xy * wrong_y, xx * wrong_y - xy * wrong_x], -1)
        plane = plane - step / determinant[..., None]
    return plane


def _fisheye_plane(
    points: Float[Tensor, "*b 3"], coefficients: tuple[float, ...]
) -> Float[Tensor, "*b 2"]:
    """Where points fall on the plane z = 1 of a lens whose radius grows with the angle."""
    sideways, forward = _length(points[..., :2]), points[..., 2]
    bent = _fisheye_angle(torch.atan2(sideways, forward), coefficients)
    # Both branches stay finite, also in their gradients, where the other one is taken.
    on_axis = 1 / forward.clamp_min(AXIS)
    scale = torch.where(sideways > AXIS, bent / sideways.clamp_min(AXIS), on_axis)
    return points[..., :2] * scale[..., None]


def _length(plane: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b"]:
    """Distance from the centre; unlike that of `torch.hypot`, its gradient there is zero."""
    return torch.linalg.vector_norm(plane, dim=-1)  # pyright: ignore


def _fisheye_angle(
    theta: Float[Tensor, "*b"], coefficients: tuple[float, ...]
) -> Float[Tensor, "*b"]:
    """Distance from the centre of the plane at an angle from the axis (Kannala-Brandt)."""
    k1, k2, k3, k4 = coefficients
    t2 = theta * theta
    return theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))


def _fisheye_direction(
    plane: Float[Tensor, "*b 2"], coefficients: tuple[float, ...]
) -> Float[Tensor, "*b 3"]:
    """Unit directions that fall on positions of the plane, by Newton's method on the angle."""
    k1, k2, k3, k4 = coefficients
    bent = _length(plane)
    theta = bent
    for _ in range(UNDISTORT_STEPS):
        t2 = theta * theta
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        theta = theta - (_fisheye_angle(theta, coefficients) - bent) / slope
    scale = torch.where(bent > AXIS, theta.sin() / bent.clamp_min(AXIS), torch.ones_like(bent))
    return torch.cat([plane * scale[..., None], theta.cos()[..., None]], -1)
