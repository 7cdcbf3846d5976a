"""Where neural points start: on surfaces from depth maps, or near a sparse point cloud."""

from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.seed import generator
from sharpfield.core.tone import tone_of
from sharpfield.events.threshold import FixedThresholds
from sharpfield.initialisation.fused_points import FusedPoints, fuse_points
from sharpfield.initialisation.posed_images import sharp_images
from sharpfield.initialisation.start_points import starting_points
from sharpfield.storage.disk_cache import cached_arrays

PAIRS = 1 << 20
"""Pairs of points and cameras compared at once; few enough for the CPU's cache."""

DISTANCE_UNIT = 200.0
"""Distance in world units that counts as much as a right angle to the optical axis, when a camera
is chosen."""

DEFAULT_POINTS = 20_000
"""Number of points where there is no depth and none is asked for."""

POINTS_PER_CUBE = 4.0
"""Mean number of points in occupied cubes two spacings wide."""

HALVINGS = 16
"""Of the interval in which the spacing is searched: to a part in several thousand."""


@dataclass(frozen=True)
class CloudOptions:
    """How many points there are, and where they come from."""

    max_points: int = 0
    """Approximate maximum number; 0 takes one point in each voxel."""
    voxel: float = 0.0
    """Edge of the voxels of depth fusion, in world units; 0 takes a 900th of the scene."""
    frames: Literal["train", "all"] = "train"
    """Whose depth is fused. The released code takes all frames, held-out ones included."""
    min_depth: float = 0.3
    """Smaller depth is left out."""
    max_depth: float = 8.0
    """Larger depth is left out."""
    colours: Literal["camera", "fused"] = "camera"
    """Of one camera, as published, or the mean over all that see a point."""
    noise: float = 0.0
    """Standard deviation of noise on the positions, in world units; the paper studies 0.05."""


@dataclass(frozen=True)
class Cloud:
    """Points to start from."""

    positions: Float32[np.ndarray, "n 3"]
    colours: Float32[np.ndarray, "n c"]
    """As frames store them."""
    directions: Float32[np.ndarray, "n 3"]
    """Unit vectors from a camera that sees each."""
    spacing: float
    """Typical distance to the next point."""

    def __len__(self) -> int:
        """Number of points."""
        return len(self.positions)


def starting_cloud(
    options: CloudOptions,
    capture: Capture,
    seed: int,
    *,
    weight: Float[np.ndarray, "a"] | None = None,
) -> Cloud:
    """Points on the surfaces of a capture; those of a long one are cached on disk.

    Args:
        options: How many, and from where.
        capture: With depth, a sparse cloud, or frames alone.
        seed: Of the run.
        weight: How much each frame counts for colours.
    """
    weights = None if weight is None else weight.tolist()
    about = {"options": asdict(options), "seed": seed, "weight": weights}
    found = cached_arrays(capture, "points", about, lambda: _arrays(options, capture, seed, weight))
    return Cloud(found["positions"], found["colours"], found["directions"], float(found["spacing"]))


def _arrays(
    options: CloudOptions, capture: Capture, seed: int, weight: Float[np.ndarray, "a"] | None
) -> dict[str, np.ndarray]:
    """The arrays of a `Cloud`."""
    if capture.depth is not None:
        positions, colours = _fused(options, capture, weight)
    else:
        positions, colours = _from_images(options, capture, seed)
    if options.noise:
        made = generator(seed, 0, "noise on points")
        drawn = torch.randn(positions.shape, generator=made).numpy()
        positions = positions + np.float32(options.noise) * drawn
    frame, directions = first_cameras(capture, torch.from_numpy(positions))
    if options.colours == "camera":
        colours = colours_seen(capture, torch.from_numpy(positions), frame).numpy()
    return {
        "positions": positions,
        "colours": np.ascontiguousarray(colours[:, : capture.needed_frames.channels]),
        "directions": directions.numpy(),
        "spacing": np.array(typical_spacing(positions)),
    }


def typical_spacing(positions: Float32[np.ndarray, "n 3"]) -> float:
    """Distance between neighbours of points on surfaces: half the cubes that hold four of them."""
    low = positions.min(0)
    extent = float(np.ptp(positions, axis=0).max())
    small, large = 1e-6, extent + 1e-6
    for _ in range(HALVINGS):
        edge = (small * large) ** 0.5
        cell = ((positions - low) / edge).astype(np.int64)
        number = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
        occupied = 1 + np.count_nonzero(np.diff(np.sort(number)))
        crowded = len(positions) > POINTS_PER_CUBE * occupied
        small, large = (small, edge) if crowded else (edge, large)
    return (small * large) ** 0.5 / 2


def first_cameras(
    capture: Capture, positions: Float[Tensor, "n 3"]
) -> tuple[Int64[Tensor, "n"], Float[Tensor, "n 3"]]:
    """The training frame that each point belongs to, and the direction from it to the point.

    The frame is near, and its optical axis points towards the point; occlusion is ignored.

    Source: the released code of Hybrid Neural Rendering.
    """
    train = torch.as_tensor(capture.split.train)
    pose = capture.frame_pose(capture.split.train).detach().float()
    centre, axis = pose[:, :, 3], pose[:, :, 2]
    middle = centre.mean(0)  # sums of squares lose less when they are small
    square, own = (centre - middle).square().sum(-1), ((centre - middle) * axis).sum(-1)
    best = []
    for part in (positions - middle).split(max(PAIRS // len(train), 1)):
        distance = torch.addmm(square, part, (centre - middle).T, alpha=-2)
        distance = distance.add_(part.square().sum(-1, keepdim=True)).clamp_min_(1e-12).sqrt_()
        along = torch.addmm(own, part, axis.T, beta=-1).div_(distance)
        best.append(along.sub_(distance.div_(DISTANCE_UNIT)).argmax(-1))
    chosen = torch.cat(best)
    way = positions - centre[chosen]
    return train[chosen], way / way.norm(dim=-1, keepdim=True).clamp_min(1e-6)


def colours_seen(
    capture: Capture, positions: Float[Tensor, "n 3"], frame: Int64[Tensor, "n"]
) -> Float[Tensor, "n c"]:
    """Stored values at the projections of points, each in one frame; 0 outside its image."""
    frames, camera = capture.needed_frames, capture.camera
    found = torch.zeros(len(positions), frames.channels)
    order = frame.argsort(stable=True)
    asked, counts = frame.unique(return_counts=True)
    poses = capture.frame_pose(asked.numpy()).detach().float()
    for one, pose, here in zip(asked.tolist(), poses, order.split(counts.tolist()), strict=True):
        seen = (positions[here] - pose[:, 3]) @ pose[:, :3]
        ahead = seen[:, 2] > 1e-6
        xy = camera.project(torch.where(ahead[:, None], seen, torch.tensor([0.0, 0.0, 1.0])))
        image = torch.from_numpy(np.asarray(frames.images[one]).astype(np.float32)) / frames.white
        grid = xy / xy.new_tensor(camera.size) * 2 - 1
        colour = torch.nn.functional.grid_sample(
            image.permute(2, 0, 1)[None], grid[None, None], align_corners=False
        )[0, :, 0].T
        found[here] = colour * ahead[:, None]
    return found


def _fused(
    options: CloudOptions, capture: Capture, weight: Float[np.ndarray, "a"] | None
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    def fused(voxel: float, stride: int) -> FusedPoints:
        return fuse_points(
            capture,
            frames=options.frames,
            stride=stride,
            voxel=voxel,
            min_depth=options.min_depth,
            max_depth=options.max_depth,
            weight=weight,
        )

    stride, voxel = 1 if capture.needed_depth.camera.width <= 320 else 2, options.voxel
    if not voxel:  # a 900th of the edge of a cube a little larger than the scene
        coarse = (options.max_depth if np.isfinite(options.max_depth) else capture.far) / 50
        voxel = 1.05 * float(np.ptp(fused(coarse, 8).points, axis=0).max()) / 900
    cloud = fused(voxel, stride)
    for _ in range(3):  # points on surfaces grow with the square of how fine voxels are
        if not options.max_points or len(cloud) <= 1.1 * options.max_points:
            break
        voxel *= (len(cloud) / options.max_points) ** 0.5
        cloud = fused(voxel, stride)
    return cloud.points, cloud.colours


def _from_images(
    options: CloudOptions, capture: Capture, seed: int
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n c"]]:
    """Random pixels, at the depth of a sparse cloud around them."""
    tone = tone_of(capture.needed_frames.encoding)
    images = sharp_images(capture.without(events=True), FixedThresholds(1.0, 1.0))
    count = options.max_points or DEFAULT_POINTS
    made = generator(seed, 0, "cloud")
    start = starting_points(images, count, made, known=capture.points)
    return start.points, tone.encode(torch.from_numpy(start.colours)).clamp(0, 1).numpy()
