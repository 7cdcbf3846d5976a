"""Deblur real DAVIS240C frames with binned events, finding the contrast threshold from the data.

The folder is laid out as in the sequences published with LEDVDI (Lin et al., ECCV 2020), which come
from the EDI paper: `blurred/*.png` and `EventBin3.mat`, whose `event_bins` holds for every frame 18
equal time bins of signed event counts, from half the gap before its exposure to half the gap after.
How much of that the shutter was open is not recorded: it is found together with the threshold, as
what makes neighbouring frames agree best.

    python examples/edi_davis240c.py FOLDER --out runs/davis240c

needs scipy for the MATLAB file.
"""

import argparse
import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import scipy.io
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from sharpfield.events.double_integral import latent, path_of_slices
from sharpfield.events.log_path import LogPath
from sharpfield.events.threshold import FixedThresholds
from sharpfield.events.threshold_search import best_threshold, disagreement
from sharpfield.storage.images import list_images, read_images, write_image

JUDGED = 12
"""Pairs of neighbouring frames that choose the threshold."""

DARK, BRIGHT = 0.03, 0.97
"""Values between which a pixel can be trusted; frames were stretched to 0 ... 1 one by one."""

GAMMA = 0.6
"""For showing: the frames are linear, and dark."""


@dataclass(frozen=True)
class Sequence:
    """Blurred frames with signed event counts around each."""

    frames: Float[Tensor, "n h w 1"]
    bins: Float[Tensor, "n j h w 1"]

    def path(self, frame: int, *, threshold: float, opened: int) -> LogPath:
        """Over the middle `opened` bins; the only instant is the middle of the exposure."""
        begin = (self.bins.shape[1] - opened) // 2
        path = path_of_slices(threshold * self.bins[frame, begin : begin + opened])
        return LogPath(path.log_mean, path.change[opened // 2][None])

    def gap(self, frame: int, *, threshold: float) -> Float[Tensor, "1 h w 1"]:
        """Change of log light from the middle of a frame to the middle of the next."""
        half = self.bins.shape[1] // 2
        return (
            threshold * (self.bins[frame, half:].sum(0) + self.bins[frame + 1, :half].sum(0))[None]
        )


def read(folder: Path) -> Sequence:
    """The frames and their bins."""
    images = read_images(list_images(folder / "blurred"))
    frames = torch.from_numpy(images[..., :1].astype(np.float32)) / 255
    counts = scipy.io.loadmat(folder / "EventBin3.mat")["event_bins"].astype(np.float32)
    return Sequence(frames, torch.from_numpy(counts).reshape(len(frames), -1, *frames.shape[1:]))


def cost(seen: Sequence, opened: int, tried: FixedThresholds) -> float:
    """How far neighbouring frames disagree, over a few pairs spread through the sequence."""
    threshold = tried.positive
    total = 0.0
    for first in np.linspace(0, len(seen.frames) - 2, JUDGED).round().astype(int):
        light = seen.frames[first : first + 2]
        paths = [seen.path(k, threshold=threshold, opened=opened) for k in (first, first + 1)]
        usable = (light > DARK) & (light < BRIGHT)
        total += disagreement(light, paths, seen.gap(first, threshold=threshold), usable)
    return total / JUDGED


def main() -> None:
    """Read, find the threshold, deblur all frames, write images and numbers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/davis240c"))
    parser.add_argument("--show", type=int, nargs="+", default=[10, 30, 44])
    options = parser.parse_args()

    seen = read(options.folder)
    best = {}
    for opened in range(8, seen.bins.shape[1] + 1, 2):
        found = best_threshold(partial(cost, seen, opened))
        best[opened] = (cost(seen, opened, found), found.positive)
        print(f"open for {opened} bins: threshold {found.positive:.3f}, cost {best[opened][0]:.4f}")
    opened = min(best, key=best.get)
    lowest, threshold = best[opened]

    sharp = torch.stack(
        [
            latent(seen.frames[k], seen.path(k, threshold=threshold, opened=opened), 0)
            for k in range(len(seen.frames))
        ]
    )
    for k, image in enumerate(sharp):
        write_image(options.out / f"{k:03d}.png", shown(image))
    rows = [torch.cat(list(images[options.show]), 1) for images in (seen.frames, sharp)]
    write_image(options.out / "before_after.png", shown(torch.cat(rows)))
    about = {"threshold": threshold, "open_bins": opened, "disagreement": lowest}
    (options.out / "edi.json").write_text(json.dumps(about, indent=2) + "\n")
    print(json.dumps(about))


def shown(image: Float[Tensor, "h w 1"]) -> UInt8[np.ndarray, "h w 1"]:
    """As 8 bit, brightened."""
    return np.rint(image.clamp(0, 1).numpy() ** GAMMA * 255).astype(np.uint8)


if __name__ == "__main__":
    main()
