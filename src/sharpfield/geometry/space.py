"""Spaces in which a scene is sampled: normalised device coordinates (NDC), or metric depth.

A recipe works in a normalised world: the nearest depth is 4/3, and the average camera is the
origin. In that world a volume is sampled either in NDC, which map a view frustum to a cube, or
evenly in depth.

Axes are OpenCV's (y down, z forward), so NDC here is the mirror image, in y, of the customary
one. Source: LLFF (SIGGRAPH 2019) for the normalisation; NeRF (ECCV 2020), appendix C, for NDC.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.rays import Rays

NEAREST = 0.75
"""Fraction of the nearest depth that becomes 1: content starts a little behind the NDC plane."""

BOX_MARGIN = (0.01, 0.01, 0.0001)
"""How much the scene box of an NDC field is enlarged, per axis (PDRF)."""

FORWARD_DEG = 60.0
"""Cameras that all look within this of their average direction make a forward-facing scene."""

CANCELLED = 1e-6
"""Length of a mean of directions below which it has no direction."""


@dataclass(frozen=True)
class Similarity:
    """The similarity transform `p -> scale * rotation @ p + translation`."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def points(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Transformed points."""
        return self.scale * points @ self.rotation.T + self.translation

    def poses(self, poses: Float[np.ndarray, "*n 3 4"]) -> Float[np.ndarray, "*n 3 4"]:
        """World-from-camera poses in the new world; their rotations stay orthonormal."""
        centre = self.points(poses[..., 3])
        return np.concatenate([self.rotation @ poses[..., :3], centre[..., None]], -1)

    def inverse(self) -> "Similarity":
        """The inverse transform."""
        back = self.rotation.T / self.scale
        return Similarity(1 / self.scale, self.rotation.T, -back @ self.translation)


def average_pose(poses: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "3 4"]:
    """A camera at the mean position that looks along the mean direction.

    Where directions cancel, as on a ring, that of the first camera is taken.
    """
    forward = _mean_direction(poses[:, :, 2])
    across = np.cross(_mean_direction(poses[:, :, 1]), forward)
    right = _unit(across if np.linalg.norm(across) > CANCELLED else poses[0, :, 0])
    down = _unit(np.cross(forward, right))
    return np.stack([right, down, forward, poses[:, :, 3].mean(0)], 1)


def normalisation(poses: Float[np.ndarray, "n 3 4"], near: float) -> Similarity:
    """The similarity after which the nearest depth is 4/3 and the average camera at the origin.

    Args:
        poses: World-from-camera poses the average is taken over.
        near: Nearest depth of the scene.
    """
    scale = 1 / (NEAREST * near)
    centre = average_pose(poses)
    rotation = centre[:, :3].T
    return Similarity(scale, rotation, -scale * rotation @ centre[:, 3])


def forward_facing(poses: Float[np.ndarray, "n 3 4"]) -> bool:
    """Whether all cameras look in roughly the same direction, so that NDC fit the scene."""
    forward = _mean_direction(poses[:, :, 2])
    return bool((poses[:, :, 2] @ forward > np.cos(np.radians(FORWARD_DEG))).all())


def ndc(
    origin: Float[Tensor, "*b 3"],
    direction: Float[Tensor, "*b 3"],
    camera: Camera,
    near: float = 1.0,
) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
    """Rays in normalised device coordinates: `origin + z direction`, z from 0 (near) to 1 (far).

    Args:
        origin: In the normalised world; the camera looks along +z.
        direction: Of any length; must point forward.
        camera: Gives the frustum.
        near: Depth of the plane that becomes z = 0.

    Returns:
        Origin on the near plane, and a direction that is not normalised.
    """
    depth = (near - origin[..., 2:]) / direction[..., 2:]
    start = origin + depth * direction
    wide = start.new_tensor([2 * camera.fx_px / camera.width, 2 * camera.fy_px / camera.height])
    ratio = start[..., :2] / start[..., 2:]
    toward = direction[..., :2] / direction[..., 2:]
    z = 1 - 2 * near / start[..., 2:]
    return torch.cat([wide * ratio, z], -1), torch.cat([wide * (toward - ratio), 1 - z], -1)


@dataclass(frozen=True)
class Frustum:
    """A volume sampled in NDC: densely near the cameras, and out to infinity."""

    camera: Camera
    near: float = 0.0
    far: float = 1.0

    def warp(self, rays: Rays) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
        """Origin and direction for which `origin + z direction`, z in near...far, is the ray."""
        return ndc(rays.origin, rays.direction, self.camera)

    def depth(self, z: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Distance from the camera plane, in normalised units, of ray parameter z."""
        return 1 / (1 - z).clamp_min(1e-6)

    def box(self, poses: Float[Tensor, "n 3 4"]) -> Float[Tensor, "2 3"]:
        """Corners of a box around the view frusta (PDRF): low, high."""
        origin, direction = ndc(*_corner_rays(self.camera, poses), self.camera)
        ends = torch.cat([origin.reshape(-1, 3), (origin + direction).reshape(-1, 3)])
        margin = ends.new_tensor(BOX_MARGIN)
        return torch.stack([ends.amin(0) - margin, ends.amax(0) + margin])


@dataclass(frozen=True)
class EvenDepth:
    """A volume sampled evenly in distance between two depths."""

    camera: Camera
    near: float
    far: float

    def warp(self, rays: Rays) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
        """The ray itself."""
        return rays.origin, rays.direction

    def depth(self, z: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """The distance itself."""
        return z

    def box(self, poses: Float[Tensor, "n 3 4"]) -> Float[Tensor, "2 3"]:
        """Corners of a box around the view frusta between near and far: low, high."""
        origin, direction = _corner_rays(self.camera, poses)
        ends = torch.cat([(origin + z * direction).reshape(-1, 3) for z in (self.near, self.far)])
        return torch.stack([ends.amin(0), ends.amax(0)])


Space = Frustum | EvenDepth


def _corner_rays(camera: Camera, poses: Float[Tensor, "n 3 4"]) -> tuple[Tensor, Tensor]:
    """Rays of the four corner pixels of every camera, through the corners' own coordinates."""
    right, bottom = camera.width - 1.0, camera.height - 1.0
    xy = poses.new_tensor([[0, 0], [right, 0], [0, bottom], [right, bottom]])
    direction = camera.direction(xy)  # [4, 3]
    turned = torch.einsum("nij,kj->nki", poses[:, :, :3], direction)
    return poses[:, None, :, 3].expand_as(turned), turned


def _mean_direction(directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    mean = directions.mean(0)
    return _unit(mean if np.linalg.norm(mean) > CANCELLED else directions[0])


def _unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return vector / np.linalg.norm(vector)
