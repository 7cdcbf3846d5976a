"""Neural points become more where images show a surface that no point is near, and fewer.

A ray that *missed* came near no point, though its pixel differs from the background. Beside such
pixels there are rays that hit; where one of them is stopped by a single place, a point is added
there, with what the points around it know. So surfaces grow at their edges, round after round.

Source: Point-NeRF (CVPR 2022), section 4.3; numbers from the released code of Hybrid Neural
Rendering.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from sharpfield.core.points import Growth
from sharpfield.core.seed import numpy_generator
from sharpfield.fields.points.cloud import LEAST_CONFIDENCE, NeuralPoints
from sharpfield.fields.points.networks import shares
from sharpfield.formation.shutter import Pinhole
from sharpfield.geometry.rays import cast
from sharpfield.recipes.points.scene import PointScene

DIFFERENT = 0.002
"""A pixel that is closer to the background may as well show it."""

CHUNK = 4096
"""Rays looked at at once."""

CANDIDATES = 4
"""Frames that are searched for misses, for each that is then looked at closely."""

STRIDE = 4
"""Pixels between the rays of that search."""


@dataclass(frozen=True)
class GrowthOptions:
    """When points are added and dropped. Defaults: Hybrid Neural Rendering's for ScanNet."""

    every: float = 0.05
    """Part of the schedule between two rounds; 0 for none."""
    until: float = 0.6
    """Part of the schedule after which their number stays."""
    share: float = 0.01
    """Of the training frames, those with most misses are looked at in a round; at least one."""
    opaque: float = 0.7
    """Least opacity of a single place for a point to be added there; above 1 none is."""
    confidence: float = 0.4
    """Of a new point, relative to those around it."""
    drop: float = 0.0
    """Points less sure than this are dropped; 0 keeps all, as published for rooms."""
    most: int = 0
    """Points there may be; 0 for any number."""

    @property
    def grows(self) -> bool:
        """Whether points may be added."""
        return self.opaque <= 1

    def due(self, step: int, steps: int) -> bool:
        """Whether there is a round after this step."""
        if self.every <= 0 or not (self.grows or self.drop > 0):
            return False
        every = max(round(self.every * steps), 1)
        return (step + 1) % every == 0 and step + 1 <= self.until * steps


@dataclass(frozen=True)
class Added:
    """Places for new points, and the rows and shares of those around each."""

    place: Float[Tensor, "m 3"]
    rows: Tensor
    share: Tensor


@torch.no_grad()
def missing_points(
    options: GrowthOptions, scene: PointScene, pinhole: Pinhole, step: int
) -> Added | None:
    """Places at the edges of what rays miss; None if there are none."""
    train = scene.capture.split.train
    count = max(round(options.share * len(train)), 1)
    random = numpy_generator(scene.seed, step, "growth")
    drawn = random.permutation(train)[: CANDIDATES * count]
    missed = [_missed(scene, pinhole, int(frame)) for frame in drawn]
    worst = drawn[np.argsort(missed, kind="stable")[::-1][:count]]
    places = [_edge(options, scene, pinhole, int(frame)) for frame in worst]
    place = torch.cat(places)
    rows, way = scene.field.neighbours(place)
    there = rows[:, 0] >= 0
    if not there.any():
        return None
    rows, way = rows[there], way[there]
    return Added(place[there], rows, shares(way, rows >= 0))


def grown(
    options: GrowthOptions, points: NeuralPoints, added: Added | None, step: int, steps: int
) -> Growth | None:
    """The points with new ones after them, and without those that are unsure."""
    old = points.points()
    sure = torch.ones(len(points), dtype=torch.bool, device=points.positions.device)
    if options.drop > 0:
        sure = points.confidence.detach()[:, 0] >= options.drop
    stay = torch.nonzero(sure)[:, 0]
    room = max(options.most - len(stay), 0) if options.most else None
    if added is not None and room is not None:
        added = Added(added.place[:room], added.rows[:room], added.share[:room])
    if added is None or not len(added.place):
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
        new = added.place if name == "positions" else (share[:, None] @ held[rows])[:, 0]
        if name == "confidence":
            new = options.confidence * new
        values[name] = torch.cat([held[stay], new])
    source = torch.cat([stay, rows[:, 0]])
    fresh = torch.arange(len(source), device=source.device) >= len(stay)
    return Growth(source, fresh, values)


def _missed(scene: PointScene, pinhole: Pinhole, frame: int) -> float:
    """How wrong the background is where rays miss, summed over a coarse grid."""
    stored, hit = _looked(scene, pinhole, frame, STRIDE)[:2]
    error = (stored - scene.march.background).square().mean(-1)
    return float((error * ~hit).sum())


def _edge(
    options: GrowthOptions, scene: PointScene, pinhole: Pinhole, frame: int
) -> Float[Tensor, "m 3"]:
    """Opaque places on rays beside those that miss something."""
    stored, hit, densest, where = _looked(scene, pinhole, frame, 1)
    shown = (stored - scene.march.background).norm(dim=-1) > DIFFERENT
    missed = (~hit & shown).float()[None, None]
    beside = torch.nn.functional.max_pool2d(missed, 3, stride=1, padding=1)[0, 0] > 0
    chosen = beside & hit & (densest > options.opaque)
    return where[chosen]


def _looked(
    scene: PointScene, pinhole: Pinhole, frame: int, stride: int
) -> tuple[
    Float[Tensor, "h w c"], Bool[Tensor, "h w"], Float[Tensor, "h w"], Float[Tensor, "h w 3"]
]:
    """A frame as stored, which of its rays hit, and the densest place on each."""
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
