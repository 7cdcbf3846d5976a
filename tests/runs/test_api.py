"""The Python interface: `import sharpfield as sf`."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import sharpfield as sf
from sharpfield._lazy import lazily, offers
from sharpfield.simulation.sensors.event_pixels import EventSensor

SOURCE = Path(__file__).parents[2] / "src"
SENSITIVE = EventSensor(threshold_on=0.02, threshold_off=0.02)
STILL = {"size": (24, 16), "frames": 6, "exposure_us": 20_000, "interval_us": 24_000}
HEAVY = ("torch", "numba", "cv2", "numpy", "jaxtyping", "h5py", "matplotlib", "rich", "tyro")


@pytest.fixture(scope="module")
def capture() -> sf.Capture:
    return sf.simulate("tiles", **STILL, test_every=4, seed=3)


@pytest.fixture(scope="module")
def run(capture: sf.Capture, tmp_path_factory: pytest.TempPathFactory) -> sf.Run:
    out = tmp_path_factory.mktemp("runs") / "ev-splat"
    return sf.train("ev-splat", capture, out=out, steps=10, device="cpu")


def test_importing_it_imports_nothing_heavy_and_takes_a_moment() -> None:
    code = (
        "import sys, time; begun = time.process_time(); import sharpfield as sf; dir(sf)\n"
        f"print(time.process_time() - begun, [name for name in {HEAVY} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(SOURCE)},
        capture_output=True,
        text=True,
        check=True,
    )
    seconds, heavy = done.stdout.split(maxsplit=1)
    assert heavy.strip() == "[]"
    assert float(seconds) < 0.1


def test_every_name_on_offer_exists() -> None:
    for name in dir(sf):
        assert getattr(sf, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'tran'"):
        sf.tran  # noqa: B018


def test_offers_are_read_from_imports_for_type_checkers(tmp_path: Path) -> None:
    text = (
        "if TYPE_CHECKING:\n    from math import tau as tau\n    from json import dumps as text\n"
    )
    assert offers("import os\n" + text) == {"tau": ("math", "tau"), "text": ("json", "dumps")}
    file = tmp_path / "__init__.py"
    file.write_text(text)
    get, names = lazily("sharpfield", str(file))
    assert names() == ["tau", "text"] and get("tau") > 6


def test_a_run_shows_frames_sharp_and_blurred(run: sf.Run, capture: sf.Capture) -> None:
    sharp, blurred = run.render(1), run.render(1, exposure=True, samples=4)
    assert sharp.shape == blurred.shape == (16, 24, 3) and sharp.dtype == np.float32
    assert 0 <= sharp.min() and sharp.max() <= 1
    assert 0 < np.abs(sharp - blurred).mean() < 0.05
    assert np.abs(run.render(1, exposure=0) - sharp).max() == 0
    depth = run.depth(1)
    assert depth.shape == (16, 24) and depth.min() > 0
    assert repr(run).endswith("ev-splat on tiles, 10 of 10 steps)")


def test_a_pose_in_the_captures_world_shows_what_its_frame_does(
    run: sf.Run, capture: sf.Capture
) -> None:
    pose = capture.frame_pose(np.array([1]))[0].numpy()
    middle = float(capture.needed_frames.exposure.middle_us[1])
    assert np.abs(run.render(pose, time=middle) - run.render(1)).max() < 1e-3
    assert np.abs(run.render(time=middle) - run.render(1)).max() < 1e-6
    square = np.vstack([pose, [0, 0, 0, 1]])
    assert np.abs(run.render(torch.from_numpy(square)) - run.render(pose)).max() == 0


def test_an_exposure_is_the_mean_of_instants_in_linear_light(
    run: sf.Run, capture: sf.Capture
) -> None:
    middle, length = capture.clock.span_us / 2, 20_000.0
    views = [run.render(time=middle + part * length) for part in (-0.25, 0.25)]
    decode = run.model.tone.decode
    linear = torch.stack([decode(torch.from_numpy(view)) for view in views]).mean(0)
    mean = run.model.tone.encode(linear).detach().numpy()
    seen = run.render(time=middle, exposure=length, samples=2)
    assert np.abs(seen - mean).max() < 1e-4


def test_a_capture_in_memory_is_kept_with_its_run(run: sf.Run) -> None:
    again = sf.open_run(run.folder, device="cpu")
    assert (run.folder / "capture" / "capture.toml").exists()
    assert np.abs(again.render(1) - run.render(1)).max() == 0
    moved = run.folder.rename(run.folder.with_name("moved"))
    assert sf.open_run(moved, device="cpu").capture.name == "tiles"
    moved.rename(run.folder)


def test_training_goes_on_where_it_stopped(capture: sf.Capture, tmp_path: Path) -> None:
    out = tmp_path / "run"
    sf.write(capture, tmp_path / "capture")
    first = sf.train("ev-splat", tmp_path / "capture", out=out, steps=3, device="cpu")
    assert not (out / "capture").exists()
    assert first.config.capture == str((tmp_path / "capture").resolve())
    again = sf.train("ev-splat", tmp_path / "capture", out=out, steps=5, device="cpu", resume=True)
    assert again.status.steps == 5


def test_evaluating_writes_metrics_and_a_report(run: sf.Run) -> None:
    metrics = run.evaluate()
    assert metrics["mean"]["psnr"] > 5
    assert (run.folder / "metrics.json").exists() and (run.folder / "report.html").exists()


def test_options_are_changed_by_name(capture: sf.Capture, tmp_path: Path) -> None:
    run = sf.train(
        "ev-splat",
        capture,
        out=tmp_path / "run",
        steps=2,
        device="cpu",
        options={"gaussians.sh_degree": 0},
    )
    assert run.config.recipe.gaussians.sh_degree == 0
    assert run.model.scene.static.sh_degree == 0


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda run: run.render(99), "no such frame.*\n.*99\n.*0 to 5"),
        (lambda run: run.render(2 * np.eye(4)), "not a rotation"),
        (lambda run: run.render(1, time=1e9), "(?s)outside the capture.*0 to 160000 us"),
        (lambda run: run.render(1, exposure=-1.0), "length of 0 us or more"),
        (lambda run: sf.open_run(run.folder.parent), "this is not a run"),
        (lambda run: sf.train("ev-splatt", run.capture, out="x"), "unknown recipe"),
        (lambda run: sf.train("ev-splat", run.capture, out=run.folder), "already holds a run"),
        (lambda run: resumed(run, run.capture.without(events=True)), "with another capture"),
        (lambda run: sf.simulate("gardn"), "(?s)unknown scene.*garden"),
        (lambda run: sf.simulate(size=(5, 5)), "not the size of a sensor"),
        (lambda run: sf.write(run.capture, "x", "colmapp"), "unknown layout to write"),
        (lambda run: changed(run, {"gausians.sh_degree": 1}), "did you mean gaussians"),
        (lambda run: changed(run, {"gaussians.sh_degree": "1"}), "(?s)type of value.*give int"),
    ],
)
def test_what_is_wrong_is_said(run: sf.Run, wrong, said: str) -> None:
    with pytest.raises(sf.SharpfieldError, match=said):
        wrong(run)


def resumed(run: sf.Run, capture: sf.Capture) -> sf.Run:
    return sf.train("ev-splat", capture, out=run.folder, device="cpu", steps=10, resume=True)


def changed(run: sf.Run, options: dict) -> sf.Run:
    return sf.train("ev-splat", run.capture, out="nowhere", device="cpu", options=options)


WRONG_TYPES = """
import numpy as np, sharpfield as sf
from dataclasses import replace
run = sf.open_run(%r, device="cpu")
capture, frames, events = run.capture, run.capture.frames, run.capture.events
for wrong in (
    lambda: run.render("first"),
    lambda: run.render(np.eye(3)),
    lambda: run.depth([[1, 2], [3]]),
    lambda: sf.train("ev-splat", 3, out="x"),
    lambda: sf.train("ev-splat", run.capture, out="x", device="gpu"),
    lambda: sf.simulate(size=5),
    lambda: sf.simulate(size=("8", 8)),
    lambda: sf.read(3),
    lambda: sf.write("capture", "x"),
    lambda: sf.deblur("capture"),
    lambda: replace(frames, images=frames.images[..., 0]),
    lambda: replace(frames, images=frames.images / 255),
    lambda: replace(frames, truth=frames.truth[:, 1:]),
    lambda: sf.Exposure([0, 1], [2, 3]),
    lambda: sf.Exposure(np.array([0, 1]), np.array([2])),
    lambda: sf.deblur(replace(capture, events=replace(events, p=events.p.astype(float)))),
    lambda: sf.deblur(replace(capture, events=replace(events, x=events.x[1:]))),
    lambda: sf.deblur(replace(capture, events=replace(events, p=np.maximum(events.p, 0)))),
    lambda: sf.geometry.Still(np.eye(4)),
):
    try:
        wrong()
    except sf.SharpfieldError as error:
        print(error.what, "|", error.got)
"""


def test_wrong_types_are_said_in_words(run: sf.Run) -> None:
    """In a process of its own: here the type checker of the tests would speak first."""
    done = subprocess.run(
        [sys.executable, "-c", WRONG_TYPES % str(run.folder)],
        env=os.environ | {"PYTHONPATH": str(SOURCE)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    count = len(run.capture.needed_events)
    assert done.stdout.splitlines() == [
        "this says no viewpoint | str",
        "a pose has another shape | (3, 3)",
        "this says no viewpoint | list",
        "this is not a capture | int",
        "unknown device | gpu",
        "this is not the size of a sensor | 5",
        "this is not the size of a sensor | ('8', 8)",
        "this is not a path | int",
        "this is not a capture | str",
        "this is not a capture | str",
        "`images` of Frames has another shape or type | ndarray uint8 of shape (6, 16, 24)",
        "`images` of Frames has another shape or type | ndarray float64 of shape (6, 16, 24, 3)",
        "`truth` of Frames has another shape or type | ndarray uint8 of shape (6, 15, 24, 3)",
        "`open_us` of Exposure has another shape or type | list",
        "`close_us` of Exposure has another shape or type | ndarray int64 of shape (1,)",
        f"`p` of EventStream has another shape or type | ndarray float64 of shape ({count},)",
        f"event columns have different lengths | x {count - 1}, y {count}, t {count}, p {count}",
        "polarity must be -1 or +1 | 0",
        "poses have another shape | (4, 4)",
    ]


def test_a_run_has_an_event_camera(run: sf.Run, capture: sf.Capture) -> None:
    span = capture.clock.origin_us, capture.clock.origin_us + capture.clock.span_us
    events = run.events(end=60_000, sensor=SENSITIVE)
    assert (events.width, events.height) == capture.camera.size
    assert len(events) > 0 and span[0] <= events.t_us.min() and events.t_us.max() < 60_000
    part = run.events(start=20_000, end=60_000, sensor=SENSITIVE)
    assert 0 < len(part) < len(events) and part.t_us.min() >= 20_000
    times = np.arange(0, 100_001, 20_000)
    poses = [capture.trajectory.pose(torch.tensor(t / span[1]), torch.tensor(0)) for t in times]
    along = run.events((times.tolist(), poses), size=(12, 8), end=60_000, sensor=SENSITIVE)
    assert (along.width, along.height) == (12, 8) and len(along) > 0


def test_a_run_gives_its_gaussians_and_a_video_away(run: sf.Run, tmp_path: Path) -> None:
    count = run.export(tmp_path / "scene.ply")
    assert count == len(run.model.scene.static)
    assert (tmp_path / "scene.ply").read_bytes().startswith(b"ply")
    assert run.video(tmp_path / "images", frames=2) == 2
    assert len(list((tmp_path / "images").glob("*.png"))) == 2
    with pytest.raises(sf.SharpfieldError, match="exported as .ply"):
        run.export(tmp_path / "scene.obj")


def test_recordings_are_opened_with_what_their_files_do_not_say(tmp_path: Path) -> None:
    file = tmp_path / "events.txt"
    file.write_text("1000 3 2 1\n2000 4 1 0\n")
    recording = sf.open_recording(file, unit="ns", size=(6, 5), columns="txyp")
    events = recording.load()
    assert (events.width, events.height, len(events)) == (6, 5, 2)
    assert events.t_us.tolist() == [1, 2] and events.p.tolist() == [1, -1]
    with pytest.raises(sf.SharpfieldError, match="no option topic"):
        sf.open_recording(file, topic="/events")
