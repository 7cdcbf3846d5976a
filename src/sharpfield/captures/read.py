"""Look at a path, recognise its layout, and read it. A new layout is one line in `LAYOUTS`."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from sharpfield.captures.hold_out import split_by_rule
from sharpfield.captures.layouts import (
    arkitscenes,
    colmap,
    d_nerf,
    deblur_nerf,
    evdnerf,
    event_nerf,
    llff_events,
    nerf_synthetic,
    nerfstudio,
    robust_e_nerf,
    scannet,
    sens_file,
    seven_scenes,
)
from sharpfield.captures.layouts._photos import Missing
from sharpfield.captures.native import layout as native
from sharpfield.core.capture import Capture, Thresholds
from sharpfield.core.errors import CaptureError, OptionError


@dataclass(frozen=True)
class Layout:
    """A way to lay a capture out on disk."""

    recognise: Callable[[Path], bool]
    """Whether a folder has this layout, judged by its files without loading them."""
    read: Callable[..., Capture]
    """Takes the folder, and the options below."""
    marks: str
    """The files it is recognised by, for the message when nothing is."""
    options: tuple[str, ...] = ()
    """Options of `read` that only some layouts have."""


LAYOUTS: dict[str, Layout] = {
    "native": Layout(native.recognise, native.read_unposed, "capture.toml"),
    "ev-deblur-nerf": Layout(
        llff_events.recognise,
        llff_events.read,
        "poses_bounds.npy, all_poses_bounds.npy and events.h5",
        options=("event_unit",),
    ),
    "deblur-nerf": Layout(deblur_nerf.recognise, deblur_nerf.read, "poses_bounds.npy and images*/"),
    "evdnerf": Layout(
        evdnerf.recognise,
        evdnerf.read,
        "transforms_train.json and data_frames_train.npy",
        options=("trust_pickle", "threshold"),
    ),
    "event-nerf": Layout(
        event_nerf.recognise,
        event_nerf.read,
        "train/pose/, train/intrinsics/ and train/events/*.npz",
        options=("event_unit",),
    ),
    "robust-e-nerf": Layout(
        robust_e_nerf.recognise,
        robust_e_nerf.read,
        "raw_events.npz, camera_poses.npz and camera_calibration.npz",
    ),
    "scannet": Layout(
        scannet.recognise, scannet.read, "color/, pose/ and intrinsic/intrinsic_color.txt"
    ),
    "sens": Layout(sens_file.recognise, sens_file.read, "one .sens file"),
    "arkitscenes": Layout(
        arkitscenes.recognise, arkitscenes.read, "lowres_wide/ and lowres_wide.traj"
    ),
    "7-scenes": Layout(seven_scenes.recognise, seven_scenes.read, "frame-*.color.png"),
    "d-nerf": Layout(
        d_nerf.recognise,
        d_nerf.read,
        "transforms_train.json with a `time` in each frame",
        options=("missing",),
    ),
    "nerf-synthetic": Layout(
        nerf_synthetic.recognise,
        nerf_synthetic.read,
        "transforms_train.json",
        options=("missing",),
    ),
    "nerfstudio": Layout(
        nerfstudio.recognise, nerfstudio.read, "transforms.json", options=("missing",)
    ),
    "colmap": Layout(
        colmap.recognise, colmap.read, "sparse/0/cameras.bin and images*/", options=("missing",)
    ),
}
"""Every layout that can be read, by name; the first that recognises a folder reads it."""


def layout_of(folder: Path) -> str:
    """The name of a folder's layout.

    Raises:
        CaptureError: There is no such folder, or no layout recognises it.
    """
    if not folder.is_dir():
        raise CaptureError(
            "capture not found" if not folder.exists() else "a capture is a folder, not a file",
            where=folder,
            do="give the folder that holds the images or events",
        )
    for name, layout in LAYOUTS.items():
        if layout.recognise(folder):
            return name
    raise CaptureError(
        "no known layout",
        where=folder,
        got=", ".join(sorted(entry.name for entry in folder.iterdir())[:8]) or "an empty folder",
        do="it must hold " + "; or ".join(f"{x.marks} ({name})" for name, x in LAYOUTS.items()),
    )


def read(
    folder: Path | str,
    *,
    layout: str | None = None,
    event_unit: str | None = None,
    missing: Missing | None = None,
    encoding: str | None = None,
    hold_out: str | None = None,
    threshold: float | None = None,
    trust_pickle: bool = False,
) -> Capture:
    """Read a capture.

    Args:
        folder: The capture.
        layout: One of `LAYOUTS`; by default it is recognised.
        event_unit: Unit of the event times (ns, us, ms, s), where it is not what the layout has.
        missing: Whether images that are named but not there are an "error" or to "skip".
        encoding: How stored values relate to light (see `Frames`), where the layout is wrong.
        hold_out: Frames to hold out: `every:8`, `train:5`, `last:5` or `none`; by default as the
            layout says.
        threshold: Contrast threshold of the events for both signs, where it is known better.
        trust_pickle: Open pickled files, which may name programs to run; only arrays of numbers
            are built from them, and anything else is refused.

    Raises:
        CaptureError: The capture cannot be read, or nobody knows its poses yet.
        OptionError: An option does not fit the layout.
    """
    capture = read_unposed(
        folder,
        layout=layout,
        event_unit=event_unit,
        missing=missing,
        threshold=threshold,
        trust_pickle=trust_pickle,
    )
    native.expect_poses(capture, folder)
    if encoding is not None:
        capture = replace(capture, frames=replace(capture.needed_frames, encoding=encoding))
    if hold_out is not None:
        capture = replace(capture, split=split_by_rule(len(capture.needed_frames), hold_out))
    return capture


def read_unposed(
    folder: Path | str,
    *,
    layout: str | None = None,
    event_unit: str | None = None,
    missing: Missing | None = None,
    threshold: float | None = None,
    trust_pickle: bool = False,
) -> Capture:
    """Read a capture, whether its poses are known or not; see `native.read_unposed`.

    The options are those of `read`.

    Raises:
        CaptureError: The capture cannot be read.
        OptionError: An option does not fit the layout.
    """
    folder = Path(folder)
    name = layout or layout_of(folder)
    if name not in LAYOUTS:
        raise OptionError("unknown layout", got=name, do=f"use one of {', '.join(LAYOUTS)}")
    options = {
        "event_unit": event_unit,
        "missing": missing,
        "trust_pickle": trust_pickle or None,
        "threshold": threshold if "threshold" in LAYOUTS[name].options else None,
    }
    given = {option: value for option, value in options.items() if value is not None}
    for option in given.keys() - set(LAYOUTS[name].options):
        able = [other for other in LAYOUTS if option in LAYOUTS[other].options]
        raise OptionError(
            f"the layout {name} has no option {option}",
            where=folder,
            do=f"it belongs to {', '.join(able)}",
        )
    capture = LAYOUTS[name].read(folder, **given)
    if threshold is not None:
        known = replace(capture.known, thresholds=Thresholds(threshold, threshold))
        capture = replace(capture, known=known)
    return capture
