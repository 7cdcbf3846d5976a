"""The event double integral (EDI): a sharp image from a blurred one and the events of its exposure.

Motion blur averages light over the exposure, B = mean of I(t), and events give the change of each
pixel, I(t) = I(f) exp(E(t) - E(f)), with E the change of log light since the shutter opened. So

    I(f) = B exp(E(f)) / mean of exp(E(t)).

`edi` does this for one image and one event stream. Its parts: the mean is `exp(path.log_mean)` and
E(f) is `path.change`, see `events.log_path`. This holds for linear light; `latent_in_light` decodes
stored values first. The published Ev-DeblurNeRF code applies it to stored values, with a path made
of eight slices: `published`.

Sources: Pan et al., "Bringing a Blurry Frame Alive at High Frame-Rate with an Event Camera"
(CVPR 2019), and its extension to several exposures (TPAMI 2020).
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.capture import USUAL_THRESHOLD
from sharpfield.core.errors import OptionError, ShapeError
from sharpfield.core.events import EventStream
from sharpfield.core.tone import Tone, tone_of
from sharpfield.events.image import splat_bilinear
from sharpfield.events.log_path import LogPath, exposure_path, pixel_spread
from sharpfield.events.threshold import FixedThresholds

STAMPS = 9
"""Instants of an exposure in the published integral; the middle one is index 4."""

FLOOR = 1e-4
"""Linear light added before a logarithm: half a step of 8 bits in the darkest tones."""


def edi(
    blurred: Float[Tensor, "h w c"],
    events: EventStream,
    exposure_us: tuple[int, int],
    *,
    instants_us: Sequence[int] = (),
    threshold: float | tuple[float, float] = USUAL_THRESHOLD,
    encoding: str = "linear",
) -> Float[Tensor, "k h w c"]:
    """The sharp images behind one blurred image, from the events of its exposure.

    Args:
        blurred: As stored, 0...1.
        events: Of a mono sensor with the same pixels; at least those of the exposure.
        exposure_us: When the shutter opened and closed.
        instants_us: When the images are sharp, ascending; by default the middle of the exposure.
        threshold: Contrast threshold of both signs, or to darker and to brighter; natural log.
        encoding: Tone curve of the image: linear, gamma2.2 or srgb.

    Returns:
        Stored values; not clipped where they are linear.

    Raises:
        ShapeError: Image and events differ in size.
        OptionError: Events are of several cameras or behind a colour filter, the exposure is
            empty, or an instant is outside it.
    """
    if tuple(blurred.shape[:2]) != (events.height, events.width):
        raise ShapeError(
            "image and events have other sizes",
            got=f"image {tuple(blurred.shape)}, events {events.height} rows of {events.width}",
            do="crop or warp one to the other",
        )
    if events.tracks > 1 or events.coloured:
        raise OptionError(
            "edi takes the events of one mono camera", got=events, do="use `deblur` on the capture"
        )
    instants = np.asarray(instants_us or [sum(exposure_us) // 2], np.int64)
    inside = exposure_us[0] <= instants[0] and instants[-1] <= exposure_us[1]
    if not (exposure_us[0] < exposure_us[1] and inside and (np.diff(instants) >= 0).all()):
        raise OptionError(
            "sharp images lie within the exposure, in the order of time",
            got=f"exposure {exposure_us} us, instants {instants.tolist()} us",
        )
    both = threshold if isinstance(threshold, tuple) else (threshold, threshold)
    spread, tone = pixel_spread(width=events.width, height=events.height), tone_of(encoding)
    path = exposure_path(events, exposure_us, instants, FixedThresholds(*both), spread)
    light = tone.decode(blurred)
    return torch.stack([tone.encode(latent(light, path, k)) for k in range(len(instants))])


def latent(blurred: Float[Tensor, "h w c"], path: LogPath, instant: int) -> Float[Tensor, "h w c"]:
    """The sharp image at one of the path's instants, in the domain of `blurred`; not clipped.

    A path of one channel changes all colours alike.
    """
    return blurred * torch.exp(path.change[instant] - path.log_mean)


def latent_in_light(
    stored: Float[Tensor, "h w c"], path: LogPath, instant: int, tone: Tone
) -> Float[Tensor, "h w c"]:
    """The same for stored values, computed in linear light; stored values, clipped to 0...1."""
    return tone.encode(latent(tone.decode(stored), path, instant).clamp(0, 1))


def path_of_instants(slices: Float[Tensor, "j h w c"]) -> LogPath:
    """A path from its change in each of j slices; the mean is that over the j + 1 borders.

    The published rule: it samples the exposure at the borders of the slices only.
    """
    change = _borders(slices)
    return LogPath(log_mean=change.logsumexp(0) - math.log(len(change)), change=change)


def published_slices(
    events: EventStream,
    window_us: tuple[int, int],
    thresholds: FixedThresholds,
    *,
    stamps: int = STAMPS,
) -> Float[Tensor, "j h w 1"]:
    """Change of log light in each of `stamps - 1` slices, as the released code cuts them.

    Both ends of a slice belong to it, so that an event exactly on an inner border counts twice.
    Rectified positions are shared bilinearly among the pixels around them; whatever its colour, an
    event changes all channels.
    """
    borders = np.linspace(*window_us, stamps)
    first = np.searchsorted(events.t_us, borders[:-1], side="left")
    last = np.searchsorted(events.t_us, borders[1:], side="right")
    size = {"width": events.width, "height": events.height}
    slices = [
        splat_bilinear(
            np.stack([part.x, part.y], -1).astype(np.float32),
            np.where(part.p > 0, thresholds.positive, -thresholds.negative)[:, None],
            **size,
        )
        for part in (events[int(a) : int(b)] for a, b in zip(first, last, strict=True))
    ]
    return torch.as_tensor(np.stack(slices), dtype=torch.float32)


def published(
    stored: Float[Tensor, "h w c"],
    events: EventStream,
    window_us: tuple[int, int],
    thresholds: FixedThresholds,
) -> Float[Tensor, "h w c"]:
    """The target C_EDI of the released Ev-DeblurNeRF: middle of the exposure, stored values.

    Nothing is linearised or clipped: values above 1 occur.
    """
    path = path_of_instants(published_slices(events, window_us, thresholds))
    return latent(stored, path, STAMPS // 2)


def path_of_slices(slices: Float[Tensor, "j h w c"]) -> LogPath:
    """A path from its change in each of j slices, linear within each.

    The mean of exp along a line from a to b is (exp b - exp a) / (b - a): exact for the
    piecewise-linear path through the borders, so that few slices are enough.
    """
    change = _borders(slices)
    return LogPath(
        log_mean=(change[:-1] + _log_mean_of_line(slices)).logsumexp(0) - math.log(len(slices)),
        change=change,
    )


def _borders(slices: Float[Tensor, "j h w c"]) -> Float[Tensor, "k h w c"]:
    return torch.cat([torch.zeros_like(slices[:1]), slices.cumsum(0)])


def _log_mean_of_line(rise: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Log of the mean of exp along a line from 0 to `rise`: log((exp r - 1) / r), safe at 0."""
    half = rise / 2
    small = half.abs() < 1e-2
    safe = torch.where(small, torch.ones_like(half), half)
    series = half.square() / 6
    return half + torch.where(small, series, torch.log(torch.sinh(safe) / safe))


def joint_latents(
    alone: Float[Tensor, "n h w c"],
    gaps: Float[Tensor, "g h w c"],
    *,
    trust: Float[Tensor, "g h w c"] | float = 1.0,
) -> Float[Tensor, "n h w c"]:
    """Log light of n images that agrees with every exposure and with the events in between.

    Per pixel, least squares of one equation per exposure, x_i = alone_i, and one per gap,
    x_{i+1} - x_i = gaps_i. The normal equations are tridiagonal and are solved for all pixels at
    once, forwards and backwards along the images.

    Args:
        alone: From each exposure by itself: log B_i + E(f_i) - log_mean_i.
        gaps: Change of log light from each image to the next, g = n - 1.
        trust: Weight of each gap's equation; an exposure's is 1.
    """
    links = torch.ones_like(gaps) * trust
    none = torch.zeros_like(alone[:1])
    before, after = torch.cat([none, links]), torch.cat([links, none])
    pull = torch.cat([none, links * gaps]) - torch.cat([links * gaps, none])
    diagonal, right = 1 + before + after, alone + pull
    pivot, reduced = [diagonal[0]], [right[0]]
    for i in range(1, len(alone)):
        ratio = before[i] / pivot[-1]
        pivot.append(diagonal[i] - ratio * before[i])
        reduced.append(right[i] + ratio * reduced[-1])
    found = [reduced[-1] / pivot[-1]]
    for i in range(len(alone) - 2, -1, -1):
        found.append((reduced[i] + after[i] * found[-1]) / pivot[i])
    return torch.stack(found[::-1])
