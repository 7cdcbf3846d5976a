"""Simulated captures of moving scenes, with one track for every camera of a rig.

Moving tracks are numbered first, then static ones; within each, training cameras come before
held-out ones. Held-out cameras take sharp frames, some of which are the test set, and their events
are stored separately as `test_events`. Every frame has its sharp truth, depth and flow in the
middle of its exposure.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, Float64

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Known, Note, Split
from sharpfield.core.events import EventStream, merged
from sharpfield.core.frames import Exposure, Frames
from sharpfield.core.protocols import Trajectory
from sharpfield.core.seed import number
from sharpfield.geometry.trajectory import Still, Tracks
from sharpfield.simulation.cameras.motions import CameraPath, stamped
from sharpfield.simulation.cameras.rigs import RING_FOCAL, StillCamera, Views, ring
from sharpfield.simulation.scenes.moving import moving_scene
from sharpfield.simulation.scenes.static import Scene
from sharpfield.simulation.scenes.surfaces import meet
from sharpfield.simulation.static_capture import Rig, Timing, record

MOVING_RIG = Rig(size=(128, 128), focal_of_width=RING_FOCAL)
MOVING_TIMING = Timing(frames=33, exposure_us=0, interval_us=31_250, step_us=1250, test_every=8)
"""Sharp frames at both ends of 32 windows of one second; of a held-out camera, every eighth frame
is for testing."""

MAPS = ("threshold_on_map", "threshold_off_map")
"""Notes that give a threshold for each pixel."""


MOMENT_US = 100
"""Time by which a point is followed to each side."""
FARAWAY = 1e6
"""Depth of the background, for its flow when the camera rotates."""

RING = ring(8, held_out=4)


@dataclass(frozen=True)
class _Track:
    """The recording of one camera."""

    frames: Frames
    events: EventStream
    known: Known
    notes: dict[str, Note]


def simulate_moving(
    place: Scene | str = "arm",
    views: Views = RING,
    *,
    rig: Rig = MOVING_RIG,
    timing: Timing = MOVING_TIMING,
    seed: int = 0,
) -> Capture:
    """Record a moving scene with a rig of cameras.

    Args:
        place: A moving scene, or the name of one.
        views: Where the cameras are.
        rig: Sensors and their numbers, the same for all cameras.
        timing: Frames, exposures and sampling; held-out cameras take their frames in the middle
            of these exposures.
        seed: Of the sensors' differences and their noise.

    Returns:
        A capture with everything known. Where pixels differ, `notes` give the thresholds of each
        pixel of each track.
    """
    place = moving_scene(place) if isinstance(place, str) else place
    clock = Clock(0, timing.span_us())
    paths = _in_order_of_tracks(views)
    exposure = replace(timing, test_every=0).exposure()
    sharp = Exposure(exposure.middle_us, exposure.middle_us)
    recorded = [
        _record(place, path, sharp if test else exposure, rig, timing, number(seed, k, "camera"))
        for k, (path, test) in enumerate(paths)
    ]
    held_out = np.array([test for _, test in paths])
    frames = _joined([track.frames for track in recorded])
    notes = {k: note for k, note in recorded[0].notes.items() if k not in MAPS}
    if rig.event_sensor.threshold_sigma:
        notes |= {k: np.stack([np.asarray(one.notes[k]) for one in recorded]) for k in MAPS}
    return Capture(
        camera=rig.camera(),
        trajectory=_trajectory([path for path, _ in paths], clock),
        clock=clock,
        near=place.near,
        far=place.far,
        frames=frames,
        events=_stream(recorded, ~held_out),
        test_events=_stream(recorded, held_out) if held_out.any() else None,
        split=_split(frames, held_out, timing),
        name=place.name,
        source="simulation",
        known=recorded[0].known,
        notes=notes,
    )


def _in_order_of_tracks(views: Views) -> list[tuple[CameraPath, bool]]:
    """Each camera and whether it is held out; those that move first."""
    every = [(path, False) for path in views.learned] + [(path, True) for path in views.held_out]
    return sorted(every, key=lambda camera: isinstance(camera[0], StillCamera))


def _record(
    place: Scene, path: CameraPath, exposure: Exposure, rig: Rig, timing: Timing, seed: int
) -> _Track:
    recorder = record(place, path, rig, timing, exposure, seed=seed)
    seen = [depth_and_flow(place, rig.camera(), path, int(t)) for t in exposure.middle_us]
    depth, flow = (np.stack(values) for values in zip(*seen, strict=True))
    frames = replace(recorder.frames(), depth=depth, flow=flow)
    return _Track(frames, recorder.events(), recorder.known(), recorder.notes())


def _joined(tracks: Sequence[Frames]) -> Frames:
    """The frames of all tracks, track after track."""
    opens, closes = (
        np.concatenate([getattr(one.exposure, end) for one in tracks])
        for end in ("open_us", "close_us")
    )
    columns = {
        name: np.concatenate([getattr(one, name) for one in tracks])
        for name in ("images", "truth", "truth_known", "depth", "flow")
    }
    return replace(
        tracks[0],
        exposure=Exposure(opens, closes),
        track=np.repeat(np.arange(len(tracks)), [len(one) for one in tracks]),
        names=tuple(f"v{k:02d}_{name}" for k, one in enumerate(tracks) for name in one.names),
        **columns,
    )


def _stream(tracks: Sequence[_Track], chosen: np.ndarray) -> EventStream:
    """The events of some tracks, in the order of time."""
    found = [(k, tracks[k].events) for k in np.flatnonzero(chosen).tolist()]
    last, _ = found[-1]
    return merged(
        [
            replace(events, track=np.full(len(events), k, np.uint16), tracks=last + 1)
            for k, events in found
        ]
    )


def _trajectory(paths: Sequence[CameraPath], clock: Clock) -> Trajectory:
    still = np.array([path.pose for path in paths if isinstance(path, StillCamera)])
    moving = [stamped(path, clock) for path in paths if not isinstance(path, StillCamera)]
    return Tracks(moving, still.reshape(-1, 3, 4)) if moving else Still(still)


def _split(frames: Frames, held_out: np.ndarray, timing: Timing) -> Split:
    """All frames to learn from; every so many of the held-out ones, neither first nor last."""
    test = np.flatnonzero(held_out[frames.track])
    every = timing.test_every or 1
    chosen = test % timing.frames % every == every // 2
    return Split(np.flatnonzero(~held_out[frames.track]), test[chosen])


def depth_and_flow(
    place: Scene, camera: Camera, path: CameraPath, t_us: int
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w 2"]]:
    """True depth along the camera's axis (infinite in the background), and flow in px per second.

    The flow of a pixel is that of the surface point at its centre: the point is moved with its body
    to a moment before and after, and projected to the camera at these times.
    """
    pose = path.poses(np.array([t_us]))[0]
    across = camera.direction(camera.grid().double()).reshape(-1, 3).numpy()
    across = np.ascontiguousarray(across / across[:, 2:]) @ pose[:, :3].T
    time_s = 1e-6 * t_us
    which, depth = meet(place.at(time_s), pose[None, :, 3], across, time_s, 1 / camera.fx_px)
    points = pose[:, 3] + np.where(which >= 0, depth, FARAWAY)[:, None] * across
    before, after = (
        _projected(camera, path, place.followed(points, which, time_s, 1e-6 * t), t)
        for t in (t_us - MOMENT_US, t_us + MOMENT_US)
    )
    shape = camera.height, camera.width
    flow = (after - before) / (2e-6 * MOMENT_US)
    visible = np.where(which >= 0, depth, np.inf).astype(np.float32)
    return visible.reshape(shape), flow.reshape(*shape, 2).astype(np.float32)


def _projected(
    camera: Camera, path: CameraPath, points: Float64[np.ndarray, "n 3"], t_us: int
) -> Float64[np.ndarray, "n 2"]:
    """Projection of points to the camera at a time."""
    pose = path.poses(np.array([t_us]))[0]
    inside = (points - pose[:, 3]) @ pose[:, :3]
    return camera.project(torch.from_numpy(inside)).numpy()
