"""Read a capture: recognise the layout of a folder, read it, and apply the options of the user."""

from dataclasses import replace
from pathlib import Path

from sharpfield.captures.layout import FOR_ALL, NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.native.layout import expect_poses
from sharpfield.captures.splits import split_by_rule
from sharpfield.core.capture import Capture, Thresholds
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.plugins import Registry

_ROOM = "sharpfield.captures"
LAYOUTS = Registry(
    "sharpfield.layouts",
    {
        "native": f"{_ROOM}.native.layout:LAYOUT",
        "ev-deblur-nerf": f"{_ROOM}.layouts.llff_events:LAYOUT",
        "deblur-nerf": f"{_ROOM}.layouts.deblur_nerf:LAYOUT",
        "evdnerf": f"{_ROOM}.layouts.evdnerf:LAYOUT",
        "event-nerf": f"{_ROOM}.layouts.event_nerf:LAYOUT",
        "robust-e-nerf": f"{_ROOM}.layouts.robust_e_nerf:LAYOUT",
        "scannet": f"{_ROOM}.layouts.scannet:LAYOUT",
        "sens": f"{_ROOM}.layouts.sens_file:LAYOUT",
        "arkitscenes": f"{_ROOM}.layouts.arkitscenes:LAYOUT",
        "7-scenes": f"{_ROOM}.layouts.seven_scenes:LAYOUT",
        "d-nerf": f"{_ROOM}.layouts.blender:D_NERF",
        "nerf-synthetic": f"{_ROOM}.layouts.blender:NERF",
        "nerfstudio": f"{_ROOM}.layouts.nerfstudio:LAYOUT",
        "colmap": f"{_ROOM}.layouts.colmap:LAYOUT",
    },
)
"""Every layout by name; the first that recognises a folder reads it."""


def read_capture(
    folder: Path | str, options: ReadOptions = NO_OPTIONS, *, poses: bool = True
) -> Capture:
    """Read a capture.

    Args:
        folder: The folder that holds the images or events.
        options: How to read it, where its layout is wrong or silent.
        poses: Whether the poses must be known; what comes before training needs none.

    Raises:
        CaptureError: The capture cannot be read, or its poses are unknown and `poses` is set.
        OptionError: An option does not fit the layout.
    """
    folder = Path(folder)
    layout: Layout = LAYOUTS.named(options.layout or layout_of(folder), "layout")
    for name in options.given().keys() - {*FOR_ALL, *layout.options}:
        others = [known for known, one in LAYOUTS.working().items() if name in one.options]
        raise OptionError(
            f"the layout {layout.name} has no option {name}",
            where=folder,
            do=f"it belongs to {', '.join(others)}",
        )
    capture = layout.read(folder, options)
    if poses:
        expect_poses(capture, folder)
    return _with_options(capture, options)


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
    layouts: dict[str, Layout] = LAYOUTS.working()
    for name, layout in layouts.items():
        if layout.recognise(folder):
            return name
    raise CaptureError(
        "unknown layout of a capture",
        where=folder,
        got=", ".join(sorted(entry.name for entry in folder.iterdir())[:8]) or "an empty folder",
        do="it must hold " + "; or ".join(f"{x.marks} ({name})" for name, x in layouts.items()),
    )


def _with_options(capture: Capture, options: ReadOptions) -> Capture:
    """The capture with the options that apply to every layout."""
    known = capture.known
    if options.encoding is not None:
        frames = replace(capture.needed_frames, encoding=options.encoding)
        capture = replace(capture, frames=frames)
    if options.hold_out is not None:
        split = split_by_rule(len(capture.needed_frames), options.hold_out)
        capture = replace(capture, split=split)
    if options.threshold is not None:
        known = replace(known, thresholds=Thresholds(options.threshold, options.threshold))
    if options.bounds is not None:
        known = replace(known, bounds="known")
        capture = replace(capture, near=options.bounds[0], far=options.bounds[1])
    return replace(capture, known=known)
