"""The static scene of the volume recipes: a normalised capture, a radiance field, a renderer."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group, Schedule
from sharpfield.core.seed import generator
from sharpfield.core.tone import Tone
from sharpfield.fields.mlp import MLPField
from sharpfield.fields.plane_grid import HeadSize, PlaneField
from sharpfield.fields.voxels import VoxelField, shapes_in
from sharpfield.geometry.normalise import normalised, reference_poses
from sharpfield.geometry.space import EvenDepth, Frustum, forward_facing
from sharpfield.losses.regularizers import smoothness
from sharpfield.ops.grid import total_variation
from sharpfield.rendering.coarse_to_fine import CoarseToFine, Compositing
from sharpfield.rendering.voxels import EvenSteps

MOST_CELLS = 4_000_000
"""Most voxels of a dense grid of automatic size; each takes 64 bytes with gradient and moments."""


@dataclass(frozen=True)
class VolumeOptions:
    """The radiance field, and its samples on rays. Defaults: Ev-DeblurNeRF (CVPR 2024)."""

    kind: Literal["planes", "mlp", "voxels"] = "planes"
    """`planes`: factored feature volumes with small networks; `mlp`: the networks of NeRF;
    `voxels`: a dense grid of density and colour without any network."""
    voxels: tuple[int, int] = (16_777_248, 134_217_984)
    """Number of voxels of the coarse and the fine volume: about 256^3 and 512^3. A dense grid has
    the second; 0 gives it about one voxel per pixel and sample."""
    channels: tuple[int, int, int] = (64, 16, 16)
    """Feature channels of the xy, xz and yz planes."""
    coarse: tuple[int, int, int] = (64, 15, 64)
    """Coarse head: hidden width, features, width of the colour layers."""
    fine: tuple[int, int, int] = (256, 128, 256)
    """Fine head: hidden width, features, width of the colour layers."""
    octaves: tuple[int, int] = (10, 4)
    """Frequencies of the positional encoding of positions and of directions."""
    samples: tuple[int, int] = (64, 64)
    """Coarse samples on a ray, and fine samples added to them. A dense grid takes the sum of both
    in even steps."""
    noise: float = 1.0
    """Standard deviation of the noise on raw density while training."""
    density: Literal["relu", "softplus"] = "relu"
    """Activation of the density."""
    space: Literal["auto", "ndc", "metric"] = "auto"
    """`ndc`: normalised device coordinates; `metric`: distance along the ray; `auto` takes `ndc`
    for forward-facing captures."""
    background: float = 0.0
    """Linear light behind a metric space, 0 black to 1 white."""
    clear_before: float = 0.0
    """In evaluation, density is zero up to this ray parameter (0...1), which hides floaters near
    the camera."""
    precision: Literal["float32", "bfloat16", "auto"] = "float32"
    """Precision of the heads; `auto` takes bfloat16 where the device has it."""


GRID_RATE = 0.2
"""First learning rate of a dense grid, whose voxels are density and colour themselves."""
DRAFT: dict[str, Any] = {"kind": "voxels", "voxels": (0, 0), "samples": (96, 0), "noise": 0.0}
"""Changes to `VolumeOptions` for minutes on a CPU."""
STANDARD: dict[str, Any] = {
    "voxels": (160**3, 320**3),
    "channels": (32, 16, 16),
    "coarse": (64, 15, 64),
    "fine": (128, 64, 128),
    "octaves": (6, 4),
    "samples": (48, 48),
    "precision": "auto",
}
"""Changes to `VolumeOptions` for minutes on a GPU."""


def soft(raw: torch.Tensor) -> torch.Tensor:
    """Shifted softplus: density starts low, so that rays pass through an untrained scene."""
    return nn.functional.softplus(raw - 1)


class FrameModel(nn.Module):
    """What models of frames share: the tone curve of the capture."""

    tone: Tone

    def encode(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
        """Linear light as stored values, 0...1."""
        return self.tone.encode(light).clamp(0, 1)


ACTIVATIONS = {"relu": torch.relu, "softplus": soft}


class Volume(nn.Module):
    """A static radiance field and its capture, in the same normalised space.

    Args:
        options: Sizes and sampling.
        capture: As read.
        seed: Random seed of the run.
    """

    def __init__(self, options: VolumeOptions, capture: Capture, seed: int) -> None:
        super().__init__()
        self.options, self.seed = options, seed
        self.capture, self.change = normalised(capture)
        self.path = self.capture.trajectory
        poses = reference_poses(self.capture)
        camera, frames = self.capture.camera, self.capture.frames
        in_frustum = options.space == "ndc"
        in_frustum |= options.space == "auto" and forward_facing(poses)
        self.space = (
            Frustum(camera)
            if in_frustum
            else EvenDepth(camera, self.capture.near, self.capture.far)
        )
        seen_from = torch.as_tensor(poses).float()  # the box must hold all that is seen from there
        if frames is not None:
            seen_from = self.capture.frame_pose(np.arange(len(frames)))
        box = self.space.box(seen_from)
        self.field = _field(options, box, self.capture.camera, seed)
        if isinstance(self.field, VoxelField):
            self.train_view = EvenSteps(self.field, self.space, sum(options.samples))
            self.view = replace(self.train_view, clear_before=options.clear_before)
            return
        how = Compositing(
            activation=ACTIVATIONS[options.density],
            opaque_end=isinstance(self.space, Frustum),
            background=options.background,
        )
        clear = replace(how, clear_before=options.clear_before)
        self.train_view = CoarseToFine(self.field, self.space, options.samples, options.noise, how)
        self.view = CoarseToFine(self.field, self.space, options.samples, 0.0, clear)

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return next(self.parameters()).device

    @property
    def feature_width(self) -> int:
        """Width of the features of samples; 0 if there are none."""
        widths = {"planes": self.options.fine[1], "mlp": 256, "voxels": 0}
        return widths[self.options.kind]

    def sharp(self, rays: Rays, step: int, stream: str, *, samples: bool = False) -> Radiance:
        """Training radiance along rays: jittered samples and noise, by seed, step and stream."""
        made = generator(self.seed, step, stream, self.device)
        return self.train_view(rays, made, samples=samples)

    def smoothness(self) -> Tensor:
        """Total variation of the grids; zero without any."""
        if isinstance(self.field, VoxelField):
            # Plenoxels (CVPR 2022) takes the root of the squares instead, at sampled cells.
            return total_variation(self.field.static[0])
        if isinstance(self.field, PlaneField):
            return smoothness(self.field.planes(), self.field.lines())
        return torch.zeros((), device=self.device)

    def groups(self, rate: Schedule, grids_rate: Schedule) -> list[Group]:
        """Parameters of networks and grids with their learning rates."""
        grids: tuple[nn.Parameter, ...] = ()
        if isinstance(self.field, VoxelField):
            grids = tuple(self.field.static)
        elif isinstance(self.field, PlaneField):
            grids = (*self.field.planes(), *self.field.lines())
        known = {id(grid) for grid in grids}
        networks = [p for p in self.field.parameters() if id(p) not in known]
        groups = [Group("networks", tuple(networks), rate), Group("grids", grids, grids_rate)]
        return [group for group in groups if group.parameters]


def stages(light: Radiance) -> list[Radiance]:
    """The radiance of the fine stage, then that of the coarse one if there are two."""
    return [light] if light.coarse is None else [light, light.coarse]


def _field(
    options: VolumeOptions, box: Float[Tensor, "2 3"], camera: Camera, seed: int
) -> PlaneField | MLPField | VoxelField:
    if options.kind == "voxels":
        pixels = camera.width * camera.height
        voxels = options.voxels[1] or min(pixels * sum(options.samples), MOST_CELLS)
        return VoxelField(shapes_in(box, voxels), box=box)
    made = generator(seed, 0, "field")
    if options.kind == "mlp":
        return MLPField(generator=made)
    return PlaneField(
        box,
        options.voxels,
        generator=made,
        heads=(HeadSize(*options.coarse), HeadSize(*options.fine)),
        channels=options.channels,
        octaves=options.octaves,
        precision=_precision(options.precision),
    )


def _precision(name: str) -> torch.dtype:
    if name == "auto":
        fast = torch.cuda.is_available() or torch.cpu._is_avx512_bf16_supported()  # pyright: ignore
        name = "bfloat16" if fast else "float32"
    return getattr(torch, name)
