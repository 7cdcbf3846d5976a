"""Growing and pruning of neural points.

A ray *misses* if no point is near it although its pixel differs from the background. Where a ray
beside such a pixel has a single opaque sample, a point is added found, with the mean descriptor of
its neighbours. So surfaces grow at their edges, round after round.

Source: Point-NeRF (CVPR 2022), section 4.3; numbers from the released code of Hybrid Neural
Rendering.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from sharpfield.core.protocols import Growth
from sharpfield.core.seed import numpy_generator
from sharpfield.fields.points.cloud import LEAST_CONFIDENCE, NeuralPoints
from sharpfield.fields.points.networks import shares
from sharpfield.formation.shutter import Pinhole
from sharpfield.geometry.rays import cast
from sharpfield.recipes.points.scene import PointScene

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
    missed = [_missed(scene, pinhole, int(frame)) for frame in drawn]
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


def _missed(scene: PointScene, pinhole: Pinhole, frame: int) -> float:
    """Squared error of the background where rays miss, summed over a coarse grid."""
    stored, hit = _rendered(scene, pinhole, frame, STRIDE)[:2]
    error = (stored - scene.march.background).square().mean(-1)
    return float((error * ~hit).sum())


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
