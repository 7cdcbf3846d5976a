"""What takes long to find out about a long capture, found once and kept beside its images.

Which frames are sharp, or what their depth shows together, takes minutes for thousands of frames,
and a run that is resumed or rendered asks again. So answers about captures whose images are mapped
(`captures.mapped_images`) are kept in the same folder, under a name that changes with whatever they
depend on. Short captures are asked again each time. Derived: delete it when you like.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.files import replacing
from sharpfield.events.index_files import file_key
from sharpfield.storage.arrays import load_arrays, write_arrays

FORMAT = 1
"""Raise it when an answer would come out differently: older ones are then left alone."""

Arrays = Mapping[str, Shaped[np.ndarray, "..."]]


def kept(
    capture: Capture, name: str, about: Mapping[str, Any], find: Callable[[], Arrays]
) -> Arrays:
    """An answer about the frames, depth and poses of a capture.

    Args:
        capture: With frames.
        name: Of the question.
        about: What else the answer depends on, as JSON.
        find: Works the answer out.
    """
    maps = [capture.needed_frames.images]
    if capture.depth is not None:
        maps.append(capture.depth.stored)
    files = [Path(held.filename) for held in maps if isinstance(held, np.memmap) and held.filename]
    if len(files) < len(maps):
        return find()
    key = hashlib.blake2b(json.dumps([FORMAT, about], sort_keys=True).encode(), digest_size=10)
    key.update(f"{file_key(*files)} {_world(capture)}".encode())
    for array in (
        capture.frame_pose(np.arange(len(capture.needed_frames))).detach().double().numpy(),
        capture.split.train,
        np.zeros(0) if capture.points is None else capture.points,
    ):
        key.update(np.ascontiguousarray(array).data)
    place = files[0].parent / f"{name}-{key.hexdigest()}.npz"
    if place.exists():
        try:
            return load_arrays(place)
        except CaptureError:  # damaged: it is derived, so find it again
            place.unlink()
    found = find()
    with replacing(place) as temporary:
        write_arrays(temporary, found)
    return found


def _world(capture: Capture) -> str:
    """Cameras and units."""
    depth = capture.depth
    return json.dumps(
        [
            dataclasses.asdict(capture.camera),
            capture.near,
            capture.far,
            capture.needed_frames.encoding,
            None if depth is None else [dataclasses.asdict(depth.camera), depth.unit],
        ]
    )
