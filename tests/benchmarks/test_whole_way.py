"""Each container of one recording, by the commands, to the same capture; and on to a report."""

from pathlib import Path

import pytest

from benchmarks.whole_way import errors, learned, path_file, recorded, taken_in, written

pytest.importorskip("lz4")
pytest.importorskip("rosbags")

STEPS = ("--steps", 2, "--change", "gaussians.cap_max=100")


def test_all_containers_of_a_recording_give_the_same_capture_and_run(tmp_path: Path) -> None:
    capture = recorded((48, 32), 5)
    poses = ("--trajectory", path_file(capture, tmp_path / "path.txt"), "--bounds", 1, 9)
    containers = written(capture, tmp_path)
    rows = [
        taken_in(told, tmp_path / name.replace(" ", "-"), poses=poses)
        for name, told in containers.items()
    ]
    assert len(rows) == 5
    for row in rows:
        assert row["events"] == len(capture.needed_events) and row["frames"] == 5
        assert row["digest"] == rows[0]["digest"]
    places = [tmp_path / name for name in ("AEDAT4", "text")]
    assert [errors(place) for place in places] == [0, 0]
    one, other = (learned(place, steps=STEPS) for place in places)
    assert one == other
