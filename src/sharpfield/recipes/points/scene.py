"""The sharp scene of the recipes on neural points: a cloud from depth, its networks, and growth.

A ray *misses* if no point is near it although its pixel differs from the background. Where a ray
beside such a pixel has a single opaque sample, a point is added there, with the mean descriptor of
its neighbours. So surfaces grow at their edges, round after round.

Source: Point-NeRF (CVPR 2022), section 4.3; numbers from the released code of Hybrid Neural
Rendering.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.protocols import Growth
from sharpfield.core.rays import Rays
from sharpfield.core.schedule import Group, Schedule
from sharpfield.core.seed import generator, numpy_generator
from sharpfield.fields.neural_points import (
    LEAST_CONFIDENCE,
    NeuralPoints,
    PointField,
    PointSizes,
    shares,
)
from sharpfield.formation.shutter import Pinhole
from sharpfield.geometry.rays import cast
from sharpfield.initialisation.point_cloud import CloudOptions, starting_cloud
from sharpfield.rendering.points import Colour, PointMarch, PointRadiance

VOXEL_OF_SPACING = 0.8
"""Edge of a voxel over the distance between points: 8 mm for the points of a ninehundredth."""

CELL, RADIUS = 2, 4
"""Edge of the cells in which neighbours are looked up, and how far neighbours are, in voxels."""

STEP = 2.5
"""Length of steps, in voxels, where their number is left open."""

BEYOND = 1.25
"""Rays at the corners of an image are longer than the depth there by about so much."""


@dataclass(frozen=True)
class MarchOptions:
    """Samples on rays through points. Defaults: Hybrid Neural Rendering's for ScanNet."""

    voxel: float = 0.008
    """Edge of a voxel in world units; 0 takes 0.8 times the distance between points. Neighbours are
    up to 4 voxels away."""
    steps: int = 400
    """Steps between near and far; 0 takes steps of 2.5 voxels."""
    max_samples: int = 24
    """Maximum number of samples on a ray whose neighbours are looked up."""
    thickness: float = 0.0
    """Length in world units over which the density of a sample absorbs light; 0 takes a voxel."""
    background: float = 1.0
    """Stored value of the background: 0 black to 1 white."""


class PointScene(nn.Module):
    """Neural points that explain a capture, in the capture's own world.

    Args:
        cloud: The first points.
        sizes: Sizes of the networks; a `unit` of 0 becomes the radius of neighbours.
        march: Samples on rays.
        capture: As read.
        seed: Random seed of the run.
        weight: Weight of each frame in the first colours.
    """

    poses: Tensor
    times: Tensor

    def __init__(
        self,
        cloud: CloudOptions,
        sizes: PointSizes,
        march: MarchOptions,
        capture: Capture,
        seed: int,
        *,
        weight: Float[np.ndarray, "n"] | None = None,
    ) -> None:
        super().__init__()
        self.capture, self.seed = capture, seed
        start = starting_cloud(cloud, capture, seed, weight=weight)
        voxel = march.voxel or VOXEL_OF_SPACING * start.spacing
        points = NeuralPoints.start(
            torch.from_numpy(start.positions),
            torch.from_numpy(start.colours),
            torch.from_numpy(start.directions),
            channels=sizes.channels,
            cell=CELL * voxel,
            generator=generator(seed, 0, "descriptors"),
        )
        radius = RADIUS * voxel
        self.field = PointField(
            replace(sizes, unit=sizes.unit or radius), points, radius=radius, seed=seed
        )
        turned = sizes.axes == "camera"
        far = capture.far * (1 if turned else BEYOND)
        self.march = PointMarch(
            self.field,
            near=capture.near,
            far=far,
            steps=march.steps or max(round((far - capture.near) / (STEP * voxel)), 1),
            asked=march.max_samples,
            thickness=march.thickness or voxel,
            background=march.background,
        )
        every = np.arange(len(capture.needed_frames))
        self.register_buffer("poses", capture.frame_pose(every).detach().float(), persistent=False)
        self.register_buffer("times", capture.frame_time.mean(-1), persistent=False)

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return self.poses.device

    def meet(
        self,
        rays: Rays,
        colour: Colour,
        *,
        frame: Int64[Tensor, "b"] | None = None,
        step: int | None = None,
    ) -> PointRadiance:
        """Render rays.

        Args:
            rays: On one leading axis.
            colour: Colour of the samples that send light.
            frame: Frame of each ray; by default the frame nearest in time.
            step: Training step, whose samples are jittered; None for evaluation.
        """
        turn = None
        if self.field.sizes.axes == "camera":
            frame = self.frame_at(rays.time) if frame is None else frame
            turn = self.poses[frame, :, :3].mT
        made = None if step is None else generator(self.seed, step, "steps", self.device)
        return self.march(rays, colour, turn=turn, generator=made)

    def frame_at(self, time: Float[Tensor, "b"]) -> Int64[Tensor, "b"]:
        """The frame nearest in time, of all that the capture has."""
        ordered, order = self.times.sort()
        after = torch.searchsorted(ordered, time.contiguous()).clamp(1, max(len(ordered) - 1, 1))
        if len(ordered) == 1:
            return torch.zeros_like(after)
        before = after - 1
        later = (ordered[after] - time) < (time - ordered[before])
        return order[torch.where(later, after, before)]

    def groups(self, networks: Schedule, points: Schedule) -> list[Group]:
        """Parameters of the networks and of the points."""
        own = tuple(self.field.points.parameters())
        known = {id(parameter) for parameter in own}
        rest = tuple(p for p in self.field.parameters() if id(p) not in known)
        return [Group("networks", rest, networks), Group("points", own, points)]


DIFFERENT = 0.002
"""Difference from the background, below which a pixel may show the background."""

CHUNK = 4096
"""Rays rendered at once."""

CANDIDATES = 4
"""Frames rendered coarsely, for each frame that points are grown from."""

STRIDE = 4
"""Distance in pixels of the rays of the coarse search."""


@dataclass(frozen=True)
class GrowthOptions:
    """When points are grown and pruned. Defaults: Hybrid Neural Rendering's for ScanNet."""

    every: float = 0.05
    """Fraction of the schedule between two rounds; 0 for no rounds."""
    until: float = 0.6
    """Fraction of the schedule after which no points are grown or pruned."""
    frame_share: float = 0.01
    """Fraction of the training frames, those with most misses, that grow points in a round; at
    least one frame."""
    min_opacity: float = 0.7
    """Least opacity of a sample at which a point is added; above 1 none is added."""
    confidence: float = 0.4
    """Confidence of a new point, relative to its neighbours."""
    prune_below: float = 0.0
    """Points of a lower confidence are pruned; 0 prunes none, as published for rooms."""
    max_points: int = 0
    """Maximum number of points; 0 for no maximum."""

    @property
    def grows(self) -> bool:
        """Whether points may be added."""
        return self.min_opacity <= 1

    def due(self, step: int, steps: int) -> bool:
        """Whether there is a round after this step."""
        if self.every <= 0 or not (self.grows or self.prune_below > 0):
            return False
        every = max(round(self.every * steps), 1)
        return (step + 1) % every == 0 and step + 1 <= self.until * steps


@dataclass(frozen=True)
class Added:
    """Positions of new points, and the rows and weights of the neighbours of each."""

    position: Float[Tensor, "m 3"]
    rows: Tensor
    share: Tensor


@torch.no_grad()
def missing_points(
    options: GrowthOptions, scene: PointScene, pinhole: Pinhole, step: int
) -> Added | None:
    """New points at the edges of what rays miss; None if there are none."""
    train = scene.capture.split.train
    count = max(round(options.frame_share * len(train)), 1)
    random = numpy_generator(scene.seed, step, "growth")
    drawn = random.permutation(train)[: CANDIDATES * count]
    missed: list[float] = []  # squared error of the background where rays miss, on a coarse grid
    for frame in drawn:
        stored, hit, *_ = _rendered(scene, pinhole, int(frame), STRIDE)
        error = (stored - scene.march.background).square().mean(-1)
        missed.append(float((error * ~hit).sum()))
    worst = drawn[np.argsort(missed, kind="stable")[::-1][:count]]
    positions = [_edge(options, scene, pinhole, int(frame)) for frame in worst]
    position = torch.cat(positions)
    rows, way = scene.field.neighbours(position)
    found = rows[:, 0] >= 0
    if not found.any():
        return None
    rows, way = rows[found], way[found]
    return Added(position[found], rows, shares(way, rows >= 0))


def grown(
    options: GrowthOptions, points: NeuralPoints, added: Added | None, step: int, steps: int
) -> Growth | None:
    """The points without those that are pruned, then the new ones."""
    old = points.points()
    sure = torch.ones(len(points), dtype=torch.bool, device=points.positions.device)
    if options.prune_below > 0:
        sure = points.confidence.detach()[:, 0] >= options.prune_below
    stay = torch.nonzero(sure)[:, 0]
    room = max(options.max_points - len(stay), 0) if options.max_points else None
    if added is not None and room is not None:
        added = Added(added.position[:room], added.rows[:room], added.share[:room])
    if added is None or not len(added.position):
        if sure.all():
            return None
        return Growth(stay, torch.zeros_like(stay, dtype=torch.bool))
    counted = points.confidence.detach().clamp(LEAST_CONFIDENCE, 1)
    rows = added.rows.clamp_min(0)
    share = added.share * counted[rows, 0]
    share = share / share.sum(-1, keepdim=True).clamp_min(1e-8)
    values: dict[str, Tensor] = {}
    for name, held in old.items():
        held = held.detach()
        new = added.position if name == "positions" else (share[:, None] @ held[rows])[:, 0]
        if name == "confidence":
            new = options.confidence * new
        values[name] = torch.cat([held[stay], new])
    source = torch.cat([stay, rows[:, 0]])
    fresh = torch.arange(len(source), device=source.device) >= len(stay)
    return Growth(source, fresh, values)


def _edge(
    options: GrowthOptions, scene: PointScene, pinhole: Pinhole, frame: int
) -> Float[Tensor, "m 3"]:
    """Opaque samples on rays beside those that miss."""
    stored, hit, densest, where = _rendered(scene, pinhole, frame, 1)
    shown = (stored - scene.march.background).norm(dim=-1) > DIFFERENT
    missed = (~hit & shown).float()[None, None]
    beside = torch.nn.functional.max_pool2d(missed, 3, stride=1, padding=1)[0, 0] > 0
    chosen = beside & hit & (densest > options.min_opacity)
    return where[chosen]


def _rendered(
    scene: PointScene, pinhole: Pinhole, frame: int, stride: int
) -> tuple[
    Float[Tensor, "h w c"], Bool[Tensor, "h w"], Float[Tensor, "h w"], Float[Tensor, "h w 3"]
]:
    """A frame as stored, which of its rays hit, and the densest sample on each."""
    frames = scene.capture.needed_frames
    image: Float32[np.ndarray, "h w c"] = np.asarray(frames.images[frame])[::stride, ::stride]
    stored = torch.from_numpy(image.astype(np.float32) / np.float32(frames.white))
    stored = stored.to(scene.device)
    xy = pinhole.camera.grid(scene.device)[::stride, ::stride].reshape(-1, 2)
    pose = scene.poses[frame]
    hits, densest, where = [], [], []
    for part in xy.split(CHUNK):
        ones = part.new_ones(len(part))
        rays = cast(
            pinhole.camera, pose.expand(len(part), 3, 4), part, scene.times[frame] * ones, ones
        )
        of_frame = torch.full((len(part),), frame, device=part.device)
        met = scene.meet(
            rays, lambda asked: stored.new_zeros(len(asked), stored.shape[-1]), frame=of_frame
        )
        hits.append(met.hit)
        densest.append(met.densest)
        where.append(met.where)
    shape = stored.shape[:2]
    return (
        stored,
        torch.cat(hits).view(shape),
        torch.cat(densest).view(shape),
        torch.cat(where).view(*shape, 3),
    )
