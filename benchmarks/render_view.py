"""Seconds to render one view with the networks of the paper, against the plain formulation.

    python -m benchmarks.render_view [--width 300] [--runs 2] [--threads 2]
        [--capture FOLDER]

The scene is untrained, so that light comes from many samples of a ray: the hard case for us, since
we leave out the colour of samples that add next to nothing. Seconds as in `training_step`.
"""

import argparse
import time
from pathlib import Path

import torch

from benchmarks.table import Row, save, show
from benchmarks.training_step import ATELIER, OURS, PLAIN, built, captured
from sharpfield.rendering.view import render_view


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--width", type=int, default=300, help="of the view, in pixels")
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--capture", type=Path, default=ATELIER)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    clock = time.process_time if options.threads == 1 else time.perf_counter
    capture = captured(options.capture)
    camera = capture.camera.scaled(options.width / capture.camera.width)
    rows: list[Row] = []
    images = []
    for contender in (PLAIN, *OURS):
        model, _ = built(contender, capture, 1)
        path = model.frames.pinhole.trajectory
        pose = path.pose(torch.tensor(0.5), torch.tensor(0))
        seconds = []
        for _ in range(options.runs):
            start = clock()
            view = render_view(model.render, camera, pose, 0.5)
            seconds.append(clock() - start)
        images.append(view.rgb)
        rows.append(
            {
                "contender": contender.name,
                "s": min(seconds),
                "s ratio": rows[0]["s"] / min(seconds) if rows else 1.0,
                "largest difference": (view.rgb - images[0]).abs().max().item(),
            }
        )
    show(rows)
    facts = {key: str(value) for key, value in vars(options).items()}
    facts["capture"] = options.capture.name
    print(save("render_view", rows, facts))


if __name__ == "__main__":
    main()
