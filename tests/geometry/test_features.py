"""SIFT features and their matches."""

import numpy as np
import pytest

from sharpfield.geometry.two_views import RATIO, mutual_matches, sift_features, squared_differences


def texture(seed: int = 0) -> np.ndarray:
    """Smooth blobs, 80 x 96."""
    random = np.random.default_rng(seed)
    rows, columns = np.mgrid[:80, :96]
    image = np.zeros((80, 96))
    for _ in range(60):
        y, x, size = random.uniform(0, 80), random.uniform(0, 96), random.uniform(1.5, 4)
        value = random.uniform(-80, 80)
        image += value * np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / (2 * size**2))
    return np.clip(image + 128, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("root", [False, True])
def test_features_of_a_shifted_image_match_by_the_shift(root: bool):
    image = texture()
    one, two = sift_features(
        [image, np.roll(image, (3, -5), (0, 1))], most=500, contrast=0.01, root=root
    )
    rows = mutual_matches(squared_differences(one, two))
    shift = two.xy[rows[:, 1]] - one.xy[rows[:, 0]]
    assert len(rows) > 15
    assert (np.abs(shift - [-5, 3]).max(-1) < 0.2).mean() > 0.8
    assert np.linalg.norm(one.descriptors, axis=-1) == pytest.approx(1, abs=0.05)
    assert len(np.unique(one.xy, axis=0)) == len(one.xy), "one for each position"


def test_an_even_image_has_no_features():
    (found,) = sift_features([np.full((40, 50), 90, np.uint8)], most=10, contrast=0.01)
    assert found.xy.shape == (0, 2) and found.descriptors.shape == (0, 128)
    assert mutual_matches(squared_differences(found, found)).shape == (0, 2)


def test_matches_against_a_slow_loop():
    random = np.random.default_rng(3)
    difference = random.uniform(0.1, 2, (30, 40))
    difference[random.random((30, 40)) < 0.7] = np.inf
    difference[np.arange(20), random.permutation(40)[:20]] *= 0.05

    def clear(values: np.ndarray) -> int:
        order = np.argsort(values)
        best, second = values[order[0]], values[order[1]]
        return int(order[0]) if np.isfinite(best) and best < RATIO**2 * second else -1

    wanted = []
    for i in range(30):
        j = clear(difference[i])
        if j >= 0 and clear(difference[:, j]) == i:
            wanted.append((i, j))
    assert [tuple(row) for row in mutual_matches(difference)] == wanted and len(wanted) > 5
