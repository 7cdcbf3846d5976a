import numpy as np
import pytest

from sharpfield.core.errors import OptionError
from sharpfield.simulation.cameras.motions import MOTIONS, motion
from sharpfield.simulation.scenes.building import Paint, ball, box, build, rectangle
from sharpfield.simulation.scenes.static import SCENES, Scene, scene
from sharpfield.simulation.scenes.surfaces import DARKEST
from sharpfield.simulation.scenes.textures import BRICKS, CHECKS, LEAVES, STRIPES, TILES, page
from sharpfield.simulation.static_capture import Rig, view

HOME = np.eye(3, 4)
SMALL = Rig((96, 64)).camera()


def made(*parts, ambient: float = 1.0) -> Scene:
    """A scene for a test, evenly lit unless told."""
    return Scene("test", build(list(parts), ambient=ambient), 0.5, 20.0)


@pytest.mark.parametrize("name", SCENES)
def test_scenes_are_within_their_bounds(name):
    place = scene(name)
    for path in MOTIONS:
        times = np.arange(0, 1_000_000, 90_000)
        for t_us, pose in zip(times, motion(path, 1).poses(times), strict=True):
            rgb, depth = view(place, SMALL, pose, 1e-6 * float(t_us))
            assert rgb.dtype == np.float32 and rgb.min() >= np.float32(DARKEST) and rgb.max() <= 1
            assert place.near < depth.min() and depth.max() < place.far
            display = rgb ** (1 / 2.2)
            assert 0.3 < display.mean() < 0.75 and display.std() > 0.1


def test_a_point_looks_the_same_from_everywhere():
    """Lambert: follow what one camera sees to where another sees it."""
    place, camera = scene("tiles"), Rig((240, 160)).camera()
    rgb, depth = view(place, camera, HOME)
    grid = camera.grid().double().numpy()
    flat = camera.direction(camera.grid().double()).numpy()
    points = (flat / flat[..., 2:] * depth[..., None]).reshape(-1, 3)
    origin = np.array([[0.1, -0.05, 0.0]])
    across = points - origin
    again, far = place.light(origin, across, footprint_rad=1 / camera.fx_px)
    same = np.abs(far - 1) < 1e-3  # nothing came between
    assert 0.9 < same.mean() < 1.0
    error = np.abs(again - rgb.reshape(-1, 3)).max(1)[same]
    assert np.quantile(error, 0.97) < 0.02, "apart from silhouettes, which are soft"
    assert grid.shape[:2] == rgb.shape[:2]


@pytest.mark.parametrize(
    ("part", "depth"),
    [
        (rectangle((0, 0, 3.0), (4, 4), Paint("#808080")), lambda x, y: 3.0),
        (ball((0, 0, 4.0), 1.0, Paint("#808080")), lambda x, y: _ball_depth(x, y)),
        (box((0, 0, 4.0), (9, 9, 2), Paint("#808080")), lambda x, y: 3.0),
        (
            rectangle((0, 0, 5.0), (9, 30), Paint("#808080"), turn=(45, 0, 0)),
            lambda x, y: 5 / (1 - y),
        ),
    ],
    ids=["rectangle", "ball", "box", "leaning"],
)
def test_depth_in_closed_form(part, depth):
    draw = np.random.default_rng(0)
    sides = draw.uniform(-0.15, 0.15, (40, 2))
    direction = np.concatenate([sides, np.ones((40, 1))], 1)
    _, got = made(part).light(np.zeros((1, 3)), direction)
    expected = [depth(x, y) for x, y in sides]
    np.testing.assert_allclose(got, expected, rtol=1e-5)


def _ball_depth(x: float, y: float) -> float:
    a, b, c = x * x + y * y + 1, -8.0, 15.0
    return (-b - np.sqrt(b * b - 4 * a * c)) / (2 * a)


def test_what_is_near_hides_what_is_far():
    red, blue = Paint("#ff0000"), Paint("#0000ff")
    far = rectangle((0, 0, 5.0), (20, 20), red)
    near = rectangle((0.5, 0, 2.0), (1, 1), blue)
    for parts in ((far, near), (near, far)):
        rgb, depth = made(*parts).light(np.zeros((1, 3)), np.array([[0.2, 0, 1.0], [-0.2, 0, 1]]))
        np.testing.assert_allclose(rgb, [[DARKEST, DARKEST, 1], [1, DARKEST, DARKEST]], atol=1e-6)
        np.testing.assert_allclose(depth, [2, 5])


def test_a_silhouette_covers_a_pixel_by_halves():
    wall = rectangle((0, 0, 5.0), (20, 20), Paint("#000000"))
    card = rectangle((1, 0, 2.0), (2, 20), Paint("#ffffff"))  # its left edge straight ahead
    share = np.linspace(-0.5, 0.5, 11)
    across = np.stack([share * 0.01, 0 * share, np.ones(11)], 1)
    rgb, _ = made(wall, card).light(np.zeros((1, 3)), across, footprint_rad=0.01)
    np.testing.assert_allclose(rgb[:, 0], np.maximum(0.5 + share, DARKEST), atol=1e-4)


@pytest.mark.parametrize("texture", [CHECKS, STRIPES, TILES, BRICKS, LEAVES])
def test_a_wide_pixel_sees_the_mean_of_narrow_ones(texture):
    """Edges are as soft as a pixel is wide: drawing small equals drawing large and shrinking."""
    paint = Paint("#202020", "#f0f0f0", "#808080", texture, 2.0)
    place, small = made(rectangle((0, 0, 4.0), (20, 20), paint)), Rig((60, 40)).camera()
    fine = view(place, small.scaled(6.0), HOME)[0]
    downscaled = fine.reshape(40, 6, 60, 6, 3).mean((1, 3))
    direct = view(place, small, HOME)[0]
    across = small.direction(small.grid().double()).reshape(-1, 3).numpy()
    aliased = place.light(np.zeros((1, 3)), across, footprint_rad=1e-4)[0].reshape(40, 60, 3)
    assert (direct - downscaled).std() < 0.45 * (aliased - downscaled).std()
    assert abs(direct.mean() - downscaled.mean()) < 0.025


def test_shadows_fall_away_from_the_sun():
    ground = rectangle((0, 1, 5.0), (20, 20), Paint("#ffffff"), turn=(90, 0, 0))
    thing = ball((0, 0.0, 5.0), 0.5, Paint("#ffffff"))
    bare, shaded = made(ground, ambient=0.3), made(ground, thing, ambient=0.3)
    below = np.array([[0.35, 1.0, 5.5]])  # opposite the sun, which is up, left and behind us
    for place, least, most in ((bare, 0.6, 1.0), (shaded, 0.29, 0.4)):
        rgb, _ = place.light(np.array([[0.35, 0.5, 5.5]]), below - [[0.35, 0.5, 5.5]])
        assert least < rgb[0, 0] < most


def test_what_sways_moves_and_comes_back():
    place = made(ball((0, 0, 4.0), 0.5, Paint("#ffffff"), sway=(1.0, 0, 0, 2.0)))
    across = np.array([[0.0, 0, 1], [0.25, 0, 1]])
    seen = [place.light(np.zeros((1, 3)), across, t)[1] < 10 for t in (0.0, 0.5, 1.0, 2.0)]
    assert [list(s) for s in seen] == [[1, 0], [0, 1], [1, 0], [1, 0]]


def test_only_the_mobile_moves():
    for name in SCENES:
        early, late = (view(scene(name), SMALL, HOME, t)[0] for t in (0.0, 0.2))
        assert (early != late).any() == (name == "mobile")


def test_letters_are_signed_distances():
    sheet = page("I", 1.0)
    assert sheet.shape == (320, 320)
    assert sheet[160, 160] > 2 and sheet[160, 20] < -50
    step = np.abs(np.diff(sheet, axis=1))
    assert step.max() < 2.01, "a distance changes by no more than one per sample, by two at an edge"


def test_rays_may_each_have_an_origin():
    place = scene("tiles")
    origin = np.array([[0.0, 0, 0], [0.2, 0.1, 0]])
    across = np.array([[0.1, 0.1, 1], [0.1, 0.1, 1]])
    both = place.light(origin, across)[0]
    one = [place.light(origin[i : i + 1], across[i : i + 1])[0][0] for i in range(2)]
    np.testing.assert_array_equal(both, one)
    assert (both[0] != both[1]).any()


def test_no_such_scene():
    with pytest.raises(
        OptionError, match="unknown scene\n  got    attic\n  do     use one of garden"
    ):
        scene("attic")
