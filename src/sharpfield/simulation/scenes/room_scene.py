"""A furnished room to walk through: 6 m by 5 m, 2.6 m high, textured on every side.

Axes are those of a camera at eye height in the middle (x right, y down, z away), in metres: the
floor lies at y = 1.5, the ceiling at -1.1. Furniture stands along the walls and a table in the
middle, so that things hide each other, and nothing is nearer to the walk than half a metre.
"""

from sharpfield.simulation.scenes.building import (
    FLAT,
    Paint,
    Surface,
    ball,
    box,
    build,
    cylinder,
    wall,
)
from sharpfield.simulation.scenes.static import Scene
from sharpfield.simulation.scenes.textures import (
    BRICKS,
    CHECKS,
    LEAVES,
    MARBLE,
    STRIPES,
    TILES,
    WOOD,
)

ROOM = (6.0, 5.0)
"""Width (x) and depth (z) of the room."""
FLOOR, CEILING = 1.5, -1.1
"""y of both."""
BEYOND = 0.4
"""How much larger walls are than the room."""
NEAR, FAR = 0.3, 7.5
"""Depths that contain everything seen on the walk."""

SUN = (-0.35, -0.9, -0.25)
"""Towards the lamp under the ceiling; walls and ceiling throw no shadow."""
AMBIENT = 0.62


def room() -> Scene:
    """The room."""
    parts = [*_shell(), *_table(), *_shelf(), *_sofa(), *_desk(), *_corner()]
    return Scene("room", build(parts, sun=SUN, ambient=AMBIENT), NEAR, FAR)


def _shell() -> list[Surface]:
    """Floor, ceiling, four walls, and what hangs on them."""
    middle = (FLOOR + CEILING) / 2
    # Walls go on behind each other, so that no light comes in where they meet.
    width, depth = ROOM[0] + BEYOND, ROOM[1] + BEYOND
    height = FLOOR - CEILING + BEYOND
    brick = Paint("#b5573f", "#d98d62", "#e8dccb", BRICKS, 2.2)
    paper = Paint("#e9e0cc", "#b9c7a5", "#d08a6a", LEAVES, 3.4, 5)
    stripes = Paint("#dfe6ea", "#a9bfd0", "#ffffff", STRIPES, 5.0)
    plaster = Paint("#efe6d6", "#d8c6a4", "#c4a57c", MARBLE, 1.3, 11)
    floor = Paint("#8a5a34", "#b98552", texture=WOOD, cells=2.2, seed=3)
    ceiling = Paint("#f1eee6", "#dcd6c8", "#cfc4ae", TILES, 1.6, 7)
    walls = [
        wall((0, middle, ROOM[1] / 2), (width, height), brick),
        wall((0, middle, -ROOM[1] / 2), (width, height), paper, turn=(0, 180, 0)),
        wall((ROOM[0] / 2, middle, 0), (depth, height), plaster, turn=(0, 90, 0)),
        wall((-ROOM[0] / 2, middle, 0), (depth, height), stripes, turn=(0, -90, 0)),
        wall((0, FLOOR, 0), (width, depth), floor, turn=FLAT),
        wall((0, CEILING, 0), (width, depth), ceiling, turn=FLAT),
    ]
    rug = Paint("#7d2f3a", "#e8c98f", "#2d4b73", TILES, 1.9, 2)
    poster = Paint("#24476b", "#f6e7b4", text="LIGHT\nAND\nTIME")
    sign = Paint("#fff6e0", "#b0273a", text="SHARP\nFIELD")
    image = Paint("#fbf6ea", "#1d2b53", text="BLUR\nIS\nDATA")
    leaves = Paint("#1f4d2b", "#86b94e", "#e5d36b", LEAVES, 6.0, 3)
    door = Paint("#6f4a2d", "#8f6844", texture=WOOD, cells=3.0, seed=8)
    hung = [
        wall((0, FLOOR - 0.005, 0.05), (3.0, 2.2), rug, turn=FLAT),
        wall((-0.2, -0.25, 2.46), (1.3, 1.0), poster),
        wall((1.9, -0.2, -2.46), (1.2, 0.8), sign, turn=(0, 180, 0)),
        wall((2.96, -0.15, -0.3), (1.0, 1.1), image, turn=(0, 90, 0)),
        wall((-2.96, -0.2, 0.3), (1.2, 1.0), leaves, turn=(0, -90, 0)),
        wall((0.3, 0.45, -2.47), (0.9, 2.1), door, turn=(0, 180, 0)),
    ]
    return walls + hung


def _table() -> list[Surface]:
    """A round table with things on it, in the middle."""
    wood = Paint("#a8743f", "#d6a86a", texture=WOOD, cells=4.0, seed=1)
    book = Paint("#1f5f8b", "#f2f2e9", text="RAYS")
    return [
        cylinder((0, 0.78, 0), 0.55, 0.06, wood),
        cylinder((0, 1.15, 0), 0.07, 0.7, wood),
        cylinder((0, 1.48, 0), 0.3, 0.04, wood),
        cylinder((-0.22, 0.62, 0.12), 0.1, 0.26, Paint("#f3ead8", "#2456a6", "#e2a33c", TILES, 14)),
        ball((-0.22, 0.42, 0.12), 0.17, Paint("#2f7a3d", "#9fce5a", "#f0a7c0", LEAVES, 13, 8)),
        box((0.2, 0.7, -0.1), (0.26, 0.1, 0.18), Paint("#b3263a", "#f6e7c1", text="FIELDS")),
        box((0.22, 0.62, -0.09), (0.22, 0.06, 0.16), book, turn=(0, 25, 0)),
        ball((0.12, 0.66, 0.28), 0.09, Paint("#f5f0e6", "#d6452b", texture=CHECKS, cells=22)),
    ]


def _shelf() -> list[Surface]:
    """Books and tins on boards, along the wall ahead."""
    board = Paint("#9a6b41", "#c79a68", texture=WOOD, cells=3.0, seed=4)
    parts = [box((1.65, y, 2.28), (1.7, 0.05, 0.4), board) for y in (1.45, 0.95, 0.45, -0.05, -0.5)]
    parts += [box((x, 0.5, 2.28), (0.05, 2.0, 0.4), board) for x in (0.8, 2.5)]
    covers = (
        ("#b3263a", "#f6e7c1", "RADIANCE"),
        ("#e7b93c", "#3a2a12", "MOTION"),
        ("#2e7d58", "#f4f0d8", "EVENTS"),
        ("#f0ead9", "#7b1e3a", "TIME"),
        ("#5b3b86", "#f5d76b", "DEPTH"),
    )
    left = 0.9
    for k, (ground, ink, text) in enumerate(covers):
        width, height = 0.14 + 0.03 * (k * 5 % 3), 0.38 + 0.03 * (k * 7 % 3)
        paint = Paint(ground, ink, text="\n".join(text))
        parts.append(box((left + width / 2, 0.425 - height / 2, 2.24), (width, height, 0.3), paint))
        left += width + 0.015
    tin, jar = Paint("#f4d06f", "#8f2d56", "#fff1d0", STRIPES, 16), Paint("#efe9dc", "#2f6f6a")
    return [
        *parts,
        cylinder((1.15, 0.77, 2.24), 0.12, 0.31, tin),
        box((1.6, 0.74, 2.24), (0.34, 0.37, 0.26), Paint("#fbf3dc", "#1c1c2a", text="TEA\nNo 7")),
        cylinder((2.1, 0.76, 2.24), 0.13, 0.33, jar),
        ball((1.2, -0.22, 2.26), 0.15, Paint("#2f7fb5", "#e9d9a6", "#3f8f4f", MARBLE, 8, 5)),
        box((1.85, -0.2, 2.26), (0.5, 0.24, 0.26), Paint("#24476b", "#f6e7b4", text="OPEN")),
        box((1.65, 1.2, 2.26), (0.9, 0.4, 0.3), Paint("#d9b99b", "#8c3f2d", "#efe3cf", BRICKS, 6)),
    ]


def _sofa() -> list[Surface]:
    """A sofa with cushions, along the left wall."""
    cloth = Paint("#3d5f6f", "#5d8796", "#e9e2cf", TILES, 5.5, 6)
    cushion = Paint("#f2c14e", "#2d4b73", "#f7ead2", STRIPES, 16, slant=0.6)
    return [
        box((-2.5, 1.2, 0.3), (0.8, 0.4, 2.0), cloth),
        box((-2.82, 0.85, 0.3), (0.25, 0.7, 2.0), cloth),
        box((-2.5, 1.02, -0.82), (0.8, 0.55, 0.25), cloth),
        box((-2.5, 1.02, 1.42), (0.8, 0.55, 0.25), cloth),
        box((-2.55, 0.82, 0.85), (0.16, 0.42, 0.42), cushion, turn=(0, 12, 18)),
        ball((-2.45, 0.83, -0.2), 0.2, Paint("#e9e4f2", "#8a4fb0", "#f6c453", LEAVES, 12, 21)),
    ]


def _desk() -> list[Surface]:
    """A desk with a screen and a lamp, and a stool, along the right wall."""
    wood = Paint("#7c5637", "#a97c50", texture=WOOD, cells=3.4, seed=9)
    metal = Paint("#c9ced6", "#6f7a8a", texture=STRIPES, cells=24)
    seat = Paint("#b0273a", "#f3ead8", texture=CHECKS, cells=9)
    screen = Paint("#14203a", "#7fd1ff", text="60 FPS")
    legs = [cylinder((x, 1.15, z), 0.035, 0.7, metal) for x in (2.3, 2.9) for z in (-0.95, 0.55)]
    return [
        box((2.6, 0.77, -0.2), (0.75, 0.06, 1.7), wood),
        *legs,
        box((2.72, 0.45, -0.2), (0.75, 0.48, 0.05), screen, turn=(0, 90, 0)),
        cylinder((2.72, 0.72, -0.2), 0.1, 0.05, metal),
        cylinder((2.65, 0.58, 0.42), 0.025, 0.34, metal),
        ball((2.65, 0.36, 0.42), 0.13, Paint("#f7ead2", "#e2a33c", texture=CHECKS, cells=13)),
        cylinder((1.95, 1.02, 0.1), 0.2, 0.08, seat),
        cylinder((1.95, 1.28, 0.1), 0.05, 0.45, metal),
        box((2.55, 0.69, -0.75), (0.25, 0.1, 0.3), Paint("#7fb069", "#1c1c2a", text="NOTES")),
    ]


def _corner() -> list[Surface]:
    """A plant, a chest, a stack of boxes and a column in the corners."""
    carton = Paint("#c8a06a", "#8c5a2b", "#f2e3c6", BRICKS, 5.0, 4)
    return [
        cylinder((-2.4, 1.25, 2.0), 0.24, 0.5, Paint("#b5573f", "#f0d9b5", "#7b3a28", TILES, 6)),
        cylinder((-2.4, 0.8, 2.0), 0.04, 0.5, Paint("#6b4a2f", "#8f6844", texture=WOOD, cells=9)),
        ball((-2.4, 0.3, 2.0), 0.42, Paint("#24612f", "#86b94e", "#d9e39a", LEAVES, 7, 13)),
        box((-1.1, 1.2, 2.2), (0.9, 0.6, 0.5), Paint("#2d6a8e", "#e9dcc3", "#d98c3f", TILES, 4.5)),
        cylinder((-1.2, 0.75, 2.2), 0.13, 0.3, Paint("#efe9dc", "#b0273a", "#f2c14e", TILES, 9, 3)),
        box((-1.6, 1.2, -2.15), (0.7, 0.6, 0.6), carton, turn=(0, 14, 0)),
        box((-1.55, 0.7, -2.15), (0.5, 0.4, 0.45), carton, turn=(0, -18, 0)),
        box((-2.6, 0.95, -1.9), (0.6, 1.1, 0.7), Paint("#5b3b86", "#f5d76b", "#e9e4f2", TILES, 4)),
        cylinder((2.6, 0.2, -2.1), 0.2, 2.6, Paint("#e9dcc3", "#7c8f6a", "#b5573f", STRIPES, 9)),
        box((1.5, 1.25, -2.2), (0.8, 0.5, 0.45), Paint("#e2a33c", "#24476b", "#fff6e0", TILES, 5)),
        ball((1.5, 0.82, -2.2), 0.18, Paint("#d6452b", "#f5f0e6", "#2a9d8f", MARBLE, 8, 2)),
    ]
