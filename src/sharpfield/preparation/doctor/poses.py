"""Do the poses fit the images, and the motion they tell of the events?

Details that two images share must lie on the lines that poses and focal length say, whatever
their depth. The focal length is tried at other values: if another one fits clearly better, it is
wrong. And where poses move the image fast, many events must come.
"""

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Float64, Int64

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.seed import evenly_spread
from sharpfield.geometry.two_views import PairMatches, find_details, match_pairs, sampson_px
from sharpfield.preparation.doctor.findings import Checkup, Curve
from sharpfield.preparation.poses.images import Sharp, sharp_images

MOST_IMAGES = 8
LEAST_DETAILS = 60
"""Matches over all pairs; fewer do not judge."""
FACTORS = np.exp(np.linspace(np.log(0.5), np.log(2.0), 33))
"""Focal lengths tried, relative to the one given."""
OFF_BY, GAIN = 0.06, 0.75
"""Another focal length is right if it differs so much and leaves so small a part of the error."""
FINE_PX, POOR_PX, WRONG_PX = 0.15, 1.0, 3.0
"""Median distance from the lines: below the first nothing is wrong, above the last poses are."""
MOTION_US, LEAST_WINDOWS = 4_000, 25
"""Windows in which motion and events are compared."""
UNRELATED = 0.1
LATE_US, LATE_STEP_US, LATE_GAIN = 40_000, 2_000, 0.15
"""Other times of the poses that are tried; they count if the correlation gains so much."""
BLUR_SHARE = 0.15
"""Blur, as a share of the width, beyond which little can be saved."""


def check_images(capture: Capture, checkup: Checkup) -> None:
    """Matched details of frames, against poses and focal length."""
    frames = capture.needed_frames
    chosen = evenly_spread(np.arange(len(frames)), MOST_IMAGES)
    sharp = sharp_images(capture, "auto")
    rows = np.flatnonzero(np.isin(sharp.frame, chosen))
    poses = _poses(capture, sharp)[rows]
    pairs = [(i, j) for i in range(len(rows)) for j in range(i + 1, len(rows))]
    matches = match_pairs(find_details(sharp.images[rows]), pairs)
    count = sum(len(one) for one in matches)
    if count < LEAST_DETAILS:
        checkup.say(
            "warning" if len(rows) > 2 else "note",
            "matches",
            "too few details are shared between frames to judge the poses",
            got=f"{count} in {len(pairs)} pairs of frames",
            do="expect poses from elsewhere to be hard to check",
        )
        return
    errors = np.array([_error(matches, _zoomed(capture.camera, f), poses) for f in FACTORS])
    given = _error(matches, capture.camera, poses)
    best = int(errors.argmin())
    focal = capture.camera.fx_px
    checkup.curves.append(
        Curve(
            "Distance of details from their lines, px, for other focal lengths",
            "focal length, px",
            FACTORS * focal,
            errors,
        )
    )
    checkup.images["details that two frames share: green on the lines that poses say, else red"] = (
        _lines(sharp.images[rows], max(matches, key=len), capture.camera, poses)
    )
    got = f"median {given:.2f} px from the lines, {count} details of {len(matches)} pairs"
    off = abs(np.log(FACTORS[best])) > OFF_BY
    if given > FINE_PX and off and errors[best] < GAIN * given and errors[best] < POOR_PX:
        unknown = capture.known.intrinsics == "unknown"
        checkup.say(
            "warning" if unknown else "error",
            "focal-length",
            "the focal length does not fit the images and poses",
            got=f"{focal:.1f} px leaves {given:.2f} px; {FACTORS[best] * focal:.0f} px would leave"
            f" {errors[best]:.2f} px",
            do="give the intrinsics for this image size, or find them with"
            " `sharpfield poses --intrinsics find`",
        )
    elif given > WRONG_PX or (given > POOR_PX and capture.camera.width < 600):
        checkup.say(
            "error",
            "poses-disagree",
            "the poses do not fit the images",
            got=got,
            do="check axes (OpenCV, world from camera), the clock and the hand-eye transform, or"
            " find the poses with `sharpfield poses`",
        )
    else:
        checkup.say("note", "poses-fit", "poses and focal length fit the images", got=got)


def check_motion(capture: Capture, checkup: Checkup) -> None:
    """Whether events come when the poses say that the image moves."""
    events, known = capture.events, capture.trajectory.known_us(0)
    if events is None or known is None or events.tracks > 1:
        return
    first, last = max(known[0], int(events.t_us[0])), min(known[1], int(events.t_us[-1]))
    edges = np.arange(first + LATE_US, last - LATE_US, MOTION_US)
    if len(edges) < LEAST_WINDOWS:
        return
    rate = np.diff(np.searchsorted(events.t_us, edges)) / MOTION_US
    lates = np.arange(-LATE_US, LATE_US + 1, LATE_STEP_US)
    found = np.array(
        [float(np.corrcoef(rate, image_speed(capture, edges + late))[0, 1]) for late in lates]
    )
    if not np.isfinite(found).all():
        return
    now, best = found[len(lates) // 2], int(found.argmax())
    checkup.curves.append(
        Curve(
            "Correlation of the event rate with the motion that poses say",
            "shift of the poses, ms",
            -lates / 1000.0,
            found,
        )
    )
    got = f"correlation {now:.2f} over {len(rate)} windows of {MOTION_US // 1000} ms"
    if abs(lates[best]) > MOTION_US and found[best] > now + LATE_GAIN and found[best] > 0.5:
        checkup.say(
            "warning",
            "pose-time-shift",
            "the events would fit the motion better at another time of the poses",
            got=f"{got}; {found[best]:.2f} with poses {-lates[best] / 1000:+.0f} ms",
            do="check the clock of the poses: `sharpfield poses --trajectory FILE --offset-ms ...`",
        )
    elif now < UNRELATED:
        checkup.say(
            "note", "motion", "the event rate does not follow the motion of the poses", got=got
        )
    else:
        checkup.say("note", "motion", "the event rate follows the motion of the poses", got=got)


def check_blur(capture: Capture, checkup: Checkup) -> None:
    """How far the image moves during each exposure."""
    exposure = capture.needed_frames.exposure
    blurred = np.flatnonzero(~exposure.instant)
    if not len(blurred) or capture.trajectory.known_us(0) is None:
        return
    length = np.array([_blur_px(capture, int(i)) for i in blurred])
    names = capture.needed_frames.names
    worst = int(length.argmax())
    got = f"most in {names[blurred[worst]]}: {length[worst]:.1f} px"
    much = np.median(length) > BLUR_SHARE * capture.camera.width
    checkup.say(
        "warning" if much else "note",
        "blur",
        f"the median frame is blurred over {np.median(length):.1f} px",
        got=got,
        do="shorten the exposure" if much else "",
    )
    checkup.curves.append(
        Curve("Blur of each frame, px", "frame", blurred.astype(np.float64), length)
    )


def image_speed(capture: Capture, edges_us: Int64[np.ndarray, "k"]) -> Float64[np.ndarray, "j"]:
    """Mean distance, in px, that points at middling depth move in the image between times."""
    time = torch.from_numpy(capture.clock.unit(edges_us))
    poses = capture.trajectory.pose(time, torch.zeros(len(time), dtype=torch.int64))
    poses = poses.detach().double().numpy()
    camera = capture.camera
    depth = 2 / (1 / capture.near + 1 / capture.far)
    share = (np.arange(4) + 0.5) / 4
    grid = np.stack(np.meshgrid(share * camera.width, share * camera.height), -1).reshape(-1, 2)
    ray = camera.direction(torch.from_numpy(grid)).numpy()
    local = ray / ray[:, 2:] * depth
    world = local @ poses[:-1, :, :3].swapaxes(1, 2) + poses[:-1, None, :, 3]
    then = (world - poses[1:, None, :, 3]) @ poses[1:, :, :3]
    moved = camera.project(torch.from_numpy(then)).numpy() - grid
    return np.linalg.norm(moved, axis=-1).mean(-1)


def _blur_px(capture: Capture, frame: int) -> float:
    """Length of the path of the image during an exposure."""
    opens, closes = capture.needed_frames.exposure.window(frame)
    edges = np.linspace(opens, closes, 9).round().astype(np.int64)
    return float(image_speed(capture, edges).sum())


def _poses(capture: Capture, sharp: Sharp) -> Float64[np.ndarray, "n 3 4"]:
    time = torch.from_numpy(capture.clock.unit(sharp.time_us))
    track = torch.from_numpy(capture.needed_frames.track[sharp.frame])
    return capture.trajectory.pose(time, track).detach().double().numpy()


def _zoomed(camera: Camera, factor: float) -> Camera:
    return replace(camera, fx_px=camera.fx_px * factor, fy_px=camera.fy_px * factor)


def _error(
    matches: list[PairMatches], camera: Camera, poses: Float64[np.ndarray, "n 3 4"]
) -> float:
    return float(np.median(np.concatenate([sampson_px(one, camera, poses) for one in matches])))


def _lines(
    images: np.ndarray,
    matches: PairMatches,
    camera: Camera,
    poses: Float64[np.ndarray, "n 3 4"],
) -> np.ndarray:
    """Two images side by side; each detail in the colour of its distance from the line."""
    both = [np.broadcast_to(images[i], (*images[i].shape[:2], 3)) for i in matches.pair]
    shown = np.ascontiguousarray(np.concatenate(both, 1))
    off = sampson_px(matches, camera, poses)
    zoom = 2 if shown.shape[1] < 960 else 1
    shown = cv2.resize(shown, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
    width = zoom * camera.width
    for (one, two), away in list(zip(matches.xy, off, strict=True))[:120]:
        colour = (40, 200, 90) if away < POOR_PX else (230, 60, 40)
        a = (round(zoom * one[0]), round(zoom * one[1]))
        b = (round(zoom * two[0]) + width, round(zoom * two[1]))
        cv2.line(shown, a, b, colour, 1, cv2.LINE_AA)
    return shown
