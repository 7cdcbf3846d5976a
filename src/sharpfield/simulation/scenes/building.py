"""Surfaces, the bodies they move with, and the assembly of scenes.

World axes are OpenCV's (x right, y down, z away), so the floor lies at positive y.

A *body* is a group of surfaces with a common motion in closed form: an affine map from its own axes
at rest to the world, as a function of time. That is a rotation and a translation for rigid bodies,
with stretch and shear for deforming ones. Textures are fixed to the body, so they are stretched
with it. Body 0 is static.

A ball stays a ball, scaled by the mean stretch of its body; other surfaces are deformed exactly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from sharpfield.simulation.scenes.surfaces import (
    AXES,
    BALL,
    BOX,
    CENTRE,
    CYLINDER,
    HALF,
    REACH,
    RECTANGLE,
    Surfaces,
)
from sharpfield.simulation.scenes.textures import SOLID, TEXT, page

Real = float | int
"""Whole numbers may be written without a point; checks at run time tell the two apart."""
Vector = tuple[Real, Real, Real]

Sway = tuple[Real, Real, Real, Real]
"""How far a centre swings (x, y, z), and the period in seconds."""

FLAT: Vector = (90.0, 0.0, 0.0)
"""Lays a rectangle down: a floor."""
UPRIGHT: Vector = (0.0, 0.0, 0.0)
AT_REST: Sway = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Paint:
    """Colours and texture of a surface."""

    ground: str
    """Display colour as #rrggbb."""
    ink: str = "#202020"
    accent: str = "#ffffff"
    texture: int = SOLID
    cells: Real = 1.0
    """Repetitions of the texture in one world unit."""
    seed: int = 0
    slant: Real = 0.0
    text: str = ""
    """Lettering instead of a texture; on the front of a box or rectangle."""


@dataclass(frozen=True)
class Surface:
    """A rectangle, ball, box or cylinder."""

    kind: int
    centre: Vector
    half: Vector
    paint: Paint
    turn: Vector = UPRIGHT
    """Pitch about x, yaw about y, roll about z, in degrees."""
    throws_shadow: bool = True
    sway: Sway = AT_REST


def rectangle(
    centre: Vector, size: tuple[Real, Real], paint: Paint, *, turn: Vector = UPRIGHT
) -> Surface:
    """A flat image of `size` (width, height), upright and facing the camera unless turned."""
    return Surface(RECTANGLE, centre, (size[0] / 2, size[1] / 2, 0.0), paint, turn)


def wall(
    centre: Vector, size: tuple[Real, Real], paint: Paint, *, turn: Vector = UPRIGHT
) -> Surface:
    """A rectangle that throws no shadow: a wall, a floor, or what lies flat on one."""
    return replace(rectangle(centre, size, paint, turn=turn), throws_shadow=False)


def ball(centre: Vector, radius: Real, paint: Paint, *, sway: Sway = AT_REST) -> Surface:
    """A ball."""
    return Surface(BALL, centre, (radius, radius, radius), paint, sway=sway)


def box(
    centre: Vector, size: Vector, paint: Paint, *, turn: Vector = UPRIGHT, sway: Sway = AT_REST
) -> Surface:
    """A box of `size` (width, height, depth)."""
    half = (size[0] / 2, size[1] / 2, size[2] / 2)
    return Surface(BOX, centre, half, paint, turn, sway=sway)


def cylinder(centre: Vector, radius: Real, height: Real, paint: Paint) -> Surface:
    """An upright cylinder, closed at both ends."""
    return Surface(CYLINDER, centre, (radius, height / 2, radius), paint)


def build(
    parts: list[Surface],
    *,
    sun: Vector = (-0.5, -0.9, -0.8),
    ambient: float = 0.5,
    sky: tuple[str, str] = ("#e8eef4", "#9fc3e6"),
) -> Surfaces:
    """The tables that rays are traced through.

    Args:
        parts: All surfaces.
        sun: Direction towards the sun.
        ambient: Share of light that comes from everywhere.
        sky: Display colours straight ahead and above.
    """
    sheets = [page(p.paint.text, p.half[0] / p.half[1]) for p in parts if p.paint.text]
    rows = max((s.shape[0] for s in sheets), default=2)
    columns = max((s.shape[1] for s in sheets), default=2)
    pages = np.zeros((max(len(sheets), 1), rows, columns), np.float32)
    for pane, sheet in zip(pages, sheets, strict=False):
        pane[: sheet.shape[0], : sheet.shape[1]] = sheet
    reach = [p.half[0] if p.kind == BALL else np.linalg.norm(p.half) for p in parts]
    shape = [
        (p.kind, *p.centre, *p.half, *_axes(p.turn).ravel(), p.throws_shadow, far)
        for p, far in zip(parts, reach, strict=True)
    ]
    look, which = [], 0
    for part in parts:
        paint, extent = part.paint, (0, 0, 0)
        if paint.text:
            extent = (which, *sheets[which].shape)
            which += 1
        colours = [linear(c) for c in (paint.ground, paint.ink, paint.accent)]
        texture = TEXT if paint.text else paint.texture
        look.append((*np.ravel(colours), texture, paint.cells, paint.seed, paint.slant, *extent))
    towards = np.array(sun) / np.linalg.norm(sun)
    return Surfaces(
        shape=np.array(shape, float),
        look=np.array(look, float),
        pages=pages,
        sway=np.array([p.sway for p in parts], float),
        light=np.array([*towards, ambient]),
        sky=np.array([linear(c) for c in sky]),
    )


def linear(colour: str) -> Float64[np.ndarray, "3"]:
    """Linear RGB of a display colour written as #rrggbb (gamma 2.2)."""
    display = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    return np.array(display) ** 2.2


def _axes(turn: Vector) -> Float64[np.ndarray, "3 3"]:
    """Rows: a turned surface's x, y, z in the world."""
    x, y, z = np.deg2rad(turn)
    pitch = [[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]]
    yaw = [[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]]
    roll = [[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]]
    return (np.array(yaw) @ np.array(pitch) @ np.array(roll)).T


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
