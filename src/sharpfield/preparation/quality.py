"""Sharpness of the frames of a video: scores, weights, and a figure of the ranking.

`blur_images` makes test data: it blurs a folder of sharp images by random motion kernels.
"""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.files import replacing, replacing_folder, write_json
from sharpfield.core.seed import numpy_generator
from sharpfield.metrics.quality import Quality, event_quality, frame_quality
from sharpfield.preparation.options import QualityOptions
from sharpfield.report.colormaps import stored_as_bytes
from sharpfield.simulation.sensors.motion_blur import PUBLISHED, KernelRange, blurred, drawn_blur
from sharpfield.storage.images import list_images, read_image, write_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure
else:  # matplotlib is imported when a figure is drawn
    Figure = Any

SHOWN = 5
"""Frames at each end of the ranking that the figure shows."""


def measure_quality(capture: Capture, options: QualityOptions) -> tuple[Quality, str]:
    """Scores and weights, and what they are measured by: "events", "depth" or "flow".

    Raises:
        OptionError: There are fewer than two frames to compare.
        CaptureError: See `metrics.quality`.
    """
    every = np.arange(len(capture.needed_frames))
    frames = every if options.every_frame else capture.split.train
    if len(frames) < 2:
        raise OptionError(
            "sharpness is relative to other frames, and there are fewer than two",
            where=capture.name,
            do="include held-out frames: --every-frame",
        )
    single = capture.events is not None and capture.events.track is None
    if options.source == "events" or (options.source == "auto" and single):
        return event_quality(capture, frames=frames), "events"
    by_depth = capture.depth is not None and options.overlap != "flow"
    found = frame_quality(capture, frames=frames, overlap=options.overlap, way=options.way)
    return found, "depth" if by_depth else "flow"


def as_table(capture: Capture, found: Quality, measured_by: str) -> dict[str, Any]:
    """Plain values for JSON; with the rank correlation where the true blur is known."""
    names = capture.needed_frames.names
    true = _true_blur(capture, found)
    rows: list[dict[str, Any]] = []
    for k, frame in enumerate(found.frames.tolist()):
        row = {
            "name": names[frame],
            "score": float(found.scores[k]),
            "weight": float(found.weights[k]),
        }
        rows.append(row if true is None else row | {"true_blur_px": float(true[k])})
    about: dict[str, Any] = {"capture": capture.name, "told_by": measured_by, "frames": rows}
    if true is not None:
        about["rank_correlation"] = rank_correlation(found.scores, -true)
    return about


def quality_to(capture: Capture, found: Quality, measured_by: str, out: Path) -> None:
    """Write `quality.json`, `ranking.png` and `weights.npy` (the weight of each frame)."""
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "quality.json", as_table(capture, found, measured_by))
    with replacing(out / "weights.npy") as temporary:
        np.save(temporary, found.weights)
    with replacing(out / "ranking.png") as temporary:
        ranking(capture, found, measured_by).savefig(temporary, dpi=110)


def rank_correlation(a: Float64[np.ndarray, "m"], b: Float64[np.ndarray, "m"]) -> float:
    """Spearman's rank correlation; equal values get their mean rank."""
    one, other = _ranks(a), _ranks(b)
    if one.std() == 0 or other.std() == 0:
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])


def ranking(capture: Capture, found: Quality, measured_by: str) -> Figure:
    """Figure of scores and weights along the video, with the blurriest and sharpest frames."""
    import matplotlib
    from matplotlib.figure import Figure

    order = np.argsort(found.scores, kind="stable")
    shown = min(SHOWN, max(len(order) // 2, 1))
    with matplotlib.rc_context({"font.size": 8}):
        figure = Figure(figsize=(2.3 * shown, 6.4), layout="constrained")
        grid = figure.add_gridspec(4, shown)
        along = figure.add_subplot(grid[0, :])
        along.semilogy(found.frames, found.scores / found.scores.mean(), color="0.4", lw=1)
        along.set_ylabel(f"score ({measured_by})")
        true = _true_blur(capture, found)
        if true is not None:
            truth = along.twinx()
            truth.plot(found.frames, true, color="tab:red", lw=1)
            truth.set_ylabel("true blur, px", color="tab:red")
        weights = figure.add_subplot(grid[1, :], sharex=along)
        weights.bar(found.frames, found.weights, width=1.0, color="tab:blue")
        weights.axhline(1.0, color="0.6", lw=0.8)
        weights.set(ylabel="weight", xlabel="frame")
        for row, chosen, word in ((2, order[:shown], "blurriest"), (3, order[-shown:], "sharpest")):
            for column, k in enumerate(chosen if row == 2 else chosen[::-1]):
                panel = figure.add_subplot(grid[row, column])
                frame = int(found.frames[k])
                image = stored_as_bytes(capture.needed_frames.images[frame])
                image = image if image.shape[-1] == 3 else image[..., 0]
                panel.imshow(image, cmap="gray", vmin=0, vmax=255)
                panel.set_axis_off()
                name = capture.needed_frames.names[frame]
                panel.set_title(f"{word if column == 0 else ''} {name}  {found.weights[k]:.2f}")
    return figure


def _true_blur(capture: Capture, found: Quality) -> Float64[np.ndarray, "m"] | None:
    true = capture.needed_frames.blur_px
    return None if true is None else true[found.frames]


def _ranks(values: Float64[np.ndarray, "m"]) -> Float64[np.ndarray, "m"]:
    _, rank, count = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(count) - 0.5 * (count + 1))[rank]


ABOUT = "blur.json"


def blur_images(
    folder: Path, out: Path, *, ranges: KernelRange = PUBLISHED, seed: int = 0
) -> list[dict[str, Any]]:
    """Write blurred copies of the same names and sizes, and `blur.json`; all of them or none.

    Images that stay sharp are copied byte for byte. The kernel of an image depends on the seed and
    its index in the order of names.

    Args:
        folder: PNG or JPEG images.
        out: A new or empty folder, or an earlier result.
        ranges: Ranges of the random kernels.
        seed: Random seed.

    Returns:
        A row for each image: name, whether it was blurred, size k, intensity phi, blur length.

    Raises:
        CaptureError: There are no images, one cannot be read, or `out` holds something else.
    """
    paths = list_images(folder)
    if not paths:
        raise CaptureError("there are no images", where=folder, do="give PNG or JPEG files")
    earlier = (out / ABOUT).is_file()
    if out.exists() and not (out.is_dir() and (earlier or not any(out.iterdir()))):
        raise CaptureError(
            "will not replace a folder that is not an earlier result",
            where=out,
            do="choose another folder, or empty it",
        )
    rows: list[dict[str, Any]] = []
    with replacing_folder(out) as fresh:
        for i, path in enumerate(paths):
            drawn = drawn_blur(ranges, numpy_generator(seed, i, "kernel"))
            if drawn is None:
                (fresh / path.name).write_bytes(path.read_bytes())
                rows.append({"name": path.name, "blurred": False})
                continue
            write_image(fresh / path.name, blurred(read_image(path), drawn.kernel))
            about = {"k": drawn.k, "phi": drawn.phi, "length_px": drawn.length_px}
            rows.append({"name": path.name, "blurred": True, **about})
        write_json(fresh / ABOUT, {"seed": seed} | asdict(ranges) | {"images": rows})
    return rows
