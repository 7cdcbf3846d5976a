"""`sharpfield poses`: estimate camera poses, or attach those of another program."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional

from sharpfield.cli.arguments import screen
from sharpfield.core.errors import OptionError
from sharpfield.core.files import write_json
from sharpfield.preparation.options import PoseOptions

if TYPE_CHECKING:
    from sharpfield.captures.trajectory_files import ExternalPath
    from sharpfield.core.capture import Capture
    from sharpfield.preparation.poses.external import Mount

REPORT, PAGE = "poses.json", "poses.html"


@dataclass(frozen=True)
class Elsewhere:
    """Poses from another program, a tracker or an encoder."""

    trajectory: Path | None = None
    """A file of poses to attach instead of estimating them."""
    align: Path | None = None
    """A file of poses whose world the estimated poses are aligned with."""
    layout: Literal["tum", "euroc", "kitti", "csv", "npz", "colmap"] | None = None
    """Layout of that file, if it is not recognised: tum, euroc, kitti, csv, npz or colmap."""
    offset_ms: float = 0.0
    """Time offset in ms that is added to the times of that file."""
    hand_eye: Path | None = None
    """File of the camera's pose on the tracked body: a matrix, or x y z qx qy qz qw."""
    bounds: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="NEAR FAR")] = None
    """Nearest and farthest depth of the scene in world units, with --trajectory."""

    def __post_init__(self) -> None:
        if self.trajectory is not None and self.align is not None:
            raise OptionError(
                "give either --trajectory or --align", got=f"{self.trajectory} and {self.align}"
            )

    def mount(self) -> "Mount":
        """Pose on the tracked body, and time offset, of the camera."""
        from sharpfield.captures.trajectory_files import read_hand_eye
        from sharpfield.preparation.poses.external import Mount

        hand = None if self.hand_eye is None else read_hand_eye(self.hand_eye)
        return Mount(round(1000 * self.offset_ms), hand)


FINDING, ELSEWHERE = PoseOptions(), Elsewhere()


def poses_command(
    capture: Positional[Path],
    out: Path,
    options: PoseOptions = FINDING,
    elsewhere: Elsewhere = ELSEWHERE,
) -> None:
    """Estimate camera poses from frames deblurred with the events, or attach known poses.

    Args:
        capture: Folder of the capture; its own poses are ignored.
        out: Folder of the new capture, with `poses.json` and `poses.html`.
        options: Images, intrinsics, lens.
        elsewhere: Poses from a file.
    """
    from sharpfield.captures.native import layout as native
    from sharpfield.captures.read import read_capture
    from sharpfield.captures.trajectory_files import read_path
    from sharpfield.preparation.poses.external import known_at
    from sharpfield.preparation.poses.find import find_poses
    from sharpfield.preparation.poses.report import poses_summary, poses_text, write_poses_page
    from sharpfield.storage.arrays import expect_replaceable

    expect_replaceable(out, native.recognise)
    original, mount = read_capture(capture, poses=False), elsewhere.mount()
    if elsewhere.trajectory is not None:
        path = read_path(elsewhere.trajectory, elsewhere.layout)
        _attach(original, path, mount, elsewhere.bounds, out)
        return
    known = None
    if elsewhere.align is not None:
        known = partial(known_at, read_path(elsewhere.align, elsewhere.layout), mount)
    found = find_poses(original, options, known=known)
    native.write(replace(found.capture, name=out.name), out)
    about = poses_summary(original, found)
    write_json(out / REPORT, about)
    write_poses_page(out / PAGE, original, found, about)
    console = screen()
    console.print(poses_text(about), soft_wrap=True)
    console.print(f"The capture with poses is in {out}; open {out / PAGE}", soft_wrap=True)


def _attach(
    original: "Capture",
    path: "ExternalPath",
    mount: "Mount",
    bounds: tuple[float, float] | None,
    out: Path,
) -> None:
    import numpy as np

    from sharpfield.captures.native import layout as native
    from sharpfield.preparation.poses.external import attach

    attached = attach(original, path, mount, bounds=bounds)
    made = attached.capture
    native.write(replace(made, name=out.name), out)
    names: tuple[str, ...] = () if original.frames is None else original.frames.names
    lost = [str(names[int(i)]) for i in np.setdiff1d(np.arange(len(names)), attached.kept)]
    about = {
        "capture": original.name,
        "poses_from": path.layout,
        "poses": len(path.poses),
        "offset_us": mount.offset_us,
        "covered_us": attached.covered_us,
        "frames": {"before": len(names), "after": len(attached.kept), "left_out": lost},
        "bounds": {"near": made.near, "far": made.far},
    }
    write_json(out / REPORT, about)
    said = f"{len(path.poses)} poses ({path.layout}) attached; {len(attached.kept)} of"
    said += f" {len(names)} frames and {len(made.events or ()):,} events are covered"
    if lost:
        said += f"; left out: {', '.join(lost[:8])}{', ...' if len(lost) > 8 else ''}"
    screen().print(f"{said}\nThe capture with poses is in {out}")
