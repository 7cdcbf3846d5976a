"""Moving bodies: groups of surfaces with a common motion in closed form.

A body's motion is an affine map from its own axes at rest to the world, as a function of time: a
rotation and a translation for rigid bodies, with stretch and shear for deforming ones. Textures are
fixed to the body, so they are stretched with it. Body 0 is static.

A ball stays a ball, scaled by the mean stretch of its body; other surfaces are deformed exactly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from sharpfield.simulation.scenes.building import Real, Surface, Vector
from sharpfield.simulation.scenes.surfaces import AXES, BALL, CENTRE, HALF, REACH, Surfaces

CELLS = 10
"""Column of `Surfaces.look` with the cells of a texture per world unit."""

Map = Float64[np.ndarray, "3 4"]
"""World from body: a linear map, and where the body's origin is."""


@dataclass(frozen=True)
class Bodies:
    """The body of each surface, and the motions of the bodies."""

    body: Int64[np.ndarray, "n"]
    maps: Callable[[float], Sequence[Map]]
    """World-from-body maps of bodies 1, 2, ... at a time in seconds."""

    def world_from_body(self, time_s: float) -> Float64[np.ndarray, "n 3 4"]:
        """The map of each surface's body."""
        return np.stack([np.eye(3, 4), *self.maps(time_s)])[self.body]

    def at(self, rest: Surfaces, time_s: float) -> Surfaces:
        """The tables of surfaces, given at rest in the axes of their bodies, at a time."""
        maps = self.world_from_body(time_s)
        shape, look = rest.shape.copy(), rest.look.copy()
        linear = maps[:, :, :3]
        centre = np.einsum("nij,nj->ni", linear, rest.shape[:, CENTRE:HALF]) + maps[:, :, 3]
        shape[:, CENTRE:HALF] = centre
        own = rest.shape[:, AXES : AXES + 9].reshape(-1, 3, 3)  # surface from body
        stretch = np.cbrt(np.linalg.det(linear))
        ball = rest.shape[:, 0] == BALL
        # A ball keeps orthonormal axes, and its radius and the size of its texture change instead.
        scale = np.where(ball, stretch, 1.0)
        rigid = linear / stretch[:, None, None]
        change = np.linalg.inv(np.where(ball[:, None, None], rigid, linear))
        shape[:, AXES : AXES + 9] = (own @ change).reshape(-1, 9)
        shape[:, HALF] *= scale
        look[:, CELLS] /= scale
        longest = np.linalg.norm(linear, 2, axis=(1, 2))
        shape[:, REACH] *= np.where(ball, stretch, longest)
        return rest._replace(shape=shape, look=look)


def placed(
    at: Vector = (0.0, 0.0, 0.0), *, yaw: Real = 0.0, pitch: Real = 0.0, roll: Real = 0.0
) -> Map:
    """A rigid map for a world whose z axis points up: a rotation, then a translation.

    Args:
        at: Position of the body's origin.
        yaw: Rotation about z, rad; the last of the three.
        pitch: Rotation about y.
        roll: Rotation about x; the first.
    """
    (cz, sz), (cy, sy), (cx, sx) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    return np.concatenate([about_z @ about_y @ about_x, np.array(at, float)[:, None]], 1)


def after(outer: Map, inner: Map) -> Map:
    """First `inner`, then `outer`: a joint mounted on another."""
    linear = outer[:, :3] @ inner[:, :3]
    return np.concatenate([linear, outer[:, :3] @ inner[:, 3:] + outer[:, 3:]], 1)


Part = tuple[int, Surface]
"""A surface and the body it belongs to, in that body's axes."""
