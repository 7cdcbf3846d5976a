from dataclasses import replace

import numpy as np
import pytest

from sharpfield.initialisation.triangulation import choose_pairs, find_features, match, triangulate
from tests.recipes.planes import CAMERA, FAR_WALL, NEAR_WALL, depth_at, images

BENT = replace(CAMERA, lens="brown", distortion=(-0.25, 0.05, 0.002, -0.001, 0.0))


@pytest.fixture(scope="module")
def cloud():
    return triangulate(images())


def test_points_lie_on_the_walls(cloud):
    off = np.abs(cloud.points[:, 2] - depth_at(cloud.points))
    assert len(off) > 60
    assert np.median(off) < 0.03 and (off < 0.15).mean() > 0.93
    share = (depth_at(cloud.points) == NEAR_WALL).mean()
    assert 0.2 < share < 0.8  # both walls have some


def test_points_project_to_where_they_are_seen(cloud):
    held = images()
    assert cloud.error_px.max() < 1.5 and np.median(cloud.error_px) < 0.4
    for view in range(len(held)):
        xy, depth = held.project(cloud.points[cloud.seen[view]], view)
        assert held.inside(xy).all() and (depth > 0).all()
    assert cloud.seen.sum(0).min() >= 3


def test_colours_are_those_of_the_images(cloud):
    held = images()
    xy, _ = held.project(cloud.points, 2)
    seen = cloud.seen[2]
    shown = held.light_at(xy[seen], 2)
    assert np.median(np.abs(shown - cloud.colours[seen])) < 0.05


def test_a_lens_that_bends_lines_changes_nothing():
    cloud = triangulate(images(camera=BENT))
    off = np.abs(cloud.points[:, 2] - depth_at(cloud.points))
    assert len(off) > 60 and np.median(off) < 0.03


def test_matches_obey_the_ratio_and_are_mutual():
    held = images()
    features = find_features(held)
    rows = match(held, features, (0, 2))
    assert len(rows) > 30
    assert len(np.unique(rows[:, 0])) == len(np.unique(rows[:, 1])) == len(rows)
    back = match(held, features, (2, 0))
    agree = {tuple(r) for r in rows} & {tuple(r[::-1]) for r in back}
    assert len(agree) > 0.8 * len(rows)


def test_wrong_poses_make_few_points():
    """The traces then lie elsewhere: what is found agrees by chance."""
    held = images()
    poses = held.poses.copy()
    poses[:, 1, 3] += 0.3 * np.array([0, 1, -1, 2, -2])
    assert len(triangulate(replace(held, poses=poses)).points) < 10


def test_pairs_have_parallax_and_look_the_same_way():
    held = images(6)
    pairs = choose_pairs(held)
    assert all(i < j for i, j in pairs) and len(set(pairs)) == len(pairs)
    still = replace(held, poses=np.repeat(held.poses[:1], 6, 0))
    assert choose_pairs(still) == []
    turned = held.poses.copy()
    turned[3:, :, [0, 2]] *= -1  # these look back
    assert all((i < 3) == (j < 3) for i, j in choose_pairs(replace(held, poses=turned)))


def test_two_images_are_enough():
    cloud = triangulate(images(2))
    assert len(cloud.points) > 20 and (cloud.seen.sum(0) == 2).all()
    assert np.abs(cloud.points[:, 2] - FAR_WALL).min() < 0.1


def test_without_anything_in_common_there_are_no_points():
    held = images()
    blank = replace(held, light=np.full_like(held.light, 0.5))
    for few in (blank, replace(held, light=held.light[:1], poses=held.poses[:1])):
        cloud = triangulate(few)
        assert cloud.points.shape == (0, 3) and cloud.colours.shape == (0, 3)
        assert cloud.seen.shape == (len(few), 0)
