"""Rays of pixels, from a camera and its pose."""

from jaxtyping import Float
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.rays import Rays
from sharpfield.geometry import se3


def cast(
    camera: Camera,
    pose: Float[Tensor, "*b 3 4"],
    xy: Float[Tensor, "*#b 2"],
    time: Float[Tensor, "*b"],
    weight: Float[Tensor, "*b"],
) -> Rays:
    """World rays of pixels.

    Args:
        camera: Lens and sensor.
        pose: World-from-camera of each ray.
        xy: Pixel positions (centres at +0.5); axes of size one are broadcast, so that several rays
            of one pixel share the undistortion.
        time: Kept in the rays, 0...1 of the capture.
        weight: Kept in the rays.
    """
    direction = camera.direction(xy).expand(*pose.shape[:-2], 3)
    return Rays(pose[..., 3], se3.rotate(pose, direction), time, weight)
