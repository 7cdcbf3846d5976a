"""Do frames and events tell of the same light? If not, which mistake would make them?

What the frames say changed between two exposures is compared with what the events say (see
`exposure_pairs`), by their correlation over the pixels. It is also compared for every way to
mirror, turn or swap the coordinates of the events, for the other polarity, and for other times of
the frames: the mistake that makes them agree is the one that was made.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from sharpfield.core.capture import Capture
from sharpfield.events.index import EventIndex, build_index
from sharpfield.preparation.calibrate.exposure_pairs import ExposurePair, exposure_pairs, told
from sharpfield.preparation.doctor.findings import Checkup, Curve

PAIRS = 5
FARTHEST_US, COARSE_US, FINE_US = 60_000, 6_000, 1_000
"""Other times of the frames: how far, in which steps, and how finely around the best."""
SHIFT_US, SHIFT_GAIN = 6_000, 0.03
"""A shift counts from this on, if the correlation gains so much."""
LATENCY_US, CLEAR_GAIN = 10_000, 0.1
"""Shorter ones that gain less may be the pixels: in dim light they report some ms late."""
AGREES, BETTER = 0.4, 0.15
"""Correlation from which on two things agree; and what another arrangement must have on top."""
POOR = 0.6
LAST, NEXT = 0.3, 0.25
"""Parts of a threshold by which light usually is ahead of its last event, and near its next."""
SMALL = 0.2
"""Thresholds do not matter to a correlation, as long as both are alike; nor do lesser changes."""


@dataclass(frozen=True)
class Arrangement:
    """How the events would have to be changed."""

    transposed: bool = False
    mirrored_x: bool = False
    mirrored_y: bool = False
    flipped: bool = False
    """Polarity."""

    @property
    def name(self) -> str:
        """In words; nothing if nothing is changed."""
        parts = [
            "x and y exchanged" * self.transposed,
            "x mirrored" * self.mirrored_x,
            "y mirrored" * self.mirrored_y,
            "polarity flipped" * self.flipped,
        ]
        return " and ".join(part for part in parts if part)

    @property
    def flags(self) -> str:
        """The options of `sharpfield ingest` that undo it."""
        # `said` is read at the mirrored place after it was transposed, as `ingest` mends it
        parts = [
            "--swap-xy" * self.transposed,
            "--flip-x" * self.mirrored_x,
            "--flip-y" * self.mirrored_y,
            "--flip-polarity" * self.flipped,
        ]
        return " ".join(part for part in parts if part)

    def score(
        self,
        seen: Float64[np.ndarray, "n h w"],
        said: Float64[np.ndarray, "n h w"],
        usable: Bool[np.ndarray, "n h w"],
    ) -> float:
        """Correlation of what frames saw with what the events say, so changed."""
        if self.transposed:
            side = min(said.shape[1:])
            said = said[:, :side, :side].swapaxes(1, 2)
            seen, usable = seen[:, :side, :side], usable[:, :side, :side]
        if self.mirrored_x:
            said = said[:, :, ::-1]
        if self.mirrored_y:
            said = said[:, ::-1]
        good = usable & ((said != 0) | (np.abs(seen) > SMALL))
        if good.sum() < 100 or said[good].std() == 0 or seen[good].std() == 0:
            return 0.0
        found = float(np.corrcoef(np.clip(seen[good], -2, 2), np.clip(said[good], -2, 2))[0, 1])
        return -found if self.flipped else found


AS_IS = Arrangement()
ARRANGEMENTS = [Arrangement(*parts) for parts in product((False, True), repeat=4)]


@dataclass(frozen=True)
class Agreement:
    """How frames and events go together."""

    correlation: float
    """As they are."""
    best: Arrangement
    shift_us: int
    """Added to the times of frames, it makes them agree best."""
    best_correlation: float
    unshifted: float
    """Correlation of the best arrangement at the times that frames have."""


def check_agreement(capture: Capture, checkup: Checkup) -> Agreement | None:
    """Compare frames with events; None if they cannot be compared."""
    frames = capture.needed_frames
    if len(frames) < 2 or len(np.unique(frames.track)) == len(frames):
        checkup.say("note", "agreement", "single frames cannot be compared with events")
        return None
    index = build_index(capture.needed_events)
    pairs = exposure_pairs(capture, most=PAIRS)
    seen = np.stack([_luma_change(pair) for pair in pairs])
    usable = np.stack([pair.usable.all(-1) for pair in pairs])
    shifts = np.arange(-FARTHEST_US, FARTHEST_US + 1, COARSE_US)
    scores = np.array(
        [
            [one.score(seen, said, usable) for one in ARRANGEMENTS]
            for said in (_said(capture, index, pairs, int(shift)) for shift in shifts)
        ]
    )
    now = float(scores[len(shifts) // 2, 0])
    at, which = np.unravel_index(scores.argmax(), scores.shape)
    best = ARRANGEMENTS[int(which)]
    if scores.max() < max(scores[:, 0].max() + BETTER, AGREES):
        best, at = AS_IS, int(scores[:, 0].argmax())
    fine = int(shifts[at]) + np.arange(-COARSE_US, COARSE_US + 1, FINE_US)
    finer = [best.score(seen, _said(capture, index, pairs, int(s)), usable) for s in fine]
    column = ARRANGEMENTS.index(best)
    found = Agreement(
        now,
        best,
        int(fine[int(np.argmax(finer))]),
        float(np.max(finer)),
        float(scores[len(shifts) // 2, column]),
    )
    order = np.argsort(np.concatenate([shifts, fine]))
    checkup.curves.append(
        Curve(
            "Correlation of events with frames, were frames taken later",
            "shift of the frames, ms",
            np.concatenate([shifts, fine])[order] / 1000,
            np.concatenate([scores[:, column], finer])[order],
        )
    )
    _say(found, checkup)
    said = _said(capture, index, pairs[:1], 0)[0]
    checkup.images["what the frames say changed between two exposures"] = _signs(seen[0])
    checkup.images["what the events say changed"] = _signs(said)
    return found


def _say(found: Agreement, checkup: Checkup) -> None:
    shifted = (
        abs(found.shift_us) >= SHIFT_US and found.best_correlation > found.unshifted + SHIFT_GAIN
    )
    got = f"correlation {found.correlation:.2f}"
    if found.best_correlation < AGREES:
        checkup.say(
            "error",
            "disagreement",
            "events do not explain what changed between frames",
            got=f"{got}; no mirroring, swapping or shift by up to {FARTHEST_US // 1000} ms helps",
            do="check that both files are of the same recording, and the encoding of the frames",
        )
        return
    better = f"{got}, {found.best_correlation:.2f} with"
    if found.best != AS_IS:
        name = (
            "polarity-flipped"
            if found.best == Arrangement(flipped=True)
            else "axes-swapped"
            if found.best.transposed
            else "mirrored"
        )
        checkup.say(
            "error",
            name,
            f"the events have {found.best.name}",
            got=f"{better} {found.best.name}",
            do=f"ingest again with {found.best.flags}",
        )
    if shifted:
        _say_shift(found, better, checkup)
    if found.best == AS_IS and not shifted:
        poor = found.correlation < POOR
        checkup.say(
            "warning" if poor else "note",
            "agreement",
            "events explain what changed between frames" + (" only in part" if poor else ""),
            got=got,
            do="check thresholds, noise and saturation" if poor else "",
        )


def _say_shift(found: Agreement, better: str, checkup: Checkup) -> None:
    gain = found.best_correlation - found.unshifted
    small = abs(found.shift_us) <= LATENCY_US and gain < CLEAR_GAIN
    late = -found.shift_us / 1000
    do = f"ingest with --offset-ms {-late:g}, or what is given now and {-late:+g}"
    if small:
        do += "; less than the latency of the pixels is no mistake, and costs little"
    checkup.say(
        "warning" if small else "error",
        "time-shift",
        f"frame times are {abs(late):.0f} ms too {'late' if late > 0 else 'early'} for the events",
        got=f"{better} frames {abs(late):.0f} ms {'earlier' if late > 0 else 'later'}",
        do=do,
    )


def _luma_change(pair: ExposurePair) -> Float64[np.ndarray, "h w"]:
    """What changed between two exposures, less the gain of the frame."""
    change = pair.change.mean(-1)
    usable = pair.usable.all(-1)
    return change - (np.median(change[usable]) if usable.any() else 0.0)


def _said(
    capture: Capture, index: EventIndex, pairs: list[ExposurePair], shift_us: int
) -> Float64[np.ndarray, "n h w"]:
    """What the events say, as maps over the pixels."""
    width, height = capture.camera.size
    even, thresholds = np.ones(len(index)), (SMALL, SMALL)
    maps = []
    for pair in pairs:
        sites = index.sites_of(int(capture.needed_frames.track[pair.frames[0]]))
        found = told(index, even, pair.later(shift_us), sites, thresholds)
        x, y = np.rint(index.site_xy[sites]).astype(np.int64).T
        at = np.clip(y, 0, height - 1) * width + np.clip(x, 0, width - 1)
        change = found.expected + SMALL * (LAST * found.last + NEXT * found.next)
        total = np.bincount(at, change, minlength=width * height)
        many = np.maximum(np.bincount(at, minlength=width * height), 1)
        maps.append((total / many).reshape(height, width))
    return np.stack(maps)


def _signs(change: Float64[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Red where it got brighter, blue where darker."""
    full = max(float(np.percentile(np.abs(change), 95)), 1e-6)
    strength = np.clip(change / full, -1, 1)[..., None]
    colour = np.where(strength > 0, np.array((200, 32, 38)), np.array((38, 86, 190)))
    return np.rint(255 + np.abs(strength) * (colour - 255)).astype(np.uint8)
