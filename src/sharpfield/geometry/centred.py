"""A capture seen from its middle: what the cameras look at lies in a box from -1 to 1.

For cameras all around a scene, whose average pose means little.
"""

import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.geometry.focus import focus
from sharpfield.geometry.normalise import moved, reference_poses
from sharpfield.geometry.space import Similarity


def centred(capture: Capture) -> tuple[Capture, Similarity]:
    """The capture in a world whose box from -1 to 1 holds what its cameras look at.

    The box is as wide as what a camera sees around the point that all look at, and nothing of it is
    nearer than the capture's nearest depth. Where there is no such point, it is the one half way
    between the nearest and the farthest depth.
    """
    poses = reference_poses(capture)
    centre, forward = poses[:, :, 3], poses[:, :, 2]
    point = focus(poses)
    if point is None:
        point = (centre + (capture.near + capture.far) / 2 * forward).mean(0)
    distance = float(np.linalg.norm(centre - point, axis=1).mean())
    camera = capture.camera
    seen = distance * max(camera.width / camera.fx_px, camera.height / camera.fy_px) / 2
    half = min(seen, max(distance - capture.near, 0.1 * distance))
    change = Similarity(1 / half, np.eye(3), -point / half)
    return moved(capture, change), change
