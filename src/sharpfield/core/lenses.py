"""Lens models: one object each, with its projection, its inverse, and its names in other software.

Positions on the *plane* are pixel positions less the principal point, divided by the focal
lengths: for a pinhole, x/z and y/z. Other packages add lenses as entry points of the group
`sharpfield.lenses`.

Sources: Brown-Conrady and Kannala-Brandt (TPAMI 2006) as OpenCV defines them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.plugins import Registry

UNDISTORT_STEPS = 12
"""Newton steps; real lenses need four or five for float32."""

AXIS = 1e-9
"""Distance from the optical axis below which a direction is along it."""

Coefficients = Sequence[float]
SHARED_FOCAL, TWO_FOCALS = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class ColmapModel:
    """A camera model of COLMAP that a lens covers."""

    name: str
    number: int
    """In its binary files."""
    parameters: tuple[str, ...]
    """In order: `f` or `fx`, `fy`, then `cx`, `cy`, then distortion coefficients."""


@dataclass(frozen=True)
class Lens:
    """A lens model: where directions fall on the plane z = 1, and back."""

    name: str
    """As `Camera.lens` and capture files give it."""
    coefficients: tuple[str, ...]
    """Names of its distortion coefficients, in the order of `Camera.distortion`."""
    project: Callable[[Float[Tensor, "*b 3"], Coefficients], Float[Tensor, "*b 2"]]
    """Points in camera axes to positions on the plane."""
    unproject: Callable[[Float[Tensor, "*b 2"], Coefficients], Float[Tensor, "*b 3"]]
    """Positions on the plane to directions in camera axes, of any length."""
    zero_is_pinhole: bool = True
    """Whether it is a pinhole when all coefficients are zero."""
    colmap: tuple[ColmapModel, ...] = ()
    """The most common with two focal lengths comes before richer ones."""
    nerfstudio: str = ""
    """Its `camera_model` in `transforms.json`, where the coefficients have their own names."""
    calibration_names: tuple[str, ...] = ()
    """Its `distortion_model` in files of Kalibr, ROS and OpenCV, lower case."""
    fewest: int = 0
    """Coefficients that such files must give; further ones are zero where missing."""

    def padded(self, given: Coefficients) -> tuple[float, ...]:
        """The coefficients, with zeros for those that are not given."""
        return (*given, *[0.0] * (len(self.coefficients) - len(given)))


def lens_in_calibration(name: str) -> Lens | None:
    """The lens that files of Kalibr, ROS or OpenCV call by a name; None if there is none."""
    return next((x for x in LENSES.working().values() if name in x.calibration_names), None)


def _on_plane_one(plane: Float[Tensor, "*b 2"], _: Coefficients = ()) -> Float[Tensor, "*b 3"]:
    return torch.cat([plane, torch.ones_like(plane[..., :1])], -1)


def distort_brown(
    plane: Float[Tensor, "*b 2"], coefficients: Coefficients
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


def _brown_unproject(
    seen: Float[Tensor, "*b 2"], coefficients: Coefficients
) -> Float[Tensor, "*b 3"]:
    """Directions whose distorted position is `seen`, by Newton's method in two dimensions."""
    k1, k2, p1, p2, k3 = coefficients
    plane = seen
    for _ in range(UNDISTORT_STEPS):
        x, y = plane.unbind(-1)
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial / d x = slope * x
        # The Jacobian of `distort_brown`, which is symmetric.
        xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
        wrong_x, wrong_y = (distort_brown(plane, coefficients) - seen).unbind(-1)
        determinant = xx * yy - xy * xy
        step = torch.stack([yy * wrong_x - xy * wrong_y, xx * wrong_y - xy * wrong_x], -1)
        plane = plane - step / determinant[..., None]
    return _on_plane_one(plane)


def _fisheye_project(
    points: Float[Tensor, "*b 3"], coefficients: Coefficients
) -> Float[Tensor, "*b 2"]:
    """The radius on the plane is a polynomial of the angle from the axis."""
    sideways, forward = _length(points[..., :2]), points[..., 2]
    radius = _fisheye_radius(torch.atan2(sideways, forward), coefficients)
    # Both branches stay finite, also in their gradients, where the other one is taken.
    on_axis = 1 / forward.clamp_min(AXIS)
    scale = torch.where(sideways > AXIS, radius / sideways.clamp_min(AXIS), on_axis)
    return points[..., :2] * scale[..., None]


def _length(plane: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b"]:
    """Distance from the centre; unlike that of `torch.hypot`, its gradient there is zero."""
    return torch.linalg.vector_norm(plane, dim=-1)  # pyright: ignore


def _fisheye_radius(theta: Float[Tensor, "*b"], coefficients: Coefficients) -> Float[Tensor, "*b"]:
    """Radius on the plane at an angle from the axis (Kannala-Brandt)."""
    k1, k2, k3, k4 = coefficients
    t2 = theta * theta
    return theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))


def _fisheye_unproject(
    plane: Float[Tensor, "*b 2"], coefficients: Coefficients
) -> Float[Tensor, "*b 3"]:
    """Unit directions, by Newton's method on the angle from the axis."""
    k1, k2, k3, k4 = coefficients
    radius = _length(plane)
    theta = radius
    for _ in range(UNDISTORT_STEPS):
        t2 = theta * theta
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        theta = theta - (_fisheye_radius(theta, coefficients) - radius) / slope
    on_axis = torch.ones_like(radius)
    scale = torch.where(radius > AXIS, theta.sin() / radius.clamp_min(AXIS), on_axis)
    return torch.cat([plane * scale[..., None], theta.cos()[..., None]], -1)


PINHOLE = Lens(
    "pinhole",
    (),
    lambda points, _: points[..., :2] / points[..., 2:],
    _on_plane_one,
    colmap=(ColmapModel("PINHOLE", 1, TWO_FOCALS), ColmapModel("SIMPLE_PINHOLE", 0, SHARED_FOCAL)),
    nerfstudio="PINHOLE",
    calibration_names=("none", "pinhole", ""),
)

BROWN = Lens(
    "brown",
    ("k1", "k2", "p1", "p2", "k3"),
    lambda points, numbers: distort_brown(points[..., :2] / points[..., 2:], numbers),
    _brown_unproject,
    colmap=(
        ColmapModel("OPENCV", 4, (*TWO_FOCALS, "k1", "k2", "p1", "p2")),
        ColmapModel("SIMPLE_RADIAL", 2, (*SHARED_FOCAL, "k1")),
        ColmapModel("RADIAL", 3, (*SHARED_FOCAL, "k1", "k2")),
        ColmapModel(
            "FULL_OPENCV", 6, (*TWO_FOCALS, "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        ),
    ),
    nerfstudio="OPENCV",
    calibration_names=("radtan", "plumb_bob", "brown", "radial-tangential"),
    fewest=4,
)

FISHEYE = Lens(
    "fisheye",
    ("k1", "k2", "k3", "k4"),
    _fisheye_project,
    _fisheye_unproject,
    zero_is_pinhole=False,
    colmap=(ColmapModel("OPENCV_FISHEYE", 5, (*TWO_FOCALS, "k1", "k2", "k3", "k4")),),
    nerfstudio="OPENCV_FISHEYE",
    calibration_names=("equidistant", "fisheye", "kannala_brandt"),
    fewest=4,
)

LENSES = Registry("sharpfield.lenses", {lens.name: lens for lens in (PINHOLE, BROWN, FISHEYE)})
"""Lens models by name."""
