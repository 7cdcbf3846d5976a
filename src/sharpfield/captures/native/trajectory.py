"""Cameras and trajectories in our own layout.

A camera is a table of `capture.toml` with the fields of `Camera` by their names. A trajectory is
`trajectory.npz`, described by a table of `capture.toml`.

Times are int64 us and poses float64 `[3 4]`, world-from-camera, OpenCV axes. The table's `kind` is

- `stamped`: arrays `times_us`, `poses`, interpolated with `translation` "cubic" or "linear";
- `still`: array `poses`, one per track;
- `bspline`: arrays `knots`, `twist`, spanning `start_us` to `end_us`;
- `tracks`: `moving` describes the tracks 0, 1, ... of the kinds above, whose arrays begin with
  `0_`, `1_`, ...; `poses` are the still tracks.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Shaped

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Clock
from sharpfield.core.errors import CaptureError
from sharpfield.core.protocols import Trajectory
from sharpfield.geometry.trajectory import BSpline, Stamped, Still, Tracks
from sharpfield.storage.arrays import load_arrays, write_arrays
from sharpfield.storage.toml_tables import Table


def camera_table(camera: Camera) -> dict[str, Any]:
    """The table of a camera."""
    table = dataclasses.asdict(camera)
    return table | {"distortion": list(camera.distortion)}


def read_camera(table: Table) -> Camera:
    """Read a table of `camera_table`.

    Raises:
        CaptureError: A value is missing, malformed or unknown.
    """
    table.expect_only(*(field.name for field in dataclasses.fields(Camera)))
    return Camera(
        width=table.whole("width"),
        height=table.whole("height"),
        fx_px=table.number("fx_px"),
        fy_px=table.number("fy_px"),
        cx_px=table.number("cx_px"),
        cy_px=table.number("cy_px"),
        lens=table.text("lens", "pinhole"),
        distortion=table.numbers("distortion", []),
    )


FILE = "trajectory.npz"

Storable = Stamped | Still | BSpline | Tracks

Arrays = Mapping[str, Shaped[np.ndarray, "..."]]


def write_trajectory(trajectory: Trajectory, folder: Path) -> dict[str, Any]:
    """Write the arrays of a trajectory, and return the table that describes it.

    Raises:
        CaptureError: It is of another kind, for instance a learned one.
    """
    table, arrays = _packed(trajectory)
    write_arrays(folder / FILE, arrays)
    return table


def read_trajectory(table: Table, folder: Path, clock: Clock) -> Trajectory:
    """Read the trajectory that `write_trajectory` wrote.

    Raises:
        CaptureError: The file is missing or malformed.
    """
    return _unpacked(table, load_arrays(folder / FILE), clock, prefix="")


def _packed(trajectory: object) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    match trajectory:
        case Stamped():
            return (
                {"kind": "stamped", "translation": trajectory.translation},
                {"times_us": trajectory.times_us, "poses": trajectory.poses},
            )
        case Still():
            return {"kind": "still"}, {"poses": trajectory.poses}
        case BSpline():
            return (
                {"kind": "bspline", "start_us": trajectory.start_us, "end_us": trajectory.end_us},
                {
                    "knots": trajectory.get_buffer("knots").numpy(),
                    "twist": trajectory.twist.detach().numpy(),
                },
            )
        case Tracks():
            moving = [_packed(path) for path in trajectory.moving]
            arrays = {
                f"{i}_{name}": array
                for i, (_, members) in enumerate(moving)
                for name, array in members.items()
            }
            table = {"kind": "tracks", "moving": [about for about, _ in moving]}
            return table, arrays | {"poses": trajectory.still.poses}
    raise CaptureError(
        "this kind of trajectory cannot be written",
        got=type(trajectory).__name__,
        do="sample it at known times first: Stamped(times_us, poses, clock)",
    )


def _unpacked(table: Table, arrays: Arrays, clock: Clock, *, prefix: str) -> Storable:
    def array(name: str) -> Shaped[np.ndarray, "..."]:
        if prefix + name not in arrays:
            raise CaptureError(
                f"array {prefix + name} is missing",
                where=FILE,
                got=", ".join(arrays) or "no arrays",
                do=f"see {table.where}",
            )
        return arrays[prefix + name]

    kind = table.text("kind")
    if kind == "stamped":
        times_us = array("times_us").astype(np.int64)
        return Stamped(times_us, array("poses"), clock, table.text("translation", "cubic"))
    if kind == "still":
        return Still(array("poses"))
    if kind == "bspline":
        path = BSpline(
            torch.from_numpy(array("knots")), table.whole("start_us"), table.whole("end_us"), clock
        )
        with torch.no_grad():
            path.twist.copy_(torch.from_numpy(array("twist")))
        return path
    if kind == "tracks":
        moving = [
            _unpacked(about, arrays, clock, prefix=f"{i}_")
            for i, about in enumerate(table.tables("moving"))
        ]
        return Tracks(moving, array("poses"))
    raise CaptureError(
        "unknown kind of trajectory",
        where=table.where,
        got=kind,
        do="use stamped, still, bspline or tracks",
    )
