import numpy as np
import pytest

from sharpfield.geometry.normalise import focus


def looking(centre, target):
    """A pose at a place that looks at a point; how it is rolled does not matter."""
    forward = np.asarray(target, float) - centre
    basis, _ = np.linalg.qr(np.stack([forward, [0.3, 0.5, 0.1], [0.9, -0.2, 0.4]], -1))
    forward = forward / np.linalg.norm(forward)
    return np.stack([basis[:, 1], basis[:, 2], forward, centre], -1)


def test_cameras_around_a_point_meet_there():
    target = np.array([1.0, -2.0, 0.5])
    centres = np.random.default_rng(0).normal(size=(9, 3)) * 4
    poses = np.stack([looking(centre, target) for centre in centres])
    np.testing.assert_allclose(focus(poses), target, atol=1e-9)


def test_it_is_the_least_squares_point():
    """Against the normal equations of the distances to the axes, solved by perturbation."""
    random = np.random.default_rng(1)
    poses = np.stack(
        [looking(c, random.normal(size=3) * 0.3) for c in random.normal(size=(7, 3)) * 4]
    )

    def squared_distance(point):
        offset, forward = point - poses[:, :, 3], poses[:, :, 2]
        along = (offset * forward).sum(-1, keepdims=True)
        return ((offset - along * forward) ** 2).sum()

    best = focus(poses)
    for step in 1e-3 * np.concatenate([np.eye(3), -np.eye(3)]):
        assert squared_distance(best) < squared_distance(best + step)


def test_parallel_axes_meet_nowhere():
    poses = np.tile(np.eye(3, 4), (4, 1, 1))
    poses[:, 0, 3] = np.arange(4)
    assert focus(poses) is None


def test_a_point_behind_the_cameras_is_not_looked_at():
    centres = np.array([[3.0, 0, 0], [0, 3, 0], [0, 0, 3], [-3, 0, 1]])
    outward = np.stack([looking(centre, 2 * centre) for centre in centres])
    assert focus(outward) is None


@pytest.mark.parametrize("count", [1, 2])
def test_few_cameras(count):
    poses = np.stack([looking(np.array(c, float), [0, 0, 0]) for c in ([3, 0, 0], [0, 4, 0])])
    found = focus(poses[:count])
    if count == 1:
        assert found is None
    else:
        np.testing.assert_allclose(found, 0, atol=1e-9)
