"""Deblur the frames of a capture by the event double integral (EDI), frame by frame.

No scene is learned. It is a quick test of events, thresholds, clocks and pixel grids: where one of
these is wrong, the images get worse instead of sharper. Output: images, a contact sheet of blurred
and deblurred frames, and metrics.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int64, Shaped, UInt8
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.files import write_json
from sharpfield.core.seed import evenly_spread
from sharpfield.core.tone import luma, tone_of
from sharpfield.events.counts import EventMotion
from sharpfield.events.double_integral import FLOOR, joint_latents, latent, published
from sharpfield.events.threshold import FixedThresholds
from sharpfield.events.threshold_search import edge_density
from sharpfield.metrics.image import gradient_energy, psnr
from sharpfield.preparation.options import DeblurOptions
from sharpfield.preparation.thresholds import (
    FoundThresholds,
    find_thresholds,
    known_thresholds,
    linear_light,
)
from sharpfield.report.colormaps import stored_as_bytes
from sharpfield.storage.images import write_image


@dataclass(frozen=True)
class Deblurred:
    """Sharp images of the frames of a capture, in the frames' own encoding."""

    images: Shaped[np.ndarray, "n k h w c"]
    """One image per instant of each exposure."""
    frame: Int64[np.ndarray, "n"]
    """Index of the frame in the capture."""
    instants_us: Int64[np.ndarray, "n k"]
    found: FoundThresholds
    """Thresholds that were used."""


def deblur_frames(capture: Capture, options: DeblurOptions) -> Deblurred:
    """Sharp images of the training frames, or of all blurred frames if there are none.

    Raises:
        CaptureError: Frames or events are missing, or no frame is blurred.
    """
    frames = capture.needed_frames
    chosen = capture.split.train if len(capture.split.train) else np.arange(len(frames))
    chosen = chosen[~frames.exposure.instant[chosen]]
    if not len(chosen):
        raise CaptureError(
            "no frame to deblur has an exposure", where=capture.name, do="give exposure times"
        )
    chosen = chosen[np.argsort(frames.exposure.open_us[chosen], kind="stable")]
    motion = EventMotion.of(capture)
    found = _thresholds(capture, motion, options)
    opens, length = frames.exposure.open_us[chosen], frames.exposure.duration_us[chosen]
    parts = (np.arange(options.instants) + 0.5) / options.instants
    instants = opens[:, None] + np.rint(length[:, None] * parts).astype(np.int64)
    if options.method == "joint":
        images = _joint(capture, motion, chosen, instants[:, 0], found.thresholds)
    elif options.method == "published":
        images = np.stack([_published(capture, int(i), found.thresholds) for i in chosen])
    else:
        images = np.stack(
            [
                _exact(capture, motion, int(i), when, found.thresholds)
                for i, when in zip(chosen, instants, strict=True)
            ]
        )
    return Deblurred(images, chosen, instants, found)


def _thresholds(capture: Capture, motion: EventMotion, options: DeblurOptions) -> FoundThresholds:
    if not isinstance(options.threshold, str):
        return FoundThresholds(FixedThresholds(options.threshold, options.threshold), "given")
    known = known_thresholds(capture) if options.threshold == "known" else None
    return find_thresholds(capture, motion) if known is None else FoundThresholds(known, "known")


def _exact(
    capture: Capture,
    motion: EventMotion,
    frame: int,
    instants_us: Int64[np.ndarray, "k"],
    thresholds: FixedThresholds,
) -> Shaped[np.ndarray, "k h w c"]:
    tone = tone_of(capture.needed_frames.encoding)
    light = linear_light(capture, frame, tone)
    path = motion.path(capture.needed_frames.exposure.window(frame), instants_us, thresholds)
    sharp = torch.stack([latent(light, path, k) for k in range(len(instants_us))])
    return _stored(capture, tone.encode(sharp.clamp(0, 1)))


def _published(
    capture: Capture, frame: int, thresholds: FixedThresholds
) -> Shaped[np.ndarray, "1 h w c"]:
    frames = capture.needed_frames
    stored = torch.from_numpy(np.asarray(frames.images[frame], np.float32)) / frames.white
    window = capture.needed_frames.exposure.window(frame)
    return _stored(capture, published(stored, capture.needed_events, window, thresholds)[None])


def _joint(
    capture: Capture,
    motion: EventMotion,
    frames: Int64[np.ndarray, "n"],
    middles_us: Int64[np.ndarray, "n"],
    thresholds: FixedThresholds,
) -> Shaped[np.ndarray, "n 1 h w c"]:
    """A monochrome sensor gives the luma; each colour is scaled with the luma of its pixel."""
    tone = tone_of(capture.needed_frames.encoding)
    sharp = []
    for frame, middle in zip(frames, middles_us, strict=True):
        path = motion.path(
            capture.needed_frames.exposure.window(int(frame)), np.array([middle]), thresholds
        )
        sharp.append(latent(linear_light(capture, int(frame), tone), path, 0))
    sharp = torch.stack(sharp)  # [n, h, w, c]
    observed = sharp if motion.channel is not None else luma(sharp)[..., None]
    gaps = [
        motion.between(int(start), int(end), thresholds)
        for start, end in zip(middles_us[:-1], middles_us[1:], strict=True)
    ]
    alone = (observed + FLOOR).log()
    agreed = joint_latents(alone, torch.stack(gaps)) if gaps else alone
    made = tone.encode((sharp * (agreed - alone).exp()).clamp(0, 1))
    return _stored(capture, made)[:, None]


def _stored(capture: Capture, image: Float[Tensor, "*n h w c"]) -> Shaped[np.ndarray, "*n h w c"]:
    """Rounded to the data type of the frames."""
    frames = capture.needed_frames
    return np.rint(image.clamp(0, 1).numpy() * frames.white).astype(frames.images.dtype)


SHEET_ROWS, GAP = 4, 4
"""Rows of the contact sheet, and pixels between its images."""

Image = Shaped[np.ndarray, "h w c"]


def deblur_to(capture: Capture, out: Path, options: DeblurOptions) -> Deblurred:
    """Deblur; write the images, `contact.png` and `deblur.json` to a folder.

    A frame's image has its name; several of one exposure have `_0`, `_1`, ... appended.

    Raises:
        CaptureError: See `deblur_frames`.
    """
    made = deblur_frames(capture, options)
    out.mkdir(parents=True, exist_ok=True)
    for names, images in zip(_names(capture, made), made.images, strict=True):
        for name, image in zip(names, images, strict=True):
            write_image(out / name, image)
    write_image(out / "contact.png", contact_sheet(capture, made))
    write_json(out / "deblur.json", deblur_summary(capture, made))
    return made


def deblur_summary(capture: Capture, made: Deblurred) -> dict[str, object]:
    """Thresholds, times and metrics as plain values for JSON.

    Metrics are given for the blurred frame and for the image nearest to the middle of its exposure:
    edge density (lower is sharper), gradient energy (higher is sharper, or noisier), and PSNR where
    the truth is known.
    """
    rows = [
        {
            "frame": capture.needed_frames.names[frame],
            "images": names,
            "times_us": instants.tolist(),
            "before": _scores(capture, int(frame), capture.needed_frames.images[frame]),
            "after": _scores(capture, int(frame), _middle(images)),
        }
        for frame, names, instants, images in zip(
            made.frame, _names(capture, made), made.instants_us, made.images, strict=True
        )
    ]
    used = made.found.thresholds
    return {
        "thresholds": asdict(used) | {"from": made.found.source, "cost": made.found.cost},
        "mean": {
            when: {
                name: float(np.mean([row[when][name] for row in rows if name in row[when]]))
                for name in sorted({name for row in rows for name in row[when]})
            }
            for when in ("before", "after")
        },
        "frames": rows,
    }


def contact_sheet(capture: Capture, made: Deblurred) -> UInt8[np.ndarray, "H W 3"]:
    """Blurred, deblurred and, where known, true images of a few frames side by side."""
    frames = capture.needed_frames
    height, width = frames.images.shape[1:3]
    lines = []
    for row in evenly_spread(np.arange(len(made.frame)), SHEET_ROWS):
        frame = int(made.frame[row])
        line = [frames.images[frame], _middle(made.images[row]), _truth(capture, frame)]
        lines.append([stored_as_bytes(image) for image in line if image is not None])
    shape = len(lines), height + GAP, max(map(len, lines)), width + GAP, 3
    sheet = np.full(shape, 255, np.uint8)
    for i, line in enumerate(lines):
        for j, image in enumerate(line):
            sheet[i, :height, j, :width] = image
    return sheet.reshape(shape[0] * shape[1], -1, 3)[:-GAP, :-GAP]


def _names(capture: Capture, made: Deblurred) -> list[list[str]]:
    stems = [Path(capture.needed_frames.names[frame]).stem for frame in made.frame]
    count = made.images.shape[1]
    if count == 1:
        return [[f"{stem}.png"] for stem in stems]
    return [[f"{stem}_{k}.png" for k in range(count)] for stem in stems]


def _scores(capture: Capture, frame: int, image: Image) -> dict[str, float]:
    white = capture.needed_frames.white
    shown = torch.from_numpy(np.asarray(image, np.float32)) / white
    scores = {
        "edge_density": edge_density(luma(shown)[..., None]),
        "gradient_energy": float(gradient_energy(shown)),
    }
    truth = _truth(capture, frame)
    if truth is not None:
        true = torch.from_numpy(np.asarray(truth, np.float32)) / white
        scores["psnr"] = float(psnr(shown, true))
    return scores


def _truth(capture: Capture, frame: int) -> Image | None:
    frames = capture.needed_frames
    return frames.truth[frame] if frames.truth is not None and frames.with_truth[frame] else None


def _middle(images: Shaped[np.ndarray, "k h w c"]) -> Image:
    return images[len(images) // 2]
