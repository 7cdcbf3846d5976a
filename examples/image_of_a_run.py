"""One image of an evaluated run: a blurry frame, its events, the rebuilt scene, the truth.

python examples/image_of_a_run.py runs/demo --out docs/images/demo.png
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from sharpfield.core.events import EventStream
from sharpfield.runs.config import read_run_config
from sharpfield.storage.images import read_image, write_image

SCALE, GAP = 2, 6
RED, BLUE = (200, 40, 40), (40, 60, 200)


def event_image(events: EventStream) -> np.ndarray:
    """Red where it last got brighter, blue where darker, white where nothing happened."""
    image = np.full((events.height, events.width, 3), 255, np.uint8)
    x, y = np.rint(events.x).astype(int), np.rint(events.y).astype(int)
    image[y, x] = np.where((events.p > 0)[:, None], RED, BLUE)
    return image


def main() -> None:
    """Put the four panels side by side."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--frame", type=int, default=6)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()

    capture = read_run_config(options.run).read_capture(options.run)
    frames, events = capture.needed_frames, capture.needed_events
    opens, closes = frames.exposure.window(options.frame)
    rebuilt = options.run / "renders" / "train" / f"{frames.names[options.frame]}.png"
    panels = [
        frames.images[options.frame],
        event_image(events.window(opens, opens + (closes - opens) // 4)),
        read_image(rebuilt),
    ]
    if frames.truth is not None:
        panels.append(frames.truth[options.frame])
    size = (SCALE * frames.width, SCALE * frames.height)
    large = [cv2.resize(panel, size, interpolation=cv2.INTER_CUBIC) for panel in panels]
    gap = np.full((size[1], GAP, 3), 255, np.uint8)
    strip = [piece for panel in large for piece in (panel, gap)][:-1]
    write_image(options.out, np.concatenate(strip, 1))


if __name__ == "__main__":
    main()
