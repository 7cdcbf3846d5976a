"""Moving scenes for cameras all around: rigid, articulated and deforming objects.

The world's z axis points up. Moving objects stay within 1.2 of the origin, in front of a uniform
grey background. Motions have a period of about a second and never stop. From a distance of 4 and an
elevation of 30 degrees, depths are 2 to 6.5. Some scenes include a static patterned table, which
makes no events; those of `ALONE` have nothing static, as in the data of EvDNeRF (WACV 2024).
"""

from collections.abc import Callable

import numpy as np

from sharpfield.core.errors import expect_one_of
from sharpfield.simulation.scenes.building import (
    Bodies,
    Map,
    Paint,
    Part,
    after,
    ball,
    box,
    build,
    placed,
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

NEAR, FAR = 2.0, 6.5
SUN = (-0.4, -0.6, 0.9)
GREY = ("#565c66", "#565c66")
TURN = 2 * np.pi

CRATE = Paint("#f2c14e", "#2d4b73", "#f7ead2", BRICKS, 6)
TABLE: list[Part] = [
    (0, box((0, 0, -1.1), (2.2, 2.2, 0.2), Paint("#efe3cc", "#2d6a8e", "#d98c3f", TILES, 1.4))),
    (0, ball((-0.85, -0.8, -0.82), 0.18, Paint("#e9e4f2", "#8a4fb0", "#f6c453", LEAVES, 6, 21))),
    (0, box((0.85, 0.8, -0.85), (0.3, 0.3, 0.3), CRATE)),
]
"""Static parts of some scenes."""


def moving_scene(name: str) -> Scene:
    """A scene by its name, one of `MOVING_SCENES`.

    Raises:
        OptionError: There is no such scene.
    """
    expect_one_of("moving scene", name, MOVING_SCENES)
    parts, maps = MOVING_SCENES[name]()
    surfaces = build([part for _, part in parts], sun=SUN, ambient=0.5, sky=GREY)
    body = np.array([number for number, _ in parts], np.int64)
    return Scene(name, surfaces, NEAR, FAR, Bodies(body, maps))


Moving = tuple[list[Part], Callable[[float], list[Map]]]


def _spinner() -> Moving:
    """Rigid: a rotor with three painted arms that turns, sways and bobs."""
    hub = Paint("#f3ead8", "#2456a6", "#e2a33c", TILES, 2.3)
    rod = Paint("#9a6b41", "#d9ab78", texture=WOOD, cells=5, seed=4)
    end = Paint("#fff3d6", "#b3263a", "#2e7d58", LEAVES, 5)
    parts = [
        *TABLE,
        (1, box((0, 0, 0), (0.46, 0.46, 0.7), hub)),
        (1, box((0.45, 0, 0.1), (0.9, 0.12, 0.12), rod)),
        (1, box((-0.42, 0, -0.15), (0.84, 0.12, 0.12), rod)),
        (1, box((0, 0.4, 0.2), (0.12, 0.8, 0.12), rod)),
        (1, ball((0.9, 0, 0.1), 0.2, Paint("#f5f0e6", "#d6452b", texture=CHECKS, cells=5))),
        (1, box((-0.82, 0, -0.15), (0.3, 0.3, 0.3), end)),
        (1, ball((0, 0.78, 0.2), 0.17, Paint("#2f7fb5", "#e9d9a6", "#3f8f4f", MARBLE, 4, 5))),
    ]

    def maps(t: float) -> list[Map]:
        sway, bob = 0.22 * np.sin(TURN * 1.1 * t + 0.4), 0.12 * np.sin(TURN * 0.9 * t)
        yaw = TURN * 0.45 * t + 0.3 * np.sin(TURN * 0.8 * t)
        return [placed((0, 0, bob - 0.1), yaw=yaw, pitch=sway, roll=0.6 * sway)]

    return parts, maps


def _arm() -> Moving:
    """Articulated: a robot arm of four joints whose gripper opens and closes."""
    steel = Paint("#d7dde4", "#5b6b7c", "#f2b134", STRIPES, 6, slant=0.5)
    limb = Paint("#e8743b", "#5c1f12", "#f9e0b8", BRICKS, 4.5)
    foot = Paint("#efe9dc", "#2f6f6a", texture=CHECKS, cells=5)
    forearm = Paint("#f3ead8", "#7b1e3a", "#2e7d58", TILES, 4)
    left = Paint("#f4d06f", "#8f2d56", texture=STRIPES, cells=8)
    right = Paint("#7fb069", "#24476b", texture=STRIPES, cells=8)
    parts = [
        *TABLE,
        (0, box((0, 0, -0.92), (0.62, 0.62, 0.16), foot)),
        (1, box((0, 0, 0.14), (0.46, 0.46, 0.28), steel)),
        (2, ball((0, 0, 0), 0.22, Paint("#f5f0e6", "#2456a6", texture=CHECKS, cells=5))),
        (2, box((0, 0, 0.36), (0.28, 0.3, 0.72), limb)),
        (3, ball((0, 0, 0), 0.2, Paint("#f5f0e6", "#d6452b", texture=CHECKS, cells=5.5))),
        (3, box((0, 0, 0.28), (0.23, 0.25, 0.56), forearm)),
        (4, box((0, 0, 0.07), (0.4, 0.2, 0.12), steel)),
        (5, box((0, 0, 0.1), (0.1, 0.18, 0.26), left)),
        (6, box((0, 0, 0.1), (0.1, 0.18, 0.26), right)),
    ]

    def maps(t: float) -> list[Map]:
        turret = placed((0, 0, -0.84), yaw=0.9 * np.sin(TURN * 0.55 * t + 0.3))
        shoulder = after(turret, placed((0, 0, 0.3), pitch=0.45 + 0.45 * np.sin(TURN * 0.8 * t)))
        bend = 1.0 + 0.55 * np.sin(TURN * 0.95 * t + 1.0)
        elbow = after(shoulder, placed((0, 0, 0.76), pitch=-bend))
        wrist = after(elbow, placed((0, 0, 0.56), yaw=1.2 * np.sin(TURN * 0.7 * t)))
        gap = 0.14 + 0.05 * np.sin(TURN * 1.6 * t)
        fingers = [after(wrist, placed((side * gap, 0, 0.12))) for side in (-1, 1)]
        return [turret, shoulder, elbow, wrist, *fingers]

    return parts, maps


LAYERS, LAYER = 4, 0.33
"""Layers of the jelly tower, and how high each is at rest."""


def _jelly() -> Moving:
    """Deforming: a tower of jelly that bends and swells, and a ball that breathes."""
    # Two checks per layer, so that the pattern runs on from one layer to the next.
    paint = Paint("#f08a9b", "#8f1d3f", texture=CHECKS, cells=2 / LAYER)
    middle = (0, 0, LAYER / 2)
    parts = [*TABLE]
    parts += [(k + 1, box(middle, (0.62, 0.62, LAYER), paint)) for k in range(LAYERS)]
    parts += [
        (LAYERS + 1, ball((0, 0, 0), 0.2, Paint("#f5f0e6", "#2a9d8f", texture=CHECKS, cells=5))),
        (LAYERS + 2, ball((0, 0, 0), 0.2, Paint("#f4d06f", "#24476b", "#ffffff", LEAVES, 5))),
    ]

    def maps(t: float) -> list[Map]:
        swell = 1 + 0.14 * np.sin(TURN * 0.9 * t)  # sideways; volume is kept
        height = 1 / swell**2
        lean = np.array([np.sin(TURN * 0.7 * t), np.sin(TURN * 1.0 * t + 1.3)]) * (0.3, 0.22)
        # Sideways offset grows with the square of height; a layer is sheared between its two ends.
        share = (np.arange(LAYERS + 1) / LAYERS) ** 2
        found = []
        for k in range(LAYERS):
            linear = np.diag([swell, swell, height])
            linear[:2, 2] = lean * (share[k + 1] - share[k]) / LAYER
            foot = [*(lean * share[k]), -1 + k * LAYER * height]
            found.append(np.concatenate([linear, np.array(foot)[:, None]], 1))
        top = placed((*lean, -1 + LAYERS * LAYER * height + 0.16), yaw=2.0 * np.sin(TURN * 0.6 * t))
        breath = 1 + 0.3 * np.sin(TURN * 1.2 * t)
        low = np.concatenate([breath * np.eye(3), [[0.72], [-0.55], [-1 + 0.2 * breath]]], 1)
        return [*found, top, low]

    return parts, maps


def _glider() -> Moving:
    """Rigid: a painted glider that comes down, turns and banks."""
    hull = Paint("#f3ead8", "#b3263a", "#2456a6", STRIPES, 2.4)
    wing = Paint("#f4d06f", "#24476b", texture=CHECKS, cells=2.1)
    tail = Paint("#2e7d58", "#f6e7b4", texture=CHECKS, cells=2.6)
    fin = Paint("#e8743b", "#5c1f12", texture=CHECKS, cells=2.6)
    parts = [
        (1, box((0, 0, 0), (1.4, 0.36, 0.36), hull)),
        (1, ball((0.7, 0, 0), 0.24, Paint("#f5f0e6", "#d6452b", texture=CHECKS, cells=4))),
        (1, box((0.12, 0, 0.14), (0.6, 1.84, 0.13), wing)),
        (1, box((-0.6, 0, 0.14), (0.3, 0.9, 0.12), tail)),
        (1, box((-0.62, 0, 0.38), (0.3, 0.12, 0.46), fin)),
        (1, ball((0.26, 0, 0.24), 0.2, Paint("#1d2b53", "#9fd3e8", texture=CHECKS, cells=4))),
    ]

    def maps(t: float) -> list[Map]:
        turned = -0.5 + 1.5 * t + 0.2 * np.sin(TURN * 0.9 * t)
        bank = 0.6 * np.sin(TURN * 0.8 * t + 0.4)
        dive = 0.15 + 0.2 * np.sin(TURN * 0.7 * t + 1.0)
        place = (0.22 * np.sin(2.6 * t - 1.3), 0.2 * np.cos(2.9 * t), 0.34 - 0.7 * t)
        return [placed(place, yaw=turned, pitch=dive, roll=bank)]

    return parts, maps


def _puppet() -> Moving:
    """Articulated: a puppet that hangs in the air, and swings its body, its arms and its legs."""
    coat = Paint("#c8324a", "#f6e7c1", texture=CHECKS, cells=2.4)
    sleeve = Paint("#f2c14e", "#2d4b73", texture=CHECKS, cells=3)
    trousers = Paint("#2f7fb5", "#efe9dc", texture=CHECKS, cells=2.6)
    parts = [
        (1, box((0, 0, 0.1), (0.42, 0.66, 0.72), coat)),
        (1, ball((0, 0, 0.7), 0.27, Paint("#f7dcc0", "#5c1f12", texture=CHECKS, cells=3.2))),
    ]
    for side in (0, 1):
        parts += [
            (2 + side, box((0, 0, -0.22), (0.22, 0.22, 0.48), sleeve)),
            (4 + side, box((0, 0, -0.2), (0.2, 0.2, 0.46), sleeve)),
            (6 + side, box((0, 0, -0.34), (0.28, 0.26, 0.72), trousers)),
        ]

    def maps(t: float) -> list[Map]:
        sway = 0.35 * np.sin(TURN * 0.8 * t)
        body = placed((0, 0.14 * np.sin(TURN * 0.9 * t), 0.1), yaw=1.3 * t - 0.5, roll=sway)
        arms, legs = np.sin(TURN * 0.9 * t + 0.5), np.sin(TURN * 0.9 * t + 0.2)
        shoulders = [
            placed((0, side * 0.45, 0.4), pitch=-0.8 - side * 0.9 * arms, roll=side * 0.3)
            for side in (-1, 1)
        ]
        shoulders = [after(body, shoulder) for shoulder in shoulders]
        elbows = [
            after(shoulder, placed((0, 0, -0.46), pitch=-0.7 - 0.6 * np.sin(TURN * t + k)))
            for k, shoulder in enumerate(shoulders)
        ]
        hips = [
            placed((0, side * 0.19, -0.26), pitch=side * 0.7 * legs, roll=side * 0.1)
            for side in (-1, 1)
        ]
        return [body, *shoulders, *elbows, *(after(body, hip) for hip in hips)]

    return parts, maps


ALONE: dict[str, Callable[[], Moving]] = {"glider": _glider, "puppet": _puppet}
"""Scenes without static parts."""

MOVING_SCENES = {"spinner": _spinner, "arm": _arm, "jelly": _jelly, **ALONE}
"""Scenes by name."""
