import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import sharpfield
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Known, Split, Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.core.frames import Exposure, Frames

CLOCK = Clock(1_000_000, 500_000)


class Rail:
    """Track 0 runs along x, a metre per unit of time; track 1 stands still."""

    def __init__(self, first_us: int = 1_000_000, last_us: int = 1_500_000) -> None:
        self.known = first_us, last_us

    def pose(self, time: torch.Tensor, track: torch.Tensor) -> torch.Tensor:
        pose = torch.eye(3, 4).expand(*time.shape, 3, 4).clone()
        pose[..., 0, 3] = torch.where(track == 0, time, torch.full_like(time, -1))
        return pose

    def known_us(self, track: int) -> tuple[int, int] | None:
        return self.known if track == 0 else None


def frames(
    opens: tuple[int, ...] = (1_000_000, 1_200_000, 1_300_000),
    closes: tuple[int, ...] = (1_100_000, 1_300_000, 1_500_000),
    tracks: tuple[int, ...] = (0, 0, 1),
) -> Frames:
    count = len(opens)
    return Frames(
        images=np.zeros((count, 3, 4, 3), np.uint8),
        exposure=Exposure(np.array(opens, np.int64), np.array(closes, np.int64)),
        track=np.array(tracks, np.int64),
        names=tuple(f"{i:04d}.png" for i in range(count)),
    )


EVENTS = EventStream(*np.zeros((2, 0), np.int16), np.zeros(0, np.int64), np.zeros(0, np.int8), 4, 3)


def capture(**change: Any) -> Capture:
    given: dict = {
        "camera": Camera(4, 3, 5.0, 5.0, 2.0, 1.5),
        "trajectory": Rail(),
        "clock": CLOCK,
        "near": 1.0,
        "far": 5.0,
        "frames": frames(),
        "events": EVENTS,
        "name": "garden",
    }
    return Capture(**{**given, **change})


def test_what_is_unknown_is_listed():
    assert capture().known == Known() and not capture().known.unknown
    made = Known(poses="unknown", bounds="unknown", intrinsics="estimated")
    assert made.unknown == ("poses", "bounds")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"log_floor": float("nan")},
            "CaptureError: `log_floor` must be a finite number, not negative\n  got    nan",
        ),
        (
            {"thresholds": Thresholds(0.2, -0.2)},
            "CaptureError: `threshold_positive` must be a finite number, not negative\n"
            "  got    -0.2",
        ),
    ],
)
def test_impossible_knowledge_is_refused(change: dict, message: str):
    with pytest.raises(CaptureError) as refused:
        Known(**change)
    assert str(refused.value) == message


def test_no_code_branches_on_the_notes_of_a_capture():
    sources = Path(sharpfield.__file__).parent.rglob("*.py")
    branching = re.compile(r"capture\.notes(\.get\(|\[)")
    assert [path.name for path in sources if branching.search(path.read_text())] == []


def test_a_clock_there_and_back():
    t_us = np.array([1_000_000, 1_000_001, 1_234_567, 1_500_000, 900_000], np.int64)
    unit = CLOCK.unit(t_us)
    assert unit[[0, 3]].tolist() == [0, 1]
    assert CLOCK.us(unit).tolist() == t_us.tolist()
    assert int(CLOCK.us(0.5)) == 1_250_000
    assert float(CLOCK.unit(1_250_000)) == 0.5


def test_a_clock_is_good_to_microseconds_long_after_1970():
    clock = Clock(1_700_000_000_000_000, 60_000_000)
    t_us = clock.origin_us + np.array([0, 1, 59_999_999], np.int64)
    assert clock.us(clock.unit(t_us)).tolist() == t_us.tolist()
    in_rays = clock.us(clock.unit(t_us).astype(np.float32).astype(np.float64))
    assert np.abs(in_rays - t_us).max() <= 4  # what its docstring promises


def test_times_and_poses_of_frames():
    made = capture()
    wanted = torch.tensor([[0.0, 0.2], [0.4, 0.6], [0.6, 1.0]])
    torch.testing.assert_close(made.frame_time, wanted)
    centres = made.frame_pose(np.array([2, 1, 0]))[:, 0, 3]
    torch.testing.assert_close(centres, torch.tensor([-1.0, 0.5, 0.1]))


def test_taking_streams_away():
    made = capture()
    assert made.without(events=True).events is None
    assert made.without(frames=True).frames is None
    assert made.without(events=True).frames is made.frames


@pytest.mark.parametrize("early", [0, 2])
def test_times_rounded_by_two_microseconds_are_covered(early: int):
    made = capture(trajectory=Rail(1_000_000 + early, 1_500_000))
    assert len(made.needed_frames) == 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"frames": None, "events": None},
            "CaptureError: a capture needs frames or events, and has neither\n  where  garden",
        ),
        (
            {"near": 2.0, "far": 2.0},
            "CaptureError: depth bounds must satisfy 0 < near < far\n"
            "  where  garden\n"
            "  got    near 2.0, far 2.0\n"
            "  do     check the last two columns of the poses, or `near` and `far`",
        ),
        (
            {"camera": Camera(8, 6, 10.0, 10.0, 4.0, 3.0)},
            "CaptureError: images and camera have different sizes\n"
            "  where  garden\n"
            "  got    images 4x3, camera 8x6\n"
            "  do     give the intrinsics for the images' own size",
        ),
        (
            {"split": Split(np.array([0, 1]), np.array([3]))},
            "CaptureError: the split names frames that do not exist\n"
            "  where  garden\n"
            "  got    indices 0 to 3 of 3 frames\n"
            "  do     use indices from 0 to the number of frames - 1",
        ),
        (
            {"trajectory": Rail(1_050_000, 1_500_000)},
            "CaptureError: poses do not cover 1 of 2 exposures\n"
            "  where  garden, frame 0000.png (track 0)\n"
            "  got    poses from 1050000 to 1500000 us, exposure from 1000000 to 1100000 us\n"
            "  do     give poses for the whole exposure, or leave these frames out",
        ),
        (
            {"trajectory": Rail(1_000, 1_500)},
            "CaptureError: poses do not cover 2 of 2 exposures\n"
            "  where  garden, frame 0000.png (track 0)\n"
            "  got    poses from 1000 to 1500 us, exposure from 1000000 to 1100000 us\n"
            "  do     exposure times look like ns where us were expected: divide them by 1000",
        ),
        (
            {"trajectory": Rail(1_000_000_000, 1_500_000_000)},
            "CaptureError: poses do not cover 2 of 2 exposures\n"
            "  where  garden, frame 0000.png (track 0)\n"
            "  got    poses from 1000000000 to 1500000000 us,"
            " exposure from 1000000 to 1100000 us\n"
            "  do     pose times look like ns where us were expected: divide them by 1000",
        ),
    ],
)
def test_contradictions_are_refused(change: dict, message: str):
    with pytest.raises(CaptureError) as refused:
        capture(**change)
    assert str(refused.value) == message


def test_what_is_needed_and_absent_is_named():
    with pytest.raises(CaptureError) as refused:
        _ = capture(frames=None).needed_frames
    assert str(refused.value) == (
        "CaptureError: this needs frames, and the capture has none\n  where  garden"
    )
    with pytest.raises(CaptureError, match="this needs events, and the capture has none"):
        _ = capture(events=None).needed_events
