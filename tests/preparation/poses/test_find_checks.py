"""A plane is told from things at several depths, by maps made of points alone."""

import numpy as np
import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.preparation.poses.find import advice, relief
from sharpfield.preparation.poses.mapping import SfmMap

FOCAL_PX, VIEWS, POINTS = 180.0, 9, 240


def mapped(relief_of_depth: float, *, sideways: float = 0.25, few: int = 0) -> SfmMap:
    """What a camera sees that passes a leaning wall five away, drawn in noise of half a px.

    Args:
        relief_of_depth: How far points lie off the wall at most, as a share of its distance.
        sideways: How far the camera goes, as a share of the distance.
        few: Of the points, how many lie one further before the wall.
    """
    draw = np.random.default_rng(3)
    camera = Camera(192, 128, FOCAL_PX, FOCAL_PX, 96.0, 64.0)
    points = np.concatenate([draw.uniform(-2, 2, (POINTS, 2)), np.full((POINTS, 1), 5.0)], -1)
    points[:, 2] += 0.3 * points[:, 0] + 5 * relief_of_depth * draw.uniform(-1, 1, POINTS)
    points[:few, 2] -= 1
    poses = np.tile(np.eye(3, 4), (VIEWS, 1, 1))
    poses[:, 0, 3] = np.linspace(-0.5, 0.5, VIEWS) * 5 * sideways
    sharing = np.ones((VIEWS, POINTS), bool)
    # A map is made of what was seen, so noise bends it: half a px, averaged over nine images.
    points += 0.5 / 3 * 5 / FOCAL_PX * draw.standard_normal((POINTS, 3)) * [1, 1, 4]
    return SfmMap(
        registered=np.ones(VIEWS, bool),
        poses=poses,
        camera=camera,
        points=points,
        point_error_px=np.full(POINTS, 0.6),
        observations=np.argwhere(sharing).astype(np.int64),
        error_px=np.full(VIEWS, 0.6),
    )


def test_a_wall_is_flat_and_says_so_with_numbers() -> None:
    shown = relief(mapped(0.0))
    assert shown is not None and shown.flat
    assert shown.off_plane < 0.02 and shown.thickness < 0.01
    told = advice(shown, "given")
    assert told is not None
    assert "nearly flat" in told[0] and "focal length" not in told[0] + told[1]
    assert "--preset refine" in told[1] and "sideways" in told[1]


def test_things_at_several_depths_are_not_flat() -> None:
    shown = relief(mapped(0.3))
    assert shown is not None and not shown.flat
    assert shown.off_plane > 0.5 and shown.thickness == pytest.approx(0.14, abs=0.05)
    assert advice(shown, "find") is None


def test_what_departs_from_the_plane_grows_with_depth_and_with_motion() -> None:
    deep = [relief(mapped(share)) for share in (0.0, 0.05, 0.1, 0.3)]
    far = [relief(mapped(0.1, sideways=share)) for share in (0.02, 0.1, 0.4)]
    for row in (deep, far):
        off = [shown.off_plane for shown in row if shown is not None]
        assert len(off) == len(row) and off == sorted(off) and off[0] < 0.05 < 0.3 < off[-1]


def test_a_few_things_before_a_wall_do_not_tilt_its_plane() -> None:
    shown, bare = relief(mapped(0.0, few=POINTS // 5)), relief(mapped(0.0))
    assert shown is not None and bare is not None and not shown.flat
    assert shown.off_plane == pytest.approx(0.2, abs=0.05)
    assert shown.thickness < 2 * bare.thickness


def test_without_a_known_lens_the_focal_length_is_unsure_too() -> None:
    told = advice(relief(mapped(0.0)), "find")
    assert told is not None
    assert "and the focal length" in told[0] and "--intrinsics given" in told[1]


def test_the_world_it_is_in_does_not_matter() -> None:
    made = mapped(0.1)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double())[
        0
    ].numpy()
    turn *= np.sign(np.linalg.det(turn))
    poses = np.concatenate([turn @ made.poses[:, :, :3], 7 * (turn @ made.poses[:, :, 3:]) + 2], -1)
    moved = SfmMap(
        made.registered, poses, made.camera, 7 * made.points @ turn.T + 2, made.point_error_px,
        made.observations, made.error_px,
    )  # fmt: skip
    here, there = relief(made), relief(moved)
    assert here is not None and there is not None
    assert (there.off_plane, there.thickness) == pytest.approx((here.off_plane, here.thickness))


def test_images_that_share_too_little_say_nothing() -> None:
    made = mapped(0.0)
    alone = made.observations[made.observations[:, 0] == made.observations[:, 1] % VIEWS]
    lonely = SfmMap(
        made.registered, made.poses, made.camera, made.points, made.point_error_px, alone,
        made.error_px,
    )  # fmt: skip
    assert relief(lonely) is None and advice(None, "given") is None
