"""A painted wall whose light is known everywhere, and cameras that look at it."""

import numpy as np
import torch
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Clock
from sharpfield.core.measurements import EventPairs, Pixels
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.seed import generator
from sharpfield.geometry import se3
from sharpfield.geometry.trajectory import Stamped, Still

CAMERA = Camera(16, 12, 14.0, 14.0, 8.0, 6.0)
CLOCK = Clock(0, 1_000_000)
WALL = 3.0


def wall(rays: Rays) -> Radiance:
    """Waves of light on the plane z = 3."""
    reach = (WALL - rays.origin[..., 2]) / rays.direction[..., 2]
    x, y, _ = (rays.origin + reach[..., None] * rays.direction).unbind(-1)
    waves = torch.stack([(2 * x + y).sin(), (3 * y).cos(), (x - 2 * y).sin()], -1)
    return Radiance(0.5 + 0.4 * waves, reach, torch.ones_like(reach), rays.weight)


def lit(rgb: Tensor, weight: Tensor) -> Radiance:
    """Light as given, on rays of the given weights."""
    return Radiance(rgb, torch.ones_like(weight), torch.ones_like(weight), weight)


def swaying() -> Stamped:
    """One second of a camera that moves and turns before the wall."""
    t = np.linspace(0, 1, 21)
    twist = np.stack(
        [0.1 * np.sin(4 * t), 0.1 * t, 0.2 * t**2, 0.3 * t, 0.2 * np.cos(5 * t), 0.1 * t], -1
    )
    poses = se3.exp(torch.from_numpy(twist)).numpy()
    return Stamped((t * 1e6).astype(np.int64), poses, CLOCK)


def still(tracks: int = 4) -> Still:
    """Cameras that stand at the origin, each turned a little more."""
    twist = torch.zeros(tracks, 6, dtype=torch.float64)
    twist[:, 1] = 0.05 * torch.arange(tracks)
    return Still(se3.exp(twist).numpy())


def pixels(count: int = 7, *, frames: int = 3) -> Pixels:
    """Pixels of a few frames with exposures of a fifth of a second."""
    made = generator(0, 0, "toy pixels")
    frame = torch.randint(frames, (count,), generator=made)
    opened = 0.05 + 0.3 * frame
    return Pixels(
        xy=torch.rand(count, 2, generator=made) * torch.tensor([16.0, 12.0]),
        frame=frame,
        track=torch.zeros(count, dtype=torch.int64),
        open=opened,
        close=opened + 0.2,
        value=torch.rand(count, 3, generator=made),
    )


def pairs(count: int = 7, *, bayer: bool = False) -> EventPairs:
    """Pairs of instants with one event each, of either sign."""
    made = generator(0, 0, "toy pairs")
    sign = 2.0 * torch.randint(2, (count,), generator=made) - 1
    start = 0.7 * torch.rand(count, generator=made)
    return EventPairs(
        xy=torch.rand(count, 2, generator=made) * torch.tensor([16.0, 12.0]),
        track=torch.zeros(count, dtype=torch.int64),
        start=start,
        end=start + 0.3 * torch.rand(count, generator=made),
        negative=sign.clamp(max=0),
        positive=sign.clamp(min=0),
        channel=torch.randint(3, (count,), generator=made) if bayer else None,
    )


def chains(count: int = 5, *, length: int = 4, bayer: bool = False) -> EventPairs:
    """Runs `[count, length]` of pairs, each beginning where the one before it ended."""
    made = generator(0, 0, "toy chains")
    first = pairs(count, bayer=bayer)
    ends = (0.5 * torch.rand(count, length + 1, generator=made)).cumsum(1) / length
    sign = 2.0 * torch.randint(2, (count, length), generator=made) - 1

    def along(x: Tensor) -> Tensor:
        return x[:, None].expand(count, length, *x.shape[1:])

    return EventPairs(
        xy=along(first.xy),
        track=along(first.track),
        start=ends[:, :-1],
        end=ends[:, 1:],
        negative=sign.clamp(max=0),
        positive=sign.clamp(min=0),
        channel=None if first.channel is None else along(first.channel),
    )
