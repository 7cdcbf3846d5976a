"""From each container of one recording to a report, by the commands: the same of all of them."""

from pathlib import Path

import pytest

from benchmarks.whole_way import gone, path_file, recorded, written

pytest.importorskip("lz4")
pytest.importorskip("rosbags")

STEPS = ("--steps", 2, "--change", "gaussians.budget=100")


def test_all_containers_of_a_recording_give_the_same_run(tmp_path: Path) -> None:
    capture = recorded((48, 32), 5)
    poses = ("--trajectory", path_file(capture, tmp_path / "path.txt"), "--bounds", 1, 9)
    rows = [
        gone(name, told, tmp_path, poses=poses, steps=STEPS)
        for name, told in written(capture, tmp_path).items()
    ]
    assert len(rows) == 5
    for row in rows:
        assert row["events"] == len(capture.needed_events) and row["frames"] == 5
        assert row["errors"] == 0
        assert (row["digest"], row["psnr"]) == (rows[0]["digest"], rows[0]["psnr"])
