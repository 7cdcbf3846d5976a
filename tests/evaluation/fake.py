"""A model that knows its scene exactly, and captures of it: coloured light from every direction."""

import functools
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Split
from sharpfield.core.events import EventStream
from sharpfield.core.frames import Exposure, Frames
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group
from sharpfield.geometry.trajectory import Stamped
from sharpfield.rendering.view import render_view
from tests import streams

CAMERA = Camera(40, 32, 30.0, 30.0, 20.0, 16.0)
CLOCK = Clock(0, 1_000_000)


def sky(rays: Rays) -> Radiance:
    """Stripes and waves of light."""
    x, y, z = rays.direction.unbind(-1)
    waves = [(20 * x + 5 * z).sin(), (15 * y).cos(), (11 * (x + y)).sin()]
    rgb = 0.5 + 0.4 * torch.stack(waves, -1)
    ones = torch.ones_like(rays.time)
    return Radiance(rgb, 2 * ones + x, ones, rays.weight)


class Sky(nn.Module):
    """A trained model, as evaluation sees it."""

    heaviest_step = 0

    def __init__(self, capture: Capture, *, gain: float = 1.0, power: float = 1.0) -> None:
        super().__init__()
        self.capture = capture
        self.gain = nn.Parameter(torch.tensor(gain))
        self.power = power

    def draw(self, step: int) -> dict:
        return {}

    def losses(self, batch: dict, step: int) -> dict[str, Tensor]:
        return {}

    def render(self, rays: Rays) -> Radiance:
        seen = sky(rays)
        return replace(seen, rgb=self.gain * seen.rgb**self.power)

    def encode(self, light: Tensor) -> Tensor:
        return light.clamp(0, 1) ** (1 / 2.2)

    def groups(self) -> list[Group]:
        return []


@functools.cache
def capture(*, truth: bool = True, test: tuple[int, ...] = (0, 4), events: int = 500) -> Capture:
    """Six frames along a path, every one exposed but those held out; events at random."""
    times = np.linspace(0, 1_000_000, 21).astype(np.int64)
    poses = np.tile(np.eye(3, 4), (21, 1, 1))
    poses[:, 0, 3] = np.linspace(-0.5, 0.5, 21)
    poses[:, 1, 3] = 0.1 * np.sin(np.linspace(0, 6, 21))
    angle = np.linspace(-0.6, 0.6, 21)
    poses[:, 0, 0], poses[:, 0, 2] = np.cos(angle), np.sin(angle)
    poses[:, 2, 0], poses[:, 2, 2] = -np.sin(angle), np.cos(angle)
    trajectory = Stamped(times, poses, CLOCK)
    middle = np.arange(6) * 160_000 + 100_000
    half = np.where(np.isin(np.arange(6), test), 0, 80_000)
    exposure = Exposure(middle - half, middle + half)
    sharp = np.stack([_image(trajectory, int(t)) for t in middle])
    blurred = np.stack(
        [
            np.mean([_image(trajectory, int(t)) for t in np.linspace(m - h, m + h, 5)], 0)
            for m, h in zip(middle, half, strict=True)
        ]
    )
    stored = _eight_bit(sharp)
    frames = Frames(
        images=np.where((half == 0)[:, None, None, None], stored, _eight_bit(blurred)),
        exposure=exposure,
        track=np.zeros(6, np.int64),
        names=tuple(f"{i:02d}" for i in range(6)),
        truth=stored if truth else None,
        truth_known=half > 0 if truth else None,
    )
    train = np.setdiff1d(np.arange(6), test)
    return Capture(
        camera=CAMERA,
        trajectory=trajectory,
        clock=CLOCK,
        near=1.0,
        far=4.0,
        frames=frames,
        events=random_events(events) if events else None,
        split=Split(train, np.array(test, np.int64)),
        name="sky",
        source="fake",
    )


def random_events(count: int) -> EventStream:
    return streams.random_events(count, size=(40, 32), first_us=0, last_us=1_000_000, seed=5)


def _image(trajectory: Stamped, time_us: int) -> np.ndarray:
    time = time_us / CLOCK.span_us
    pose = trajectory.pose(torch.tensor(time), torch.tensor(0))
    return render_view(sky, CAMERA, pose, time).rgb.numpy()


def _eight_bit(light: np.ndarray) -> np.ndarray:
    return np.rint(light ** (1 / 2.2) * 255).astype(np.uint8)
