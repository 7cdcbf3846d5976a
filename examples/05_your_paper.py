"""A recipe of your own: NeRF, but each pixel is the mean of light along the known motion.

    python examples/05_your_paper.py

trains it for some seconds. Two lines in your own `pyproject.toml` make it a recipe of `sf.train`
and of the command line, with checkpoints, evaluation, report and videos:

    [project.entry-points."sharpfield.recipes"]
    mean-blur = "my_package.mean_blur:MeanBlur"
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import tyro
from torch import Tensor, nn

import sharpfield as sf
from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Batch
from sharpfield.core.protocols import Paper
from sharpfield.formation.shutter import Shutter
from sharpfield.losses.photometric import mse
from sharpfield.recipes.nerf import NeRF, draft
from sharpfield.training.loop import fit
from sharpfield.training.optim import adam
from sharpfield.training.session import every


@dataclass(frozen=True)
class MeanBlur:
    """The options of the paper; they are flags of the command line, too."""

    paper: ClassVar[Paper] = Paper(key="you2027", title="Your paper", bibtex="")
    steps: int = 100
    instants: int = 7
    """Sharp rays behind each pixel."""
    nerf: NeRF = replace(draft(NeRF()), pixels=256)

    def lasting(self, steps: int) -> "MeanBlur":
        """The same recipe with another length."""
        return replace(self, steps=steps, nerf=self.nerf.lasting(steps))

    def build(self, capture: Capture, seed: int) -> "Model":
        """The recipe on one capture."""
        return Model(self, capture, seed)


class Model(nn.Module):
    """NeRF with a shutter: what stays as it was is taken from there."""

    def __init__(self, recipe: MeanBlur, capture: Capture, seed: int) -> None:
        super().__init__()
        self.nerf = nerf = recipe.nerf.build(capture, seed)
        self.draw, self.groups, self.heaviest_step = nerf.draw, nerf.groups, 0
        self.render, self.encode, self.capture = nerf.render, nerf.encode, nerf.capture
        path, tone = nerf.capture.trajectory, nerf.tone.encode
        self.shutter = Shutter(capture.camera, path, recipe.instants, tone)

    def losses(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """The whole method: expose, render, observe, compare."""
        seen = batch["frames"]
        sharp = self.nerf.volume.sharp(self.shutter.expose(seen), step, "frames")
        return {"blur": mse(self.shutter.observe(sharp, seen), seen.value)}


def main(size: tuple[int, int] = (60, 40), steps: int = 100) -> None:
    """Train it, and watch the loss."""
    capture = sf.simulate("garden", size=size, frames=6)
    model = MeanBlur().lasting(steps).build(capture, seed=0)

    def report(step: int, _model: object, _optimizer: object, losses: dict[str, Tensor]) -> None:
        print(f"step {step:4}  blur {losses['blur']:.4f}")

    fit(model, adam(model), steps=range(steps), hooks=[every(25, report)])


if __name__ == "__main__":
    tyro.cli(main)
