"""The pictures of the report that are compared with each other."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.core.selection import evenly_spread
from sharpfield.evaluation.page import Colours, Picture, View
from sharpfield.evaluation.pictures import colour_error, eight_bit
from sharpfield.evaluation.reference import SHARP, TRUTH, Reference, held_out, trained_on
from sharpfield.evaluation.tables import number
from sharpfield.metrics import luma
from sharpfield.storage.images import read_image

VIEWS = 4
"""Most views of a kind to show; the tables have them all."""

BLURRY, SHARP_INPUT = "blurry input", "input"
RESULT, STORED, ERROR, DEPTH = "result", "stored image", "error", "depth"


def input_name(capture: Capture) -> str:
    """What to call recorded frames: blurry if they were, or may have been, exposed for a while."""
    frames = capture.frames
    lasting = frames is not None and not frames.exposure.instant[capture.split.train].all()
    return BLURRY if lasting or capture.notes.get("motion") == "unknown" else SHARP_INPUT


def compared_views(
    run: Path, capture: Capture, metrics: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]
) -> list[View]:
    """Views with their input, result, baselines, truth, error and depth, as far as there are.

    Args:
        run: Where the pictures lie.
        capture: Gives inputs and references.
        metrics: Names the baselines, and the folders of their renders.
        rows: Views of `metrics.json`; some are chosen if there are many.
    """
    known = {one.frame: one for one in [*held_out(capture), *trained_on(capture)]}
    others = {
        name: run / other["run"]
        for name, other in metrics.get("baselines", {}).items()
        if "run" in other
    }
    chosen = [rows[i] for i in evenly_spread(np.arange(len(rows)), VIEWS)]
    return [
        _view(run, row, known[row["frame"]], others, input_name(capture))
        for row in chosen
        if row["frame"] in known and (run / row["image"]).is_file()
    ]


def _view(
    run: Path,
    row: Mapping[str, Any],
    reference: Reference,
    others: Mapping[str, Path],
    recorded: str,
) -> View:
    result = read_image(run / row["image"])
    pictures = []
    if reference.kind in (TRUTH, ""):
        measured = eight_bit(reference.measured.numpy())
        pictures.append(_picture(recorded, measured, reference.name, row.get("input")))
    pictures.append(_picture(RESULT, result, reference.name, row))
    for name, folder in others.items():
        if (folder / row["image"]).is_file():
            pictures.append(_picture(name, read_image(folder / row["image"]), reference.name))
    if reference.image is not None:
        kind = TRUTH if reference.kind in (TRUTH, SHARP) else STORED
        pictures.append(_picture(kind, eight_bit(reference.image.numpy()), reference.name))
        grey = result.shape[-1] < reference.image.shape[-1]
        truth = luma(reference.image)[..., None] if grey else reference.image
        error = colour_error(result.astype(np.float32) / 255, truth.numpy())
        pictures.append(_picture(ERROR, error, reference.name))
    if (run / row["depth"]).is_file():
        pictures.append(_picture(DEPTH, read_image(run / row["depth"]), reference.name))
    return View(reference.name, tuple(pictures))


def _picture(
    kind: str, pixels: Colours, name: str, scores: Mapping[str, Any] | None = None
) -> Picture:
    known = scores is not None and scores.get("psnr") is not None
    caption = f"{kind}, {number('psnr', scores or {})} dB" if known else kind
    return Picture(kind, pixels, caption, f"{kind} of view {name}")
