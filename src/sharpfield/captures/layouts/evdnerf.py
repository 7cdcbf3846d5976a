"""EvDNeRF's data: static event cameras around a moving scene, all on one clock of one second.

    transforms_train.json   `camera_angle_x`, `focal`?, frames with `time`; view after view, each
                            from time 0 to 1; ours also `threshold_on`, `threshold_off`
    transforms_val.json     likewise, as all files named `train`
    data_frames_train.npy   [view, window, row, column]: signed sums of thresholds between frames
    data_train.npz          raw streams, a plain array [n, 4] of (t in ns, x, y, -1 or +1) per view
    data_train.npy, .pkl    the same, pickled, as published
    train/rgba_00000.png    images, if there are any

Each view is a still track; those of the validation set are held out, their events too. Streams are
read from `data_*.npz`, from pickled files if these are trusted, or else from the sums. A sum of n
thresholds in a window becomes n events of its sign, evenly spread inside the window: in each window
the stream is what the file states, and its times are known no finer than a window.

Source: Bhattacharya et al., *EvDNeRF* (WACV 2024), and the files it published.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, Int64, Shaped

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._transforms import (
    ONE_SECOND,
    ViewSet,
    expect_one_camera,
    images_of,
    number,
    read_json,
    read_views,
)
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Known, Note, Split, Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream, checked, merged
from sharpfield.core.frames import Exposure, Frames
from sharpfield.geometry.trajectory import Still
from sharpfield.storage.arrays import load_array, load_arrays, load_pickled
from sharpfield.storage.event_columns import coordinates, polarity, whole_us
from sharpfield.storage.event_layouts import THRESHOLDS

OFF_GRID = 0.05
"""Tolerance of sums: distance from a whole number of thresholds, in thresholds."""


def events_from_sums(
    sums: Float[np.ndarray, "k h w"],
    edges_us: Int64[np.ndarray, "e"],
    *,
    threshold: float,
    where: object,
) -> EventStream:
    """A stream of events with these sums.

    Args:
        sums: Signed sum of thresholds in each window, natural log.
        edges_us: Start of each window, and the end of the last one; e = k + 1.
        threshold: Contribution of one event to a sum.
        where: The file, for error messages.

    Raises:
        CaptureError: A sum is not finite, or not a whole number of thresholds.
    """
    number = sums.astype(np.float64) / threshold  # [k, h, w]
    whole = np.rint(number)
    off = np.abs(number - whole)
    if not (off < OFF_GRID).all():  # also false for NaN
        i = np.unravel_index(int(np.nan_to_num(off, nan=np.inf).argmax()), sums.shape)
        raise CaptureError(
            "a sum of events is not a whole number of thresholds",
            where=f"{where}, window {i[0]}, row {i[1]}, column {i[2]}",
            got=f"{sums[i]:.6g}, threshold {threshold:.6g}",
            do="give the option `threshold`: the factor of the events in the sums",
        )
    k, y, x = np.nonzero(whole)
    count = np.abs(whole[k, y, x]).astype(np.int64)
    event = np.repeat(np.arange(len(k)), count)
    rank = np.arange(len(event)) - np.repeat(np.cumsum(count) - count, count)
    share = (rank + 0.5) / count[event]  # position of an event in its window, 0...1
    t_us = edges_us[k[event]] + np.floor(share * np.diff(edges_us)[k[event]]).astype(np.int64)
    order = np.argsort(t_us, kind="stable")
    event = event[order]
    return EventStream(
        x=x[event].astype(np.uint16),
        y=y[event].astype(np.uint16),
        t_us=t_us[order],
        p=np.sign(whole[k, y, x]).astype(np.int8)[event],
        width=sums.shape[2],
        height=sums.shape[1],
    )


def smallest_step(sums: Float[np.ndarray, "*n h w"]) -> float:
    """The smallest nonzero sum: one threshold, if any window holds a single event.

    Raises:
        CaptureError: All sums are zero.
    """
    size = np.abs(sums[sums != 0])
    if not len(size):
        raise CaptureError("all sums of events are zero", do="give the option `threshold`")
    return float(f"{size.min():.6g}")  # 0.2 is stored as 0.200000003


TEST_EVERY = 8
"""Every this many held-out frames are for testing; rendering all would take hours."""
BOUNDS = (0.5, 1.5)
"""Near and far, relative to the mean distance of the cameras from the origin."""
SAME_POSE = 1e-4
"""Tolerance of the poses of one view."""
PICKLED = ("data_{}.npy", "data_{}.pkl")


@dataclass(frozen=True)
class _Set:
    """The views of one set."""

    name: str
    views: ViewSet
    count: int
    """Number of views."""

    @property
    def poses(self) -> Float64[np.ndarray, "v 3 4"]:
        """One pose for each view."""
        return self.views.poses.reshape(self.count, -1, 3, 4)[:, 0]


def recognise(folder: Path) -> bool:
    """Whether a folder has this layout."""
    files = ("data_frames_train.npy", "data_train.npz", "data_train.npy", "data_train.pkl")
    return (folder / "transforms_train.json").is_file() and any(
        (folder / file).is_file() for file in files
    )


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read all views.

    Args:
        folder: Holds what the module describes.
        options: `trust_pickle` opens pickled files. A pickle can name programs to run; only
            arrays of numbers are built from it, and anything else is refused. `threshold` is
            what one event adds to the sums, where it is not the smallest of them.

    Raises:
        CaptureError: Something is missing, malformed, or inconsistent; or there are only pickled
            streams and they are not trusted.
    """
    sets = [
        _set(folder, name)
        for name in ("train", "val")
        if name == "train" or (folder / f"transforms_{name}.json").is_file()
    ]
    expect_one_camera([one.views for one in sets], folder)
    streams, known, notes = _streams(folder, sets, options)
    images = images_of([one.views for one in sets])
    camera = _camera(sets[0].views, streams, images, folder)
    poses = np.concatenate([one.poses for one in sets])
    distance = float(np.linalg.norm(poses[:, :, 3], axis=1).mean())
    train = sets[0].count
    return Capture(
        camera=camera,
        trajectory=Still(poses),
        clock=ONE_SECOND,
        near=BOUNDS[0] * distance,
        far=BOUNDS[1] * distance,
        frames=None if images is None else _frames(sets, images),
        events=_rig(streams[:train], 0, camera, folder),
        test_events=_rig(streams[train:], train, camera, folder) if streams[train:] else None,
        split=_split(sets, has_images=images is not None),
        name=folder.resolve().name,
        source="evdnerf",
        known=Known(thresholds=known),
        notes=notes,
    )


def _set(folder: Path, name: str) -> _Set:
    """One set, checked to hold static views in the order of view and time."""
    path = folder / f"transforms_{name}.json"
    views = read_views(path)
    count = int((np.abs(views.time - 1) < 1e-5).sum())
    if not count or len(views) % count or len(views) == count:
        raise CaptureError(
            "frames must be in the order of views, each from time 0 to 1",
            where=path,
            got=f"{len(views)} frames, {count} of them at time 1",
            do="order frames by view, then by time",
        )
    time = views.time.reshape(count, -1)
    poses = views.poses.reshape(count, -1, 12)
    moving = np.flatnonzero(np.abs(poses - poses[:, :1]).max((1, 2)) > SAME_POSE)
    if (np.diff(time, axis=1) <= 0).any() or np.abs(time - time[0]).max() > 1e-5:
        raise CaptureError(
            "the views must have the same ascending times",
            where=path,
            do="order frames by view, then by time",
        )
    if len(moving):
        raise CaptureError(
            "the camera of a view must not move",
            where=f"{path}, view {moving[0]}",
            do="write moving cameras in our own layout",
        )
    return _Set(name, views, count)


def _streams(
    folder: Path, sets: list[_Set], options: ReadOptions
) -> tuple[list[EventStream], Thresholds | None, dict[str, Note]]:
    """The events of each view of all sets, their thresholds, and remarks."""
    streams: list[EventStream] = []
    threshold = options.threshold
    notes: dict[str, Note] = {"clock": "defined to last one second"}
    for one in sets:
        plain, sums = folder / f"data_{one.name}.npz", folder / f"data_frames_{one.name}.npy"
        pickled = [folder / name.format(one.name) for name in PICKLED]
        pickled = [path for path in pickled if path.is_file()]
        if plain.is_file():
            found = [array for _, array in sorted(load_arrays(plain).items())]
            streams += [_raw(array, plain) for array in _one_each(found, one, plain)]
        elif pickled and options.trust_pickle:
            found = load_pickled(pickled[0])
            streams += [_raw(array, pickled[0]) for array in _one_each(found, one, pickled[0])]
        elif sums.is_file():
            found, threshold = _summed(sums, one, threshold)
            streams += found
            notes["event_times"] = "known to a window between frames, spread evenly inside"
            if pickled:
                notes["raw_streams"] = f"{pickled[0].name} is pickled and was not read"
        elif pickled:
            raise CaptureError(
                "the event streams are pickled: opening such a file may run code that it contains",
                where=pickled[0],
                do="if you trust its source, give --trust-pickle"
                " (`trust_pickle=True`); or save it with np.savez, one array for each view",
            )
        elif one.name == "train":
            raise CaptureError("there are no events", where=folder, do=f"add {sums.name}")
    return streams, _thresholds(folder, threshold), notes


def _thresholds(folder: Path, threshold: float | None) -> Thresholds | None:
    """The threshold given or found, else those that the file states for both signs."""
    if threshold is not None:
        return Thresholds(threshold, threshold)
    path = folder / "transforms_train.json"
    content = read_json(path)
    if not set(THRESHOLDS) <= content.keys():
        return None
    negative, positive = (number(content, name, path) for name in THRESHOLDS)
    return Thresholds(negative, positive)


def _one_each(
    found: list[Shaped[np.ndarray, "..."]], one: _Set, path: Path
) -> list[Shaped[np.ndarray, "n 4"]]:
    wrong = [array.shape for array in found if array.ndim != 2 or array.shape[1] != 4]
    if len(found) != one.count or wrong:
        raise CaptureError(
            "there must be an array of (t, x, y, p) for each view",
            where=path,
            got=f"{len(found)} arrays for {one.count} views, shapes {wrong[:3] or 'as expected'}",
            do="save one array of four columns for each view",
        )
    return found


def _raw(array: Shaped[np.ndarray, "n 4"], path: Path) -> EventStream:
    """A stream whose sensor resolution is not known yet."""
    t, x, y, p = array.T
    return EventStream(
        x=coordinates(x.astype(np.int64), "x", path),
        y=coordinates(y.astype(np.int64), "y", path),
        t_us=whole_us(t, "ns", path),
        p=polarity(p, path),
        width=0,
        height=0,
    )


def _summed(path: Path, one: _Set, threshold: float | None) -> tuple[list[EventStream], float]:
    """Streams from sums over windows, and their threshold."""
    sums = load_array(path)
    t_us = one.views.t_us[: len(one.views) // one.count]
    windows = len(t_us) - 1
    if sums.ndim != 4 or sums.shape[0] != one.count or sums.shape[1] not in (windows, windows + 1):
        raise CaptureError(
            "the sums of events do not match the views",
            where=path,
            got=f"shape {sums.shape}",
            do=f"it must be ({one.count}, {windows} or {windows + 1}, height, width)",
        )
    step = threshold or smallest_step(sums)
    each = [events_from_sums(view[:windows], t_us, threshold=step, where=path) for view in sums]
    return each, step


def _camera(
    views: ViewSet,
    streams: list[EventStream],
    images: Shaped[np.ndarray, "n h w c"] | None,
    folder: Path,
) -> Camera:
    """The camera, with the size of images or sums; raw streams do not have it."""
    sizes = {(one.width, one.height) for one in streams if one.width}
    sizes |= set() if images is None else {(images.shape[2], images.shape[1])}
    if len(sizes) != 1:
        raise CaptureError(
            "images and events differ in size" if sizes else "the sensor resolution is unknown",
            where=folder,
            got=f"{sorted(sizes)}" if sizes else "no image and no sums of events",
            do="add data_frames_train.npy or images, of one size",
        )
    return views.camera(*sizes.pop())


def _rig(streams: list[EventStream], first: int, camera: Camera, where: Path) -> EventStream:
    """One stream of several views, on tracks from `first` on."""
    sized = [
        replace(
            one,
            width=camera.width,
            height=camera.height,
            track=np.full(len(one), first + k, np.uint16),
            tracks=first + len(streams),
        )
        for k, one in enumerate(streams)
    ]
    return checked(merged(sized), where)


def _frames(sets: list[_Set], images: Shaped[np.ndarray, "n h w c"]) -> Frames:
    t_us = np.concatenate([one.views.t_us for one in sets])
    views = sum(one.count for one in sets)
    each = np.concatenate([np.full(one.count, len(one.views) // one.count) for one in sets])
    return Frames(
        images=images,
        exposure=Exposure(t_us, t_us),
        track=np.repeat(np.arange(views), each),
        names=tuple(name for one in sets for name in one.views.names),
        encoding="srgb",
    )


def _split(sets: list[_Set], *, has_images: bool) -> Split:
    none = np.zeros(0, np.int64)
    if not has_images:
        return Split(none, none)
    train = len(sets[0].views)
    if len(sets) == 1:
        return Split(np.arange(train), none)
    test = np.arange(len(sets[1].views))
    chosen = test % (len(test) // sets[1].count) % TEST_EVERY == TEST_EVERY // 2
    return Split(np.arange(train), train + test[chosen])


LAYOUT = Layout(
    "evdnerf",
    recognise,
    read,
    "transforms_train.json and data_frames_train.npy",
    options=("trust_pickle",),
)
