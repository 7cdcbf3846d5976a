"""Ev-DeblurNeRF as published, in straightforward torch: what our speed is measured against.

The same losses from the same parameters, computed the way the released formulation goes: three
render calls, channel-first planes, everything kept for the backward pass. Only what costs nothing
is shared with ours: what a step looks at, poses, the sensors' curves, and the smallest networks.

What it does that we avoid is marked by "Plain:". It leaves out what only slows a GPU down: scans
for values that are not finite, and deterministic scatters.

Sources: Ev-DeblurNeRF (CVPR 2024) and its released recipes; DP-NeRF (CVPR 2023) for the kernel,
PDRF (AAAI 2023) and TensoRF (ECCV 2022) for the field.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int64
from torch import Generator, Tensor, nn

from benchmarks.plain_field import PlainField, encoded
from sharpfield.core.measurements import Batch, EventPairs, Pixels
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.seed import generator
from sharpfield.core.struct import Struct
from sharpfield.fields.plane_grid import PlaneField
from sharpfield.formation.adaptive import AdaptiveWeights
from sharpfield.formation.events import LogContrast
from sharpfield.formation.ray_kernels import RigidMotions
from sharpfield.geometry.rays import cast
from sharpfield.geometry.space import Space
from sharpfield.losses.photometric import mse
from sharpfield.recipes.ev_deblur_nerf import Model
from sharpfield.recipes.volume.terms import EventTerm, KernelTerm

Returned = dict[str, Tensor]
"""What a render call returns, by name; `[rays, ...]`, but for the scalar `roughness`."""


@dataclass(frozen=True)
class Draws(Struct):
    """The random numbers of some rays: the same ones that our renderer draws."""

    trailing: ClassVar = dict.fromkeys(("jitter", "coarse", "position", "fine"), 1)

    jitter: Float[Tensor, "*b s"]
    coarse: Float[Tensor, "*b s"]
    position: Float[Tensor, "*b m"]
    fine: Float[Tensor, "*b t"]

    @classmethod
    def of(cls, made: Generator, rays: int, samples: tuple[int, int], noise: float) -> "Draws":
        """Numbers for so many rays, in the order in which our renderer draws them."""
        first, more = samples

        def uniform(count: int) -> Tensor:
            return torch.rand(rays, count, generator=made, device=made.device)

        def normal(count: int) -> Tensor:
            return noise * torch.randn(rays, count, generator=made, device=made.device)

        return cls(uniform(first), normal(first), uniform(more), normal(first + more))

    @classmethod
    def none(cls, rays: int, samples: tuple[int, int], device: torch.device) -> "Draws":
        """Numbers that leave every sample where it is: evaluation."""
        first, more = samples
        jitter = torch.full((first,), 0.5, device=device)
        jitter[0], jitter[-1] = 0, 1  # the outermost bins reach to one side only
        zero = torch.zeros(1, device=device)
        evenly = torch.linspace(0, 1, more, device=device)
        return cls(
            jitter.expand(rays, first),
            zero.expand(rays, first),
            evenly.expand(rays, more),
            zero.expand(rays, first + more),
        )


class Plain(nn.Module):
    """The published formulation with the parameters of one of our models.

    The model must be of the published kind: planes in a frustum, a learned kernel with adaptive
    weights, frames and events. Networks of kernel, adaptive weights and event response are the
    model's own; planes, lines and heads are copies in another layout.
    """

    def __init__(self, model: Model) -> None:
        super().__init__()
        assert isinstance(model.frames, KernelTerm) and isinstance(model.events, EventTerm)
        assert isinstance(model.volume.field, PlaneField)
        assert model.frames.blur is not None and model.frames.blur.adaptive is not None
        self.field = PlainField(model.volume.field)
        self.frames, self.events = model.frames, model.events
        self.motions, self.adaptive = model.frames.blur.motions, model.frames.blur.adaptive
        self.space: Space = model.volume.space
        self.recipe, self.seed = model.recipe, model.seed

    def draw(self, step: int) -> Batch:
        """The batch that our model looks at."""
        device = self.motions.codes.vectors.device
        return {"frames": self.frames.draw(step, device), "events": self.events.draw(step, device)}

    def losses(self, batch: Batch, step: int) -> dict[str, Float[Tensor, ""]]:
        """The terms of our model, by the same names; only with the kernel switched on."""
        assert self.frames.blurred(step)
        assert isinstance(seen := batch["frames"], Pixels)
        assert isinstance(pairs := batch["events"], EventPairs)
        blurred, roughness = self._frame_terms(seen, step)
        return {
            **blurred,
            "events": self._event_term(pairs, step),
            "smooth": self.recipe.tv_weight * roughness,
        }

    def render(self, rays: Rays) -> Radiance:
        """Sharp light without randomness."""
        draws = Draws.none(len(rays), self.recipe.volume.samples, rays.device)
        found = rendered(self.field, self.space, rays, draws)
        return Radiance(found["rgb"], found["depth"], found["opacity"], rays.weight)

    def _draws(self, step: int, stream: str, *shape: int) -> Draws:
        options = self.recipe.volume
        made = generator(self.seed, step, stream, self.motions.codes.vectors.device)
        rays = torch.Size(shape).numel()
        return Draws.of(made, rays, options.samples, options.noise).reshape(*shape)

    def _frame_terms(self, seen: Pixels, step: int) -> tuple[dict[str, Tensor], Tensor]:
        frames = self.frames
        rays, code = moved_rays(self.motions, frames, seen)
        shape = rays.shape
        draws = self._draws(step, "frames", *shape).reshape(-1)
        found = rendered(self.field, self.space, rays.reshape(-1), draws)
        roughness = self.field.roughness()
        found = {name: value.reshape(*shape, *value.shape[1:]) for name, value in found.items()}

        rigid = weighted(found, rays.weight)
        adaptive = weighted(found, adaptive_weights(self.adaptive, found, code))
        tone, trusted = frames.tone, frames.share(step + 1)
        terms = {"adaptive": trusted * mse(tone(adaptive["rgb"]), seen.value)}
        if step + 1 >= frames.frames_from:
            error = mse(tone(rigid["rgb"]), seen.value) + mse(tone(rigid["rgb_coarse"]), seen.value)
            terms["blur"] = (1 - trusted) * error
        if frames.prior is not None:
            target = frames.prior.target(seen)
            origin = mse(tone(found["rgb"][:, 0]), target)
            origin = origin + mse(tone(found["rgb_coarse"][:, 0]), target)
            terms["prior"] = frames.prior_weight(step) * origin
        return terms, roughness

    def _event_term(self, seen: EventPairs, step: int) -> Tensor:
        sensor: LogContrast = self.events.sensor(step)
        rays = sensor.expose(seen)
        draws = self._draws(step, "events", *rays.shape)
        ends = []
        for end in (0, 1):
            ends.append(rendered(self.field, self.space, rays[:, end], draws[:, end]))
            self.field.roughness()  # Plain: computed in every forward pass, and not used here.
        errors = []
        for name in ("rgb", "rgb_coarse"):
            rgb = torch.stack([found[name] for found in ends], 1)
            light = Radiance(rgb, rays.weight, rays.weight, rays.weight)
            errors.append(self.events.error(sensor.observe(light, seen), seen, step))
        return self.recipe.events.weight * (errors[0] + errors[1])


def rendered(field: PlainField, space: Space, rays: Rays, draws: Draws) -> Returned:
    """One render call: coarse, then coarse and fine samples together."""
    origin, direction = space.warp(rays)
    length = direction.norm(dim=-1, keepdim=True)

    def at(z: Tensor) -> Tensor:
        return origin[:, None] + z[..., None] * direction[:, None]

    z = coarse_depths(draws.jitter, space)
    looked = field.coarse_volume(at(z))
    raw, rgb, _ = field.coarse(looked, at(z), rays.direction)
    weights = composited(raw + draws.coarse, z, length)
    coarse = gathered(weights, rgb, z)

    more = importance_depths(z, weights.detach(), draws.position)
    both, order = torch.cat([z, more], -1).sort(dim=-1, stable=True)
    points = torch.cat([at(z), at(more)], 1)
    looked = torch.cat([looked, field.coarse_volume(at(more))], 1)
    # Plain: what the networks read is sorted, not what they return.
    points, looked = in_order(points, order), in_order(looked, order)
    looked = torch.cat([looked, field.fine_volume(points)], -1)
    raw, rgb, feature = field.fine(looked, points, rays.direction)
    weights = composited(raw + draws.fine, both, length)
    returned = {**gathered(weights, rgb, both), "feature": feature, "z": both}
    returned["direction"] = direction
    return returned | {f"{name}_coarse": value for name, value in coarse.items()}


def coarse_depths(jitter: Float[Tensor, "b s"], space: Space) -> Float[Tensor, "b s"]:
    """Even depths, each moved within its bin."""
    count = jitter.shape[1]
    z = torch.linspace(space.near, space.far, count, device=jitter.device).expand_as(jitter)
    middle = (z[:, 1:] + z[:, :-1]) / 2
    lower, upper = torch.cat([z[:, :1], middle], -1), torch.cat([middle, z[:, -1:]], -1)
    return lower + (upper - lower) * jitter


def importance_depths(
    z: Float[Tensor, "b s"], weights: Float[Tensor, "b s"], position: Float[Tensor, "b m"]
) -> Float[Tensor, "b m"]:
    """Where the cumulative weight reaches each position; bins lie between middles."""
    bins = (z[:, 1:] + z[:, :-1]) / 2
    density = weights[:, 1:-1] + 1e-5
    density = density / density.sum(-1, keepdim=True)
    total = torch.cat([torch.zeros_like(density[:, :1]), density.cumsum(-1)], -1)
    above = torch.searchsorted(total, position.contiguous(), right=True)
    below, above = (above - 1).clamp(min=0), above.clamp(max=total.shape[1] - 1)
    low, high = total.gather(1, below), total.gather(1, above)
    gap = torch.where(high - low < 1e-5, torch.ones_like(low), high - low)
    start, end = bins.gather(1, below), bins.gather(1, above)
    return (start + (position - low) / gap * (end - start)).detach()


def composited(
    raw: Float[Tensor, "b s"], z: Float[Tensor, "b s"], length: Float[Tensor, "b 1"]
) -> Float[Tensor, "b s"]:
    """Share of the light from each sample; the last one is opaque."""
    delta = (z[:, 1:] - z[:, :-1]) * length
    alpha = 1 - torch.exp(-torch.relu(raw[:, :-1]) * delta)
    alpha = torch.cat([alpha, torch.ones_like(raw[:, :1])], -1)
    passed = torch.cumprod(torch.cat([torch.ones_like(raw[:, :1]), 1 - alpha + 1e-10], -1), -1)
    return alpha * passed[:, :-1]


def gathered(weights: Tensor, rgb: Tensor, z: Tensor) -> Returned:
    """Colour, depth and opacity of rays."""
    colour = (weights[..., None] * rgb).sum(1)
    return {"rgb": colour, "depth": (weights * z).sum(1), "opacity": weights.sum(1)}


def moved_rays(
    motions: RigidMotions, frames: KernelTerm, seen: Pixels
) -> tuple[Rays, Float[Tensor, "b l"]]:
    """The origin's and the moved rays of each pixel, and the code of its image.

    Plain: the network runs for every pixel though it depends on the image alone.
    """
    code = motions.codes.vectors[seen.frame]
    axes = (len(seen), 3, motions.motions)
    turn = motions.window * motions.rotation(code).reshape(axes).transpose(1, 2)
    shift = motions.window * motions.translation(code).reshape(axes).transpose(1, 2)
    weight = torch.sigmoid(motions.weight(code))
    weight = weight / (weight.sum(-1, keepdim=True) + 1e-10)

    pinhole, time = frames.pinhole, seen.middle
    pose = pinhole.trajectory.pose(time, seen.track)
    ray = cast(pinhole.camera, pose, seen.xy, time, torch.ones_like(time))
    rotation, translation = exponential(turn, shift)
    origin = (rotation @ ray.origin[:, None, :, None])[..., 0] + translation
    direction = (rotation @ ray.direction[:, None, :, None])[..., 0]
    rays = Rays(
        torch.cat([ray.origin[:, None], origin], 1),
        torch.cat([ray.direction[:, None], direction], 1),
        time[:, None].expand_as(weight),
        weight,
    )
    return rays, code


def exponential(turn: Float[Tensor, "b m 3"], shift: Float[Tensor, "b m 3"]) -> tuple[Tensor, ...]:
    """Rotation and translation of a twist, by the formula of Rodrigues."""
    angle = turn.norm(dim=-1, keepdim=True) + 1e-10
    x, y, z = (turn / angle).unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    square, angle = cross @ cross, angle[..., None]
    sine, cosine = angle.sin(), 1 - angle.cos()
    eye = torch.eye(3, device=turn.device)
    rotation = eye + sine * cross + cosine * square
    through = angle * eye + cosine * cross + (angle - sine) * square
    return rotation, (through @ (shift[..., None] / angle))[..., 0]


def adaptive_weights(
    network: AdaptiveWeights, found: Returned, code: Float[Tensor, "b l"]
) -> Float[Tensor, "b k"]:
    """Weights of each pixel's rays from the features along them, everything at once."""
    embedded = torch.relu(network.embed(found["feature"]))  # [b, k, s, 64]
    length = found["direction"].norm(dim=-1, keepdim=True)
    gap = (found["z"][..., 1:] - found["z"][..., :-1]) * length
    alpha = 1 - torch.exp(-embedded[:, :, :-1] * gap[..., None])
    alpha = torch.cat([alpha, torch.zeros_like(alpha[:, :, :1])], 2)
    first = torch.ones_like(alpha[:, :, :1])
    passed = torch.cumprod(torch.cat([first, 1 - alpha[:, :, :-1] + 1e-10], 2), -1)
    ray = (alpha * passed * embedded).sum(2)  # [b, k, 64]

    unit = F.normalize(found["direction"][:, 0], dim=-1)
    shared = torch.cat([code, encoded(unit, 2)], -1)[:, None].expand(-1, ray.shape[1], -1)
    whole = torch.relu(network.globalise(torch.cat([ray, shared], -1)))
    local = network.localise(embedded)
    attention = network.attend(local)
    inter = (attention.softmax(2) * local).sum(2)
    intra = (attention.softmax(1) * local).sum(1)
    weight = torch.sigmoid(network.head(network.aggregate(whole, inter, intra).mean(1)))
    return weight / weight.sum(-1, keepdim=True)


def weighted(found: Returned, weight: Float[Tensor, "b k"]) -> Returned:
    """The mean of a pixel's rays.

    Plain: of everything that was returned, features of all samples included.
    """

    def mean(value: Tensor) -> Tensor:
        return (weight.reshape(*weight.shape, *[1] * (value.ndim - 2)) * value).sum(1)

    return {name: mean(value) for name, value in found.items()}


def in_order(value: Float[Tensor, "b t f"], order: Int64[Tensor, "b t"]) -> Float[Tensor, "b t f"]:
    """Samples in the given order."""
    return value.gather(1, order[..., None].expand_as(value))
