import numpy as np
import pytest

from sharpfield.simulation.scenes.building import (
    Bodies,
    Paint,
    after,
    ball,
    box,
    build,
    placed,
    rectangle,
)
from sharpfield.simulation.scenes.static import Scene
from sharpfield.simulation.scenes.textures import CHECKS, TILES

PAINT = Paint("#f3ead8", "#2456a6", "#e2a33c", TILES, 3.0)
PARTS = [
    box((0.2, 0.1, 0.3), (1.2, 0.9, 0.7), PAINT, turn=(20, 30, 0)),
    ball((-0.7, 0.4, 0.0), 0.5, Paint("#f5f0e6", "#d6452b", texture=CHECKS, cells=5.0)),
    rectangle((0, 0, 1.0), (3, 2), PAINT, turn=(10, 0, 5)),
]


def scene(parts, *maps) -> Scene:
    """Parts, all on body 1 if there are maps; evenly lit."""
    body = np.full(len(parts), len(maps[:1]), np.int64)
    surfaces = build(parts, ambient=1.0, sky=("#808080", "#808080"))
    return Scene("test", surfaces, 0.5, 20.0, Bodies(body, lambda t: maps))


def rays(count: int = 3000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    draw = np.random.default_rng(seed)
    origin = draw.normal(size=(count, 3)) * 0.2 + [0, 0, -6]
    return origin, draw.uniform(-1.2, 1.2, (count, 3)) - origin


def test_a_rigid_body_looks_as_from_a_camera_that_moves_instead():
    move = after(placed((0.3, -0.2, 0.4), yaw=0.7, pitch=-0.4), placed((0, 0.1, 0), roll=0.9))
    origin, direction = rays()
    rgb, depth = scene(PARTS, move).light(origin, direction)
    inside = (origin - move[:, 3]) @ move[:, :3]
    expected, far = scene(PARTS).light(inside, direction @ move[:, :3])
    np.testing.assert_allclose(depth, far, rtol=1e-5)
    assert np.quantile(np.abs(rgb - expected), 0.999) < 1e-4


def test_a_stretched_box_is_a_larger_box():
    stretch = np.diag([1.5, 0.8, 1.2])
    small = box((0, 0, 0), (1, 1, 1), Paint("#808080"))
    large = box((0, 0, 0), (1.5, 0.8, 1.2), Paint("#808080"))
    origin, direction = rays()
    rgb, depth = scene([small], np.concatenate([stretch, np.zeros((3, 1))], 1)).light(
        origin, direction
    )
    expected, far = scene([large]).light(origin, direction)
    np.testing.assert_allclose(depth, far, rtol=1e-6)
    np.testing.assert_allclose(rgb, expected, atol=1e-5)


def test_a_swollen_ball_keeps_its_pattern():
    """Twice as large from twice as far away: the same image, texture included."""
    checks = Paint("#f5f0e6", "#d6452b", texture=CHECKS, cells=8.0)
    origin, direction = rays()
    rest = scene([ball((0.1, 0, 0), 0.6, checks)])
    twice = scene([ball((0.1, 0, 0), 0.6, checks)], 2 * np.eye(3, 4))
    rgb, depth = twice.light(2 * origin, direction)
    expected, far = rest.light(origin, direction)
    hit = far < 1e8
    assert 0.1 < hit.mean() < 0.9
    np.testing.assert_allclose(depth[hit], 2 * far[hit], rtol=1e-5)
    np.testing.assert_allclose(rgb, expected, atol=1e-4)


def test_a_sheared_box_is_met_where_its_sheared_faces_are():
    shear = np.eye(3, 4)
    shear[0, 2] = 0.8
    origin, direction = rays()
    _, depth = scene([box((0, 0, 0), (1, 1, 1), Paint("#808080"))], shear).light(origin, direction)
    hit = depth < 10
    assert 0.1 < hit.mean() < 0.9
    points = origin[hit] + depth[hit, None] * direction[hit]
    own = points @ np.linalg.inv(shear[:, :3]).T
    np.testing.assert_allclose(np.abs(own).max(1), 0.5, atol=1e-5)


def test_shading_follows_the_deformed_face():
    """A flattened wedge faces the sun as its normal does, not as its axes do."""
    lean = np.eye(3, 4)
    lean[2, 0] = 1.0  # the face z = -0.5 now rises with x
    surfaces = build([box((0, 0, 0), (4, 4, 1), Paint("#ffffff"))], sun=(0, 0, -1), ambient=0.0)
    place = Scene("wedge", surfaces, 0.5, 20.0, Bodies(np.array([1]), lambda t: [lean]))
    rgb, _ = place.light(np.array([[0.0, 0, -6]]), np.array([[0.0, 0, 1]]))
    assert rgb[0, 0] == pytest.approx(np.sqrt(0.5), abs=1e-3)


def test_body_0_stands_still():
    parts = [PARTS[0], ball((3, 0, 0), 0.2, PAINT)]
    moves = Bodies(np.array([0, 1]), lambda t: [placed((t, 0, 0))])
    place = Scene("test", build(parts), 0.5, 20.0, moves)
    now, later = place.at(0.0), place.at(0.5)
    np.testing.assert_array_equal(now.shape[0], later.shape[0])
    np.testing.assert_allclose(later.shape[1] - now.shape[1], np.eye(18)[1] * 0.5, atol=1e-12)
