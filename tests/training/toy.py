"""The smallest model that training can train: colours of pixels from their positions.

Run as a program it trains in a folder, for tests that kill it:
`python toy.py RUN STEPS SECONDS_PER_STEP [--resume]`.
"""

import sys
import time
from pathlib import Path

import torch
from rich.console import Console
from torch import Tensor, nn

from sharpfield.core.measurements import Batch, Pixels
from sharpfield.core.protocols import Model
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group, exponential
from sharpfield.core.seed import generator
from sharpfield.training.options import TrainingOptions
from sharpfield.training.session import train


class Toy(nn.Module):
    capture = None
    heaviest_step = 10

    def __init__(self, steps: int, *, measurements: int = 48, seconds_per_step: float = 0.0):
        super().__init__()
        self.steps, self.measurements, self.seconds = steps, measurements, seconds_per_step
        start = generator(0, 0, "weights")
        self.net = nn.Sequential(nn.Linear(2, 16), nn.Tanh(), nn.Linear(16, 3))
        with torch.no_grad():
            for parameter in self.net.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=start) * 0.5)
        # Channels-last in memory, like a grid; it joins in late, like a blur kernel.
        grid = torch.zeros(1, 3, 4, 5).contiguous(memory_format=torch.channels_last)
        self.grid = nn.Parameter(grid)
        self.register_buffer("seen", torch.zeros((), dtype=torch.int64))

    def draw(self, step: int) -> Batch:
        chance = generator(0, step, "pixels")
        xy = torch.rand(self.measurements, 2, generator=chance)
        value = torch.stack([xy[:, 0], xy[:, 1], xy.prod(-1)], -1)
        zero, index = torch.zeros(len(xy)), torch.zeros(len(xy), dtype=torch.int64)
        return {"frames": Pixels(xy, index, index, zero, zero, value)}

    def losses(self, batch: Batch, step: int) -> dict[str, Tensor]:
        if self.seconds:
            time.sleep(self.seconds)
        seen = batch["frames"]
        self.seen += len(seen)
        terms = {"colour": (self.net(seen.xy) - seen.value).square().mean()}
        if step >= self.heaviest_step:
            looked_up = nn.functional.grid_sample(
                self.grid, seen.xy[None, None] * 2 - 1, align_corners=True
            )
            terms["grid"] = (looked_up[0, :, 0].T - seen.value).square().mean()
        return terms

    def render(self, rays: Rays) -> Radiance:
        raise AssertionError("training renders nothing")

    def encode(self, light: Tensor) -> Tensor:
        return light

    def groups(self) -> list[Group]:
        falling = exponential(1e-2, 1e-3, until=self.steps)
        return [
            Group("net", tuple(self.net.parameters()), falling),
            Group("grid", (self.grid,), lambda step: 10 * falling(step)),
        ]


def score(model: Model) -> float:
    """Minus the error on fixed measurements; higher is better."""
    assert isinstance(model, Toy)
    seen = model.draw(-1)["frames"]
    with torch.no_grad():
        return -(model.net(seen.xy) - seen.value).square().mean().item()


def quiet() -> Console:
    return Console(quiet=True)


if __name__ == "__main__":
    folder, steps, seconds = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    torch.set_num_threads(1)
    train(
        lambda length: Toy(length, seconds_per_step=seconds),
        folder,
        TrainingOptions(resume="--resume" in sys.argv, checkpoint_every=1, log_every=5),
        steps=steps,
        settings={"recipe": "toy", "seed": 0},
    )
