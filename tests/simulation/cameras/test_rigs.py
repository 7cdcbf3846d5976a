import numpy as np
import pytest

from sharpfield.core.errors import OptionError
from sharpfield.simulation.cameras.motions import Composed, motion
from sharpfield.simulation.cameras.rigs import StillCamera, hand_held, ring, ring_pose

PUBLISHED = [  # OpenGL axes: right, up, back
    [0.98481, 0.08682, -0.15038, -0.60153],
    [-0.17365, 0.49240, -0.85287, -3.41147],
    [0.0, 0.86603, 0.5, 2.0],
]


def azimuth(camera) -> float:
    x, y, _ = camera.pose[:, 3]
    return float(np.rad2deg(np.arctan2(y, x)) % 360)


def test_a_pose_is_as_published():
    flipped = ring_pose(-100) * [1, -1, -1, 1]
    np.testing.assert_allclose(flipped, PUBLISHED, atol=6e-6)


def test_cameras_look_at_the_origin():
    views = ring(5, held_out=2)
    for camera in [*views.learned, *views.held_out]:
        rotation, centre = camera.pose[:, :3], camera.pose[:, 3]
        np.testing.assert_allclose(rotation.T @ -centre, [0, 0, 4], atol=1e-12)
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0 and rotation[2, 1] < 0  # z is up in the image


def test_the_published_rings_are_half_a_step_apart():
    views = ring(18, held_out=18)
    learned, held_out = ([azimuth(c) for c in part] for part in (views.learned, views.held_out))
    np.testing.assert_allclose(learned, np.mod(-90.0 - 20 * np.arange(18), 360), atol=1e-9)
    np.testing.assert_allclose(held_out, np.mod(-100.0 - 20 * np.arange(18), 360), atol=1e-9)


def test_few_held_out_views_are_spread_over_the_ring():
    held_out = [azimuth(camera) for camera in ring(8, held_out=4).held_out]
    np.testing.assert_allclose(held_out, [247.5, 157.5, 67.5, 337.5])


def test_standing_cameras_stand_and_carried_ones_move():
    times = np.array([0, 300_000, 700_000])
    still = StillCamera(ring_pose(10)).poses(times)
    np.testing.assert_array_equal(still, np.stack([ring_pose(10)] * 3))
    base, path = ring_pose(-90), motion("shaky", 3)
    poses = Composed(StillCamera(base), path).poses(times)
    for pose, own in zip(poses, path.poses(times), strict=True):
        square = [np.concatenate([p, [[0, 0, 0, 1]]]) for p in (base, own)]
        np.testing.assert_allclose(pose, (square[0] @ square[1])[:3], atol=1e-12)


def test_a_hand_held_camera_has_held_out_ones_beside_it():
    views = hand_held("glide", seed=2, held_out=3)
    assert len(views.learned) == 1
    assert [azimuth(camera) for camera in views.held_out] == pytest.approx([250, 270, 290])


@pytest.mark.parametrize(("views", "held_out"), [(0, 0), (3, 4), (3, -1)])
def test_impossible_rings_are_refused(views, held_out):
    with pytest.raises(OptionError, match="at least one view"):
        ring(views, held_out=held_out)
