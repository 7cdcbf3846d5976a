"""Poses found from frames and events are the camera's; poses of files land where they say."""

import json
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import pytest
import torch

from sharpfield.captures.native import layout as native
from sharpfield.captures.read import read_capture
from sharpfield.captures.trajectory_files import ExternalPath
from sharpfield.cli.poses import Elsewhere, poses_command
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError, MissingExtra, OptionError
from sharpfield.geometry import se3
from sharpfield.geometry.trajectory import Stamped, Still
from sharpfield.metrics.pose import absolute_error, align
from sharpfield.preparation.options import PoseOptions
from sharpfield.preparation.poses import mapping as poses_mapping
from sharpfield.preparation.poses.external import Mount, attach, known_at
from sharpfield.preparation.poses.find import PosesFound, find_poses
from sharpfield.preparation.poses.images import sfm_images
from sharpfield.preparation.poses.path import extrapolated
from sharpfield.preparation.poses.report import poses_summary, poses_text
from sharpfield.simulation.cameras.motions import motion
from sharpfield.simulation.static_capture import Rig, Timing, simulate

BLURBALL = Path(__file__).parents[2].parent / "shared" / "data" / "posed" / "deblurnerf_blurball"


@lru_cache
def fast() -> Capture:
    """A camera so fast that plain frames show next to nothing."""
    timing = Timing(frames=7, exposure_us=80_000, interval_us=86_000, step_us=1000, test_every=0)
    path = motion("glide", 5).faster(2.5)
    return simulate("garden", path, rig=Rig(size=(144, 96)), timing=timing, seed=5)


def unposed(capture: Capture) -> Capture:
    known = replace(capture.known, poses="unknown", bounds="unknown")
    return replace(capture, trajectory=Still(np.eye(3, 4)[None]), known=known)


@lru_cache
def found() -> PosesFound:
    pytest.importorskip("pycolmap")
    return find_poses(unposed(fast()), PoseOptions())


def true_poses(times_us: np.ndarray) -> torch.Tensor:
    unit = torch.from_numpy(fast().clock.unit(times_us))
    return fast().trajectory.pose(unit, torch.zeros(len(unit), dtype=torch.int64))


def test_all_frames_register_from_deblurred_images_where_plain_frames_lose_some() -> None:
    assert found().map.registered.all() and found().images.source == "edi"
    middle = fast().needed_frames.exposure.middle_us
    error = absolute_error(found().capture.frame_pose(np.arange(7)).double(), true_poses(middle))
    spread = true_poses(middle)[:, :, 3].std(0).norm()
    assert error.translation < 0.05 * spread
    assert error.rotation_deg < 3
    try:
        plain = find_poses(unposed(fast()), PoseOptions(images="frames")).map.registered
    except CaptureError as error:
        assert "poses could not be found" in str(error) and "--images edi" in error.do
    else:
        assert not plain.all()


def test_the_path_is_right_between_the_frames_too() -> None:
    made = found().capture
    known = made.trajectory.known_us(0)
    assert known is not None
    exposure = fast().needed_frames.exposure
    assert known[0] <= exposure.open_us[0] and known[1] >= exposure.close_us[-1]
    times = np.linspace(exposure.middle_us[0], exposure.middle_us[-1], 200).astype(np.int64)
    unit = torch.from_numpy(made.clock.unit(times))
    path = made.trajectory.pose(unit, torch.zeros(200, dtype=torch.int64))
    truth = true_poses(times)
    away = align(path, truth)(path)[:, :, 3] - truth[:, :, 3]
    extent = truth[:, :, 3].amax(0) - truth[:, :, 3].amin(0)
    assert away.norm(dim=-1).square().mean().sqrt() < 0.05 * extent.norm()


def test_scale_bounds_and_points_go_together() -> None:
    made = found().capture
    assert made.points is not None and len(made.points) > 50
    poses = made.frame_pose(np.arange(len(made.needed_frames))).double().numpy()
    toward = made.points - poses[3, :, 3]
    depth = toward @ poses[3, :, 2]
    assert 0.5 < np.median(depth) < 2 and made.near < np.median(depth) < made.far
    assert made.known.poses == made.known.bounds == "known"


def test_the_capture_survives_the_disk_and_the_report_says_what_happened(tmp_path: Path) -> None:
    native.write(found().capture, tmp_path / "posed")
    again = read_capture(tmp_path / "posed")
    np.testing.assert_array_equal(again.points, found().capture.points)
    about = poses_summary(unposed(fast()), found())
    assert json.loads(json.dumps(about))["registered"] == 21
    assert "21 of 21 images have a pose" in poses_text(about)
    assert not about["relief"]["flat"] and "nearly flat" not in poses_text(about)
    flat = about | {"relief": {"flat": True, "why": "it is nearly flat", "do": "look elsewhere"}}
    assert "warning: it is nearly flat\n  do     look elsewhere" in poses_text(flat)


def test_known_positions_give_the_world() -> None:
    pytest.importorskip("pycolmap")
    path = fast().trajectory
    assert isinstance(path, Stamped)
    outer = ExternalPath("tum", path.poses, path.times_us - 5000)
    known = partial(known_at, outer, Mount(offset_us=5000))
    made = find_poses(unposed(fast()), PoseOptions(instants=1), known=known)
    middle = fast().needed_frames.exposure.middle_us
    apart = made.capture.frame_pose(np.arange(7)) - true_poses(middle).float()
    extent = true_poses(middle)[:, :, 3].std(0).norm()
    assert apart[:, :, 3].norm(dim=-1).max() < 0.1 * extent
    assert made.errors is not None
    assert made.errors.absolute.translation < 0.05 * extent
    assert made.errors.relative.rotation_deg < 5


def test_the_real_blurry_scene_registers(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    if not BLURBALL.is_dir():
        pytest.skip("posed/deblurnerf_blurball is not in ../shared/data")
    scene = read_capture(BLURBALL)
    made = find_poses(scene, PoseOptions()).capture
    assert len(made.needed_frames) >= 26
    rows = [scene.needed_frames.names.index(name) for name in made.needed_frames.names]
    estimate = made.frame_pose(np.arange(len(rows))).double()
    truth = scene.frame_pose(np.array(rows)).double()
    centre = truth[:, :, 3]
    extent = (centre.amax(0) - centre.amin(0)).norm()
    assert absolute_error(estimate, truth).translation < 0.01 * extent


def test_poses_of_a_file_follow_clock_and_hand() -> None:
    path = fast().trajectory
    assert isinstance(path, Stamped)
    hand = se3.exp(torch.tensor([0.2, -0.1, 0.3, 0.5, 0.1, -0.2], dtype=torch.float64))
    body = se3.compose(
        torch.from_numpy(path.poses), se3.inverse(hand).expand(len(path.poses), 3, 4)
    ).numpy()
    outer = ExternalPath("euroc", body, path.times_us + 7_000_000)
    mount = Mount(offset_us=-7_000_000, body_from_camera=hand.numpy())
    made = attach(unposed(fast()), outer, mount, bounds=(2.0, 8.0))
    np.testing.assert_allclose(made.capture.trajectory.poses, path.poses, atol=1e-12)
    assert len(made.kept) == 7 and (made.capture.near, made.capture.far) == (2.0, 8.0)


def test_frames_and_events_beyond_a_file_are_left_out() -> None:
    path = fast().trajectory
    assert isinstance(path, Stamped)
    half = len(path.times_us) // 2
    outer = ExternalPath("tum", path.poses[:half], path.times_us[:half])
    made = attach(unposed(fast()), outer, Mount(), bounds=(2.0, 8.0))
    assert 0 < len(made.kept) < 7
    events = made.capture.needed_events
    assert 0 < len(events) and events.t_us[-1] <= path.times_us[half - 1]


def test_bounds_are_found_from_frames_where_nobody_knows_them() -> None:
    path = fast().trajectory
    assert isinstance(path, Stamped)
    made = attach(unposed(fast()), ExternalPath("tum", path.poses, path.times_us), Mount()).capture
    assert fast().near / 2.5 < made.near < fast().near * 2 < made.far < fast().far * 2.5


def test_a_wrong_clock_is_named_with_the_offset_that_mends_it() -> None:
    path = fast().trajectory
    assert isinstance(path, Stamped)
    late = ExternalPath("tum", path.poses, path.times_us + 60_000_000)
    with pytest.raises(CaptureError, match="not taken at the same time") as caught:
        attach(unposed(fast()), late, Mount(), bounds=(2.0, 8.0))
    assert "--offset-ms -59990" in caught.value.do


def test_poses_without_times_must_be_as_many_as_the_frames() -> None:
    path = fast().trajectory
    assert isinstance(path, Stamped)
    with pytest.raises(CaptureError, match="as many as the frames"):
        attach(unposed(fast()), ExternalPath("kitti", path.poses), Mount(), bounds=(2.0, 8.0))


def test_a_path_is_carried_on_at_its_speed_and_not_too_far() -> None:
    poses = np.stack([np.eye(3, 4) for _ in range(3)])
    poses[:, 0, 3] = [0, 1, 2]
    times, more = extrapolated(np.array([100, 200, 300]), poses, (50, 1000))
    assert times.tolist() == [50, 100, 200, 300, 400]
    np.testing.assert_allclose(more[:, 0, 3], [-0.5, 0, 1, 2, 3])


def test_only_events_tell_several_instants_apart() -> None:
    with pytest.raises(OptionError, match="need events"):
        sfm_images(fast().without(events=True), "auto", instants=3)
    made = sfm_images(fast(), "edi", instants=2)
    assert len(made) == 14 and (np.diff(made.time_us) > 0).all()
    assert len(sfm_images(fast(), "sharpest")) == 3


def test_images_without_texture_are_refused_with_a_reason() -> None:
    pytest.importorskip("pycolmap")
    frames = fast().needed_frames
    grey = replace(frames, images=np.full_like(frames.images, 128))
    with pytest.raises(CaptureError, match="too few features") as caught:
        find_poses(unposed(replace(fast(), frames=grey)), PoseOptions(images="frames"))
    assert "--trajectory" in caught.value.do


def test_a_missing_package_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(package: str, *, extra: str, purpose: str) -> None:
        raise MissingExtra(package, extra=extra, purpose=purpose)

    monkeypatch.setattr(poses_mapping, "need", absent)
    with pytest.raises(MissingExtra, match=r"finding poses needs the package 'pycolmap'") as caught:
        find_poses(unposed(fast()), PoseOptions(images="frames"))
    assert "sharpfield[sfm]" in caught.value.do


def test_command_attaches_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = fast().trajectory
    assert isinstance(path, Stamped)
    native.write(unposed(fast()), tmp_path / "bare")
    np.savez(tmp_path / "path.npz", times_us=path.times_us, poses=path.poses)
    poses_command(
        tmp_path / "bare",
        tmp_path / "posed",
        elsewhere=Elsewhere(trajectory=tmp_path / "path.npz", bounds=(2.0, 8.0)),
    )
    assert "7 of 7 frames" in capsys.readouterr().out
    assert read_capture(tmp_path / "posed").near == 2.0
    assert json.loads((tmp_path / "posed" / "poses.json").read_text())["poses_from"] == "npz"
