"""What deblurring leaves behind: pictures, a sheet of before and after, numbers."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Shaped, UInt8

from sharpfield.core.capture import Capture
from sharpfield.core.files import write_json
from sharpfield.core.selection import evenly_spread
from sharpfield.formation.edi_threshold import edge_density
from sharpfield.metrics.image import psnr
from sharpfield.metrics.sharpness import gradient_energy, luma
from sharpfield.preparation.deblur import DeblurOptions, Deblurred, deblur
from sharpfield.storage.images import write_image

SHEET_ROWS, GAP = 4, 4
"""The contact sheet: so many frames below each other, so many pixels between pictures."""

Picture = Shaped[np.ndarray, "h w c"]


def deblur_to(capture: Capture, out: Path, options: DeblurOptions) -> Deblurred:
    """Deblur; write the pictures, `contact.png` and `deblur.json` to a folder.

    A frame's picture has its name; several of one exposure have `_0`, `_1`, ... appended.

    Raises:
        CaptureError: See `deblur`.
    """
    made = deblur(capture, options)
    out.mkdir(parents=True, exist_ok=True)
    for names, pictures in zip(_names(capture, made), made.pictures, strict=True):
        for name, picture in zip(names, pictures, strict=True):
            write_image(out / name, picture)
    write_image(out / "contact.png", contact_sheet(capture, made))
    write_json(out / "deblur.json", summary(capture, made))
    return made


def summary(capture: Capture, made: Deblurred) -> dict[str, object]:
    """Thresholds, times and scores, ready for JSON.

    Scores are those of the picture nearest the middle of each exposure, and of the blurred frame
    before: the density of edges (lower is sharper), the energy of the gradient (higher is sharper,
    or noisier), and PSNR where the truth is known.
    """
    rows = [
        {
            "frame": capture.needed_frames.names[frame],
            "pictures": names,
            "times_us": instants.tolist(),
            "before": _scores(capture, int(frame), capture.needed_frames.images[frame]),
            "after": _scores(capture, int(frame), _middle(pictures)),
        }
        for frame, names, instants, pictures in zip(
            made.frame, _names(capture, made), made.instants_us, made.pictures, strict=True
        )
    ]
    used = made.found.thresholds
    return {
        "thresholds": {
            "negative": used.negative,
            "positive": used.positive,
            "from": made.found.judge,
            "cost": made.found.cost,
        },
        "mean": {when: _mean([row[when] for row in rows]) for when in ("before", "after")},
        "frames": rows,
    }


def contact_sheet(capture: Capture, made: Deblurred) -> UInt8[np.ndarray, "H W 3"]:
    """Blurred, deblurred and, where known, true pictures side by side, a few frames of them."""
    held = capture.needed_frames
    rows = evenly_spread(np.arange(len(made.frame)), SHEET_ROWS)
    lines = []
    for row in rows:
        frame = int(made.frame[row])
        line = [held.images[frame], _middle(made.pictures[row])]
        truth = _truth(capture, frame)
        lines.append(
            [_eight_bit(picture, held.white) for picture in [*line, truth] if picture is not None]
        )
    widest = max(len(line) for line in lines)
    height, width = lines[0][0].shape[:2]
    sheet = np.full(
        (len(lines) * (height + GAP) - GAP, widest * (width + GAP) - GAP, 3), 255, np.uint8
    )
    for i, line in enumerate(lines):
        for j, picture in enumerate(line):
            top, left = i * (height + GAP), j * (width + GAP)
            sheet[top : top + height, left : left + width] = picture
    return sheet


def _names(capture: Capture, made: Deblurred) -> list[list[str]]:
    stems = [Path(capture.needed_frames.names[frame]).stem for frame in made.frame]
    count = made.pictures.shape[1]
    if count == 1:
        return [[f"{stem}.png"] for stem in stems]
    return [[f"{stem}_{k}.png" for k in range(count)] for stem in stems]


def _scores(capture: Capture, frame: int, picture: Picture) -> dict[str, float]:
    white = capture.needed_frames.white
    shown = torch.from_numpy(np.asarray(picture, np.float32)) / white
    scores = {
        "edge_density": edge_density(luma(shown)[..., None]),
        "gradient_energy": float(gradient_energy(shown)),
    }
    truth = _truth(capture, frame)
    if truth is not None:
        true = torch.from_numpy(np.asarray(truth, np.float32)) / white
        scores["psnr"] = float(psnr(shown, true))
    return scores


def _mean(scores: list[dict[str, float]]) -> dict[str, float]:
    names = {name for score in scores for name in score}
    return {
        name: float(np.mean([score[name] for score in scores if name in score]))
        for name in sorted(names)
    }


def _truth(capture: Capture, frame: int) -> Picture | None:
    held = capture.needed_frames
    return held.truth[frame] if held.truth is not None and held.with_truth[frame] else None


def _middle(pictures: Shaped[np.ndarray, "k h w c"]) -> Picture:
    return pictures[len(pictures) // 2]


def _eight_bit(picture: Picture, white: int) -> UInt8[np.ndarray, "h w 3"]:
    scaled = np.rint(np.asarray(picture, np.float64) * (255 / white)).astype(np.uint8)
    return np.broadcast_to(scaled, (*scaled.shape[:2], 3))
