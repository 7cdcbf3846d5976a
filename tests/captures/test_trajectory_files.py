"""Every layout says the same poses; what is unclear or malformed is refused in words."""

from pathlib import Path

import numpy as np
import pytest
import torch

from sharpfield.captures.trajectory_files import path_layout, read_hand_eye, read_path
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.geometry import se3

TIMES_US = np.array([1_000_000, 1_010_000, 1_020_000, 1_030_000])


def poses() -> np.ndarray:
    vector = torch.linspace(0.1, 0.9, 4, dtype=torch.float64)[:, None] * torch.tensor(
        [0.3, -0.5, 0.8], dtype=torch.float64
    )
    place = np.arange(12.0).reshape(4, 3, 1) / 7
    return np.concatenate([se3.rotation_exp(vector).numpy(), place], -1)


def quaternions() -> np.ndarray:
    """w, x, y, z."""
    return se3.quaternion_from_rotation(torch.from_numpy(poses()[:, :, :3])).numpy()


def write_tum(path: Path) -> Path:
    rows = np.column_stack([TIMES_US / 1e6, poses()[:, :, 3], quaternions()[:, [1, 2, 3, 0]]])
    np.savetxt(path, rows, fmt="%.9f", header="t x y z qx qy qz qw")
    return path


def write_euroc(path: Path) -> Path:
    rows = np.column_stack([poses()[:, :, 3], quaternions(), np.zeros((4, 9))])
    lines = ["#timestamp [ns], p_x [m], ..."]
    lines += [
        f"{1_403_636_580_000_000_000 + 1000 * int(t)}," + ",".join(f"{v:.9f}" for v in row)
        for t, row in zip(TIMES_US, rows, strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_kitti(path: Path, *, times: bool) -> Path:
    np.savetxt(path, poses().reshape(4, 12), fmt="%.6e")
    if times:
        np.savetxt(path.parent / "times.txt", TIMES_US / 1e6, fmt="%.6e")
    return path


def write_stage(path: Path) -> Path:
    rows = np.column_stack(
        [TIMES_US / 1000, 1000 * poses()[:, :, 3], quaternions()[:, [1, 2, 3, 0]]]
    )
    head = "t_ms, x_mm, y_mm, z_mm, qx, qy, qz, qw"
    np.savetxt(path, rows, delimiter=",", fmt="%.9f", header=head, comments="")
    return path


@pytest.mark.parametrize(
    ("name", "write", "layout"),
    [("a.txt", write_tum, "tum"), ("b.csv", write_euroc, "euroc"), ("c.csv", write_stage, "csv")],
)
def test_all_layouts_say_the_same_poses(tmp_path: Path, name: str, write, layout: str) -> None:
    path = write(tmp_path / name)
    assert path_layout(path) == layout
    found = read_path(path)
    np.testing.assert_allclose(found.poses, poses(), atol=1e-6)
    assert found.times_us is not None
    assert np.diff(found.times_us).tolist() == np.diff(TIMES_US).tolist()


def test_nanoseconds_of_1970_are_kept_to_the_microsecond(tmp_path: Path) -> None:
    found = read_path(write_euroc(tmp_path / "b.csv"))
    assert found.times_us is not None
    assert int(found.times_us[0]) == 1_403_636_580_000_000 + int(TIMES_US[0])


def test_kitti_takes_times_from_beside_or_has_none(tmp_path: Path) -> None:
    path = write_kitti(tmp_path / "poses.txt", times=False)
    assert read_path(path).times_us is None
    write_kitti(path, times=True)
    found = read_path(path)
    assert found.layout == "kitti"
    assert found.times_us is not None and found.times_us.tolist() == TIMES_US.tolist()
    np.testing.assert_allclose(found.poses, poses(), atol=1e-5)


def test_a_turntable_and_a_slider_need_one_column_each(tmp_path: Path) -> None:
    (tmp_path / "turn.csv").write_text("t_s,rz_deg\n0,0\n1,90\n")
    (tmp_path / "slide.csv").write_text("t_ns,x_cm\n0,0\n1000000,250\n")
    turned = read_path(tmp_path / "turn.csv").poses[1]
    np.testing.assert_allclose(turned[:, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    slid = read_path(tmp_path / "slide.csv")
    assert slid.poses[1, :, 3].tolist() == [2.5, 0, 0]
    assert slid.times_us is not None and slid.times_us.tolist() == [0, 1000]


def test_hand_eye_is_a_matrix_or_a_line(tmp_path: Path) -> None:
    one, qwxyz = poses()[2], quaternions()[2]
    np.savetxt(tmp_path / "matrix.txt", np.vstack([one, [0, 0, 0, 1]]))
    np.savetxt(tmp_path / "line.txt", np.concatenate([one[:, 3], qwxyz[[1, 2, 3, 0]]])[None])
    for name in ("matrix.txt", "line.txt"):
        np.testing.assert_allclose(read_hand_eye(tmp_path / name), one, atol=1e-12)
    (tmp_path / "wrong.txt").write_text("1 2 3\n")
    with pytest.raises(CaptureError, match="not a pose"):
        read_hand_eye(tmp_path / "wrong.txt")


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("1 2 3\n", CaptureError, "unknown layout of a trajectory"),
        ("", CaptureError, "unknown layout of a trajectory"),
        ("time,x_m\n0,0\n", OptionError, "must have one column of times"),
        ("t_s,x_m\n0,a\n", CaptureError, "cannot read the trajectory"),
        ("t_s,x_m\n", CaptureError, "cannot read the trajectory"),
        ("0,0,0,0,0.5,0,0,0\n", CaptureError, "length one"),
    ],
)
def test_what_is_unclear_is_refused(tmp_path: Path, text: str, error, words: str) -> None:
    path = tmp_path / "path.txt"
    path.write_text(text)
    with pytest.raises(error, match=words):
        read_path(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="trajectory not found"):
        read_path(tmp_path / "none.txt")
