"""Static scenes in closed form, textured, with occlusion and depth.

All are designed for a camera near the origin that looks along +z (x right, y down) and moves half a
unit sideways; surfaces are at distances of about 2 to 7. Fine detail (letters, leaves,
tiles) is there to be destroyed by blur and found again.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from sharpfield.core.errors import expect_one_of
from sharpfield.simulation.scenes.building import (
    FLAT,
    Bodies,
    Paint,
    Surface,
    ball,
    box,
    build,
    rectangle,
    wall,
)
from sharpfield.simulation.scenes.surfaces import Surfaces, trace
from sharpfield.simulation.scenes.textures import (
    BRICKS,
    CHECKS,
    LEAVES,
    MARBLE,
    STRIPES,
    TILES,
    WOOD,
)


@dataclass(frozen=True)
class Scene:
    """A scene whose light can be evaluated along any ray at any time."""

    name: str
    surfaces: Surfaces
    near: float
    """Depth in front of all surfaces, for a camera near the origin."""
    far: float
    bodies: Bodies | None = None
    """Motion of the surfaces; None if they are static or sway."""

    def at(self, time_s: float) -> Surfaces:
        """The surfaces at a time in seconds; sway is added when they are traced."""
        return self.surfaces if self.bodies is None else self.bodies.at(self.surfaces, time_s)

    def followed(
        self,
        points: Float64[np.ndarray, "n 3"],
        which: Int64[np.ndarray, "n"],
        time_s: float,
        later_s: float,
    ) -> Float64[np.ndarray, "n 3"]:
        """Positions of points on surfaces at another time.

        Args:
            points: In the world, at `time_s`.
            which: The surface of each; -1 for a static point.
            time_s: Seconds.
            later_s: Seconds; may be earlier.
        """
        sway, period = np.split(self.surfaces.sway, [3], axis=1)
        swung = sway * (_swing(later_s, period) - _swing(time_s, period))
        moved = points + np.where(which[:, None] >= 0, swung[which], 0.0)
        if self.bodies is None:
            return moved
        now, then = (self.bodies.world_from_body(t)[which] for t in (time_s, later_s))
        own = np.linalg.solve(now[:, :, :3], (points - now[:, :, 3])[..., None])
        ridden = (then[:, :, :3] @ own)[..., 0] + then[:, :, 3]
        return np.where(which[:, None] >= 0, ridden, points)

    def light(
        self,
        origin: Float64[np.ndarray, "m 3"],
        direction: Float64[np.ndarray, "n 3"],
        time_s: float = 0.0,
        *,
        footprint_rad: float = 1e-3,
    ) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n"]]:
        """Linear rgb in 0.02...1, and depth in lengths of `direction`.

        Args:
            origin: One for each ray, or one for all.
            direction: Any length; with a z of 1 in the camera, depth is the camera's z.
            time_s: Seconds, for moving scenes.
            footprint_rad: Angle between neighbouring pixels: 1 / focal length in px.
        """
        return trace(self.at(time_s), origin, direction, time_s, footprint_rad)


def _swing(time_s: float, period: Float64[np.ndarray, "n 1"]) -> Float64[np.ndarray, "n 1"]:
    return np.sin(2 * np.pi * time_s / period)


def scene(name: str) -> Scene:
    """A scene by its name, one of `SCENES`.

    Raises:
        OptionError: There is no such scene.
    """
    expect_one_of("scene", name, SCENES)
    parts, near, far, ambient = SCENES[name]()
    return Scene(name, build(parts, ambient=ambient), near, far)


Parts = tuple[list[Surface], float, float, float]


def _garden() -> Parts:
    """A patio: hedge, brick wall, painted tiles, pots and a sign."""
    azulejo = Paint("#f3ead8", "#2456a6", "#e2a33c", TILES, 3.2)
    hedge = Paint("#1f4d2b", "#86b94e", "#e5d36b", LEAVES, 2.6, 3)
    floor = Paint("#d9b99b", "#8c3f2d", "#efe3cf", TILES, 1.0, 2)
    brick = Paint("#b5573f", "#d98d62", "#e8dccb", BRICKS, 2.2)
    sign = Paint("#fff6e0", "#b0273a", text="SHARP\nFIELD")
    post = Paint("#6b4a2f", "#8f6844", texture=WOOD, cells=4)
    chest = Paint("#f2c14e", "#2d4b73", "#f7ead2", STRIPES, 9.0, slant=0.6)
    hours = Paint("#24476b", "#f6e7b4", text="OPEN\n24 h")
    parts = [
        wall((0, -1.95, 7.0), (16, 6.5), hedge),
        wall((0, 1.25, 5.0), (16, 8), floor, turn=FLAT),
        box((-1.9, 0.35, 6.1), (2.6, 1.8, 0.35), brick),
        box((0.2, 0.8, 4.6), (1.15, 0.9, 0.8), azulejo, turn=(0, 24, 0)),
        ball((0.2, 0.0, 4.6), 0.46, Paint("#2f7a3d", "#9fce5a", "#f0a7c0", LEAVES, 5.0, 8)),
        rectangle((1.75, -0.55, 5.4), (1.7, 0.9), sign, turn=(0, -14, -4)),
        box((1.75, 0.55, 5.46), (0.09, 1.4, 0.09), post),
        ball((1.25, 0.87, 3.6), 0.38, Paint("#f5f0e6", "#d6452b", texture=CHECKS, cells=6.0)),
        box((-1.15, 0.83, 3.5), (0.72, 0.84, 0.6), chest, turn=(0, -28, 0)),
        ball((-1.15, 0.16, 3.5), 0.3, Paint("#e9e4f2", "#8a4fb0", "#f6c453", LEAVES, 7.0, 21)),
        rectangle((-0.35, -0.95, 4.2), (0.95, 0.62), hours, turn=(0, 10, 5)),
    ]
    return parts, 2.0, 8.0, 0.45


def _shelf() -> Parts:
    """Books, a globe and tins on wooden shelves."""
    back = Paint("#7c5637", "#a97c50", texture=WOOD, cells=1.3)
    wood = Paint("#9a6b41", "#c79a68", texture=WOOD, cells=1.6, seed=4)
    vase = Paint("#f3ead8", "#2456a6", "#d9822b", TILES, 4.4)
    tin = Paint("#efe9dc", "#2f6f6a", texture=STRIPES, cells=9)
    parts = [
        wall((0, 0, 5.6), (12, 8), back),
        box((0, 1.42, 5.0), (9, 0.14, 1.2), wood),
        box((0, -0.12, 5.0), (9, 0.14, 1.2), wood),
        box((0, -1.66, 5.0), (9, 0.14, 1.2), wood),
    ]
    spines = (
        ("#b3263a", "#f6e7c1", "RADIANCE"),
        ("#1f5f8b", "#f2f2e9", "LIGHT"),
        ("#e7b93c", "#3a2a12", "MOTION"),
        ("#2e7d58", "#f4f0d8", "EVENTS"),
        ("#f0ead9", "#7b1e3a", "TIME"),
        ("#5b3b86", "#f5d76b", "FIELDS"),
    )
    left = -2.6
    for k, (ground, ink, text) in enumerate(spines):
        width, height = 0.3 + 0.07 * ((k * 5) % 3), 1.15 + 0.1 * ((k * 7) % 3)
        paint = Paint(ground, ink, text="\n".join(text))
        parts.append(box((left + width / 2, -0.19 - height / 2, 4.85), (width, height, 0.8), paint))
        left += width + 0.03
    parts += [
        ball((0.62, -0.72, 4.8), 0.53, Paint("#2f7fb5", "#e9d9a6", "#3f8f4f", MARBLE, 2.4, 5)),
        box((1.9, -0.66, 4.9), (0.9, 0.94, 0.5), vase),
        box((-1.85, 0.87, 4.7), (1.2, 0.96, 0.7), Paint("#fbf3dc", "#1c1c2a", text="TEA\nNo. 7")),
        ball((-0.72, 0.97, 4.55), 0.38, Paint("#f5efe3", "#c8324a", texture=CHECKS, cells=6.5)),
        box((0.35, 0.8, 4.7), (0.8, 1.1, 0.6), tin),
        box((1.6, 0.95, 4.6), (1.15, 0.8, 0.7), Paint("#f4d06f", "#8f2d56", text="PLUM\nJAM")),
        ball((2.0, 0.98, 3.7), 0.3, Paint("#7fb069", "#e6aa68", "#fff1d0", LEAVES, 7.0, 9)),
    ]
    return parts, 2.2, 6.0, 0.45


def _tiles() -> Parts:
    """Three leaning panels in front of a wall: few surfaces, fast to render."""
    poster = Paint("#fbf6ea", "#1d2b53", text="BLUR\nIS\nDATA")
    leaves = Paint("#fff3d6", "#b3263a", "#2e7d58", LEAVES, 5.0, 2)
    parts = [
        wall((0, 0, 6.0), (14, 10), Paint("#e9dcc3", "#2d6a8e", "#d98c3f", TILES, 1.25)),
        rectangle((-0.95, 0.1, 4.0), (1.3, 1.7), poster),
        rectangle((1.0, -0.15, 3.4), (0.9, 1.2), leaves, turn=(0, -25, 6)),
        ball((0.15, 0.62, 2.9), 0.3, Paint("#f5f0e6", "#2a9d8f", texture=CHECKS, cells=7.0)),
    ]
    return parts, 2.0, 6.5, 0.55


def _mobile() -> Parts:
    """Toys that swing in front of a brick wall, each with its own period."""
    checks = Paint("#f5f0e6", "#d6452b", texture=CHECKS, cells=5)
    tiles = Paint("#f3ead8", "#2456a6", "#e2a33c", TILES, 3.4)
    swing = Paint("#24476b", "#f6e7b4", text="SWING")
    parts = [
        wall((0, 0, 6.0), (14, 10), Paint("#8a4b3a", "#c98e6b", "#e6d9c6", BRICKS, 1.3)),
        ball((-0.8, 0.3, 4.0), 0.5, checks, sway=(0.45, 0.1, 0.0, 1.1)),
        box((0.8, -0.2, 4.4), (1.1, 1.1, 0.8), tiles, turn=(0, 24, 0), sway=(-0.2, 0.35, 0.2, 0.8)),
        box((0.0, 0.95, 3.3), (1.0, 0.4, 0.3), swing, sway=(0.3, 0.0, 0.2, 1.6)),
    ]
    return parts, 2.0, 6.5, 0.5


SCENES = {"garden": _garden, "shelf": _shelf, "tiles": _tiles, "mobile": _mobile}
"""Scenes by name; all are static but "mobile", whose toys sway."""
