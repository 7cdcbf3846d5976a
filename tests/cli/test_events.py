"""The events command on a tiny run: what it writes, what it prints, how it refuses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.events import merged
from sharpfield.storage.event_cache import read_events
from sharpfield.storage.event_layouts import open_events
from sharpfield.storage.event_writer import write_events
from tests.cli.command import run

FAST = ("--step-ms", 10, "--shortest-ms", 5)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("twin") / "tiny"
    words = ("--scene", "tiles", "--size", "16x12", "--frames", 5, "--exposure-us", 20_000)
    words = (*words, "--interval-us", 24_000, "--test-every", 4, "--threshold", 0.02)
    assert run("simulate", "--out", out, *words) == 0
    return out


@pytest.fixture(scope="module")
def splats(recorded: Path) -> Path:
    out = recorded.parent / "ev-splat"
    words = ("--steps", 30, "--change", "gaussians.cap_max=300")
    assert run("train", "ev-splat", recorded, "--out", out, *words) == 0
    return out


@pytest.fixture(scope="module")
def volume(recorded: Path) -> Path:
    out = recorded.parent / "volume"
    words = ("volume.voxels=0,4000", "volume.samples=16,0")
    assert run("train", "nerf", recorded, "--out", out, "--steps", 4, "--change", *words) == 0
    return out


@pytest.mark.parametrize("kind", ["splats", "volume"])
def test_a_stream_that_inspect_reads(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "twin.h5"
    assert run("events", request.getfixturevalue(kind), "--out", out, *FAST) == 0
    said = capsys.readouterr().out.replace("\n", "")
    assert run("inspect", out, "--json") == 0
    found = json.loads(capsys.readouterr().out)["events"]
    assert f"{found['count']:,} events" in said and "images" in said
    assert (found["width"], found["height"]) == (16, 12)
    assert kind == "volume" or found["count"] > 100


def test_event_frames_add_up_to_the_stream(splats: Path, tmp_path: Path) -> None:
    out = tmp_path / "twin.h5"
    words = ("--from", 20, "--to", 85, "--frames", 10, "--least-share", 0.3)
    assert run("events", splats, "--out", out, *words, *FAST) == 0
    with open_events(out) as file:
        events = read_events(file)
    assert events.t_us.min() >= 20_000 and events.t_us.max() < 85_000
    counts = np.load(tmp_path / "twin-frames" / "counts.npy")
    assert counts.shape == (7, 12, 16, 2)
    for number, part in enumerate(counts):
        window = events.window(20_000 + 10_000 * number, 30_000 + 10_000 * number)
        for sign in (0, 1):
            chosen = window.p == 2 * sign - 1
            told = np.zeros((12, 16), int)
            np.add.at(told, (window.y[chosen], window.x[chosen]), 1)
            np.testing.assert_array_equal(part[..., sign], told)
    assert len(list((tmp_path / "twin-frames").glob("*.png"))) == 7


def test_the_same_command_gives_the_same_events(splats: Path, tmp_path: Path) -> None:
    words = ("--sensor", "gen4-hd", "--threshold", 0.05, "--to", 60, *FAST)
    outs = [tmp_path / f"{name}.csv" for name in "abc"]
    for out, seed in zip(outs, (1, 1, 2), strict=True):
        assert run("events", splats, "--out", out, "--seed", seed, *words) == 0
    a, b, c = (out.read_text() for out in outs)
    assert a == b != c and a.startswith("t_us,x,y,p\n")


def test_a_path_of_its_own_and_other_pixels(
    recorded: Path, splats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Along the capture's own path, given as a file, the camera sees what it saw."""
    path = ("--trajectory", recorded / "trajectory.npz")
    assert run("events", splats, "--out", tmp_path / "given.csv", *path, *FAST) == 0
    assert run("events", splats, "--out", tmp_path / "own.csv", *FAST) == 0
    rows = [len((tmp_path / f"{name}.csv").read_text().split()) for name in ("given", "own")]
    assert rows[0] == pytest.approx(rows[1], rel=0.02) and rows[1] > 100
    words = (*path, "--size", "40x24", "--to", 30, *FAST)
    assert run("events", splats, "--out", tmp_path / "large.npz", *words) == 0
    with np.load(tmp_path / "large.npz") as large:
        assert (large["width"], large["height"]) == (40, 24)
        assert large["x"].max() > 16 and large["y"].max() > 12


def test_comparing_says_how_the_twin_agrees(
    splats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "twin.h5"
    assert run("events", splats, "--out", out, "--compare", "--frames", 20, *FAST) == 0
    assert "sign_iou" in capsys.readouterr().out
    found = json.loads((tmp_path / "twin-compare.json").read_text())
    assert min(found["recorded"], found["predicted"]) > 100 and 0 < found["timed_share"] <= 1
    assert found["count_ratio"] == found["predicted"] / found["recorded"]
    assert (tmp_path / "twin-compare.png").is_file()


def test_another_recording_can_be_compared_with(splats: Path, tmp_path: Path) -> None:
    """A twin's own file, in every format that the program reads, agrees with the twin."""
    words = ("--from", 20, "--to", 80, "--on", 0, *FAST)
    for ending in ("h5", "npz", "raw"):
        first = tmp_path / f"first.{ending}"
        assert run("events", splats, "--out", first, *words) == 0
        out = tmp_path / f"second-{ending}.csv"
        assert run("events", splats, "--out", out, "--against", first, *words) == 0
        found = json.loads((tmp_path / f"second-{ending}-compare.json").read_text())
        assert found["predicted"] == found["recorded"] > 100 and found["timing_ms"] == 0
        assert (found["threshold_on"], found["matched"]) == (0.02, False)


def test_a_camera_that_was_on_before_goes_on(splats: Path, tmp_path: Path) -> None:
    """Events from 40 ms on are those of the whole, if the camera was switched on as early."""
    whole, late, cold = (tmp_path / f"{name}.csv" for name in ("whole", "late", "cold"))
    assert run("events", splats, "--out", whole, *FAST) == 0
    assert run("events", splats, "--out", late, "--on", 0, "--from", 40, *FAST) == 0
    assert run("events", splats, "--out", cold, "--from", 40, *FAST) == 0
    rows = [np.loadtxt(one, np.int64, delimiter=",", skiprows=1) for one in (whole, late, cold)]
    after = rows[0][rows[0][:, 0] >= 40_000]
    np.testing.assert_array_equal(rows[1], after)
    assert len(rows[2]) != len(after) or (rows[2] != after).any()


def test_events_of_two_stretches_add_up(splats: Path, tmp_path: Path) -> None:
    """Also where a stretch ends within a step of time."""
    ends = {"first": (20, 47), "second": (47, 80), "both": (20, 80)}
    rows = {}
    for name, (start, end) in ends.items():
        out = tmp_path / f"{name}.csv"
        assert run("events", splats, "--out", out, "--from", start, "--to", end, "--on", 0) == 0
        rows[name] = np.loadtxt(out, np.int64, delimiter=",", skiprows=1)
    assert min(map(len, rows.values())) > 100
    np.testing.assert_array_equal(np.concatenate([rows["first"], rows["second"]]), rows["both"])


def test_a_view_of_a_rigs_recording_can_be_compared_with(splats: Path, tmp_path: Path) -> None:
    words = ("--from", 20, "--to", 80, "--on", 0, *FAST)
    first, rig, out = (tmp_path / name for name in ("first.h5", "rig.h5", "out.csv"))
    assert run("events", splats, "--out", first, *words) == 0
    with open_events(first) as file:
        own = read_events(file)
    turned = replace(own, x=own.width - 1 - own.x)
    pair = [
        replace(one, track=np.full(len(one), k, np.int16), tracks=2)
        for k, one in enumerate((own, turned))
    ]
    write_events(rig, merged(pair))
    assert run("events", splats, "--out", out, "--against", rig, *words) == 0
    found = json.loads((tmp_path / "out-compare.json").read_text())
    assert found["predicted"] == found["recorded"] == len(own) and found["timing_ms"] == 0


def test_a_comparison_with_a_twin_that_says_nothing(splats: Path, tmp_path: Path) -> None:
    """What cannot be said is null: NaN is no JSON."""
    words = ("--threshold", 90, "--to", 40, "--compare", *FAST)
    assert run("events", splats, "--out", tmp_path / "twin.h5", *words) == 0

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    found = json.loads((tmp_path / "twin-compare.json").read_text(), parse_constant=refuse)
    assert found["predicted"] == 0 and found["timing_ms"] is None


def test_what_cannot_be_compared_is_refused_before_rendering(
    splats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    large, out = tmp_path / "large.npz", tmp_path / "twin.h5"
    assert run("events", splats, "--out", large, "--size", "24x16", "--to", 40, *FAST) == 0
    assert run("events", splats, "--out", out, "--against", large, "--to", 40, *FAST) == 2
    assert "(24, 16) recorded, (16, 12) rendered" in capsys.readouterr().err
    assert not out.exists()


def test_thresholds_are_matched_and_said(
    splats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "twin.h5"
    words = ("--from", 30, "--to", 45, "--compare", "--match", *FAST)
    assert run("events", splats, "--out", out, *words) == 0
    said = " ".join(capsys.readouterr().out.split())
    found = json.loads((tmp_path / "twin-compare.json").read_text())
    assert "recorded events outside the time rendered; without, the scene makes" in said
    assert found["matched"] and found["threshold_on"] != 0.02
    assert f"Thresholds x {found['threshold_on'] / 0.02:.3f} to brighter" in said


def test_an_interrupted_command_leaves_nothing(
    splats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sharpfield.twin.output.count_events", stopped)
    for ending in ("h5", "npz", "raw", "csv"):
        out = tmp_path / f"twin.{ending}"
        assert run("events", splats, "--out", out, "--frames", 20, "--to", 40, *FAST) == 130
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--out", "x.bin"), "unknown format of events"),
        (("--out", "x.h5", "--sensor", "eye"), "unknown sensor"),
        (("--out", "x.h5", "--view", 3), "no such view"),
        (("--out", "x.h5", "--from", 50, "--to", 20), "the time window is empty"),
        (("--out", "x.h5", "--trajectory", "gone.txt"), "trajectory file not found"),
        (("--out", "x.h5", "--view", 0, "--trajectory", "p.txt"), "not both"),
        (("--out", "x.h5", "--size", "sensor"), "no size of its own"),
        (("--out", "x.h5", "--size", "16x12", "--compare"), "at its own size"),
        (("--out", "x.h5", "--threshold", -1), "thresholds must be positive"),
        (("--out", "x.h5", "--step-ms", 0), "time steps"),
        (("--out", "x.h5", "--frames", 0), "windows must have a length"),
        (("--out", "x.h5", "--to", 5000), "use times from 0 to"),
        (("--out", "x.h5", "--from", 20, "--on", 30), "not after its first event"),
        (("--out", "x.h5", "--subpixels", 0), "at least one subpixel"),
        (("--out", "x.h5", "--compare", "--against", "y.h5"), "not with both"),
        (("--out", "x.h5", "--against", "gone.raw"), "gone.raw"),
    ],
)
def test_what_makes_no_sense_is_refused(
    splats: Path,
    words: tuple[object, ...],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run("events", splats, *words) == 2
    said = capsys.readouterr().err
    assert message in said and "Traceback" not in said
    assert not list(tmp_path.iterdir())
