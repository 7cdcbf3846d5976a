"""Checks of the poses: do they fit the images (epipolar geometry), and the event rate?

Features that two images share must lie on the epipolar lines of poses and focal length, whatever
their depth. Other focal lengths are tried: if one of them fits clearly better, the stated one is
wrong. And where the poses move the image fast, the event rate must be high.
"""

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Float64, Int64

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.seed import evenly_spread
from sharpfield.geometry.two_views import PairMatches, find_features, match_pairs, sampson_px
from sharpfield.preparation.doctor.findings import Checkup, MeasuredCurve
from sharpfield.preparation.poses.images import SfmImages, sfm_images

MOST_IMAGES = 8
MIN_MATCHES = 60
"""Fewer matches over all pairs are too few for the check."""
FACTORS = np.exp(np.linspace(np.log(0.5), np.log(2.0), 33))
"""Focal lengths tried, relative to the stated one."""
MIN_DIFFERENCE, MAX_ERROR_RATIO = 0.06, 0.75
"""Another focal length is reported if its log differs by so much and it reduces the error to this
share."""
FINE_PX, POOR_PX, WRONG_PX = 0.15, 1.0, 3.0
"""Median epipolar distance: below the first all is well, above the last the poses are wrong."""
MOTION_US, MIN_WINDOWS = 4_000, 25
"""Length and smallest number of the windows in which motion and event rate are compared."""
UNRELATED = 0.1
"""Correlation below which the event rate does not follow the motion."""
MAX_SHIFT_US, SHIFT_STEP_US, SHIFT_GAIN = 40_000, 2_000, 0.15
"""Time shifts of the poses that are tried; one is reported if the correlation gains so much."""
BLUR_SHARE = 0.15
"""Blur, as a share of the image width, that is a warning."""


def check_images(capture: Capture, checkup: Checkup) -> None:
    """Check poses and focal length by matched features of the frames."""
    frames = capture.needed_frames
    chosen = evenly_spread(np.arange(len(frames)), MOST_IMAGES)
    sharp = sfm_images(capture, "auto")
    rows = np.flatnonzero(np.isin(sharp.frame, chosen))
    poses = _poses(capture, sharp)[rows]
    pairs = [(i, j) for i in range(len(rows)) for j in range(i + 1, len(rows))]
    matches = match_pairs(find_features(sharp.images[rows]), pairs)
    count = sum(len(one) for one in matches)
    if count < MIN_MATCHES:
        checkup.add(
            "warning" if len(rows) > 2 else "note",
            "matches",
            "too few features match between frames to check the poses",
            got=f"{count} in {len(pairs)} pairs of frames",
            do="poses from another source will be hard to check, too",
        )
        return
    errors = np.array([_error(matches, _zoomed(capture.camera, f), poses) for f in FACTORS])
    given = _error(matches, capture.camera, poses)
    best = int(errors.argmin())
    focal = capture.camera.fx_px
    checkup.curves.append(
        MeasuredCurve(
            "Epipolar distance of matches, px, for other focal lengths",
            "focal length, px",
            FACTORS * focal,
            errors,
        )
    )
    checkup.images["matches of two frames: green on their epipolar lines, else red"] = _lines(
        sharp.images[rows], max(matches, key=len), capture.camera, poses
    )
    got = f"median {given:.2f} px from the epipolar lines, {count} matches of {len(matches)} pairs"
    differs = given > FINE_PX and abs(np.log(FACTORS[best])) > MIN_DIFFERENCE
    if differs and errors[best] < min(MAX_ERROR_RATIO * given, POOR_PX):
        unknown = capture.known.intrinsics == "unknown"
        checkup.add(
            "warning" if unknown else "error",
            "focal-length",
            "the focal length does not fit the images and poses",
            got=f"{focal:.1f} px leaves {given:.2f} px; {FACTORS[best] * focal:.0f} px would leave"
            f" {errors[best]:.2f} px",
            do="give the intrinsics for this image size, or find them with"
            " `sharpfield poses --intrinsics find`",
        )
    elif given > WRONG_PX or (given > POOR_PX and capture.camera.width < 600):
        checkup.add(
            "error",
            "poses-disagree",
            "the poses do not fit the images",
            got=got,
            do="check axes (OpenCV, world from camera), the clock and the hand-eye transform, or"
            " find the poses with `sharpfield poses`",
        )
    else:
        checkup.add("note", "poses-fit", "poses and focal length fit the images", got=got)


def check_motion(capture: Capture, checkup: Checkup) -> None:
    """Check the event rate against the image motion of the poses."""
    events, known = capture.events, capture.trajectory.known_us(0)
    if events is None or known is None or events.tracks > 1:
        return
    first, last = max(known[0], int(events.t_us[0])), min(known[1], int(events.t_us[-1]))
    edges = np.arange(first + MAX_SHIFT_US, last - MAX_SHIFT_US, MOTION_US)
    if len(edges) < MIN_WINDOWS:
        return
    rate = np.diff(np.searchsorted(events.t_us, edges)) / MOTION_US
    shifts_us = np.arange(-MAX_SHIFT_US, MAX_SHIFT_US + 1, SHIFT_STEP_US)
    found = np.array(
        [float(np.corrcoef(rate, image_speed(capture, edges + shift))[0, 1]) for shift in shifts_us]
    )
    if not np.isfinite(found).all():
        return
    now, best = found[len(shifts_us) // 2], int(found.argmax())
    checkup.curves.append(
        MeasuredCurve(
            "Correlation of the event rate with the image motion of the poses",
            "shift of the poses, ms",
            -shifts_us / 1000.0,
            found,
        )
    )
    got = f"correlation {now:.2f} over {len(rate)} windows of {MOTION_US // 1000} ms"
    if abs(shifts_us[best]) > MOTION_US and found[best] > now + SHIFT_GAIN and found[best] > 0.5:
        checkup.add(
            "warning",
            "pose-time-shift",
            "the event rate fits the motion better with the poses shifted in time",
            got=f"{got}; {found[best]:.2f} with a shift of {-shifts_us[best] / 1000:+.0f} ms",
            do="check the clock of the poses: `sharpfield poses --trajectory FILE --offset-ms ...`",
        )
    elif now < UNRELATED:
        checkup.add(
            "note", "motion", "the event rate does not follow the motion of the poses", got=got
        )
    else:
        checkup.add("note", "motion", "the event rate follows the motion of the poses", got=got)


def check_blur(capture: Capture, checkup: Checkup) -> None:
    """Check the blur of each frame: how far the image moves during its exposure."""
    exposure = capture.needed_frames.exposure
    blurred = np.flatnonzero(~exposure.instant)
    if not len(blurred) or capture.trajectory.known_us(0) is None:
        return
    length = np.array(
        [
            image_speed(capture, np.linspace(*exposure.window(int(i)), 9).round().astype(int)).sum()
            for i in blurred
        ]
    )
    names = capture.needed_frames.names
    worst = int(length.argmax())
    got = f"most in {names[blurred[worst]]}: {length[worst]:.1f} px"
    much = np.median(length) > BLUR_SHARE * capture.camera.width
    checkup.add(
        "warning" if much else "note",
        "blur",
        f"the median frame is blurred over {np.median(length):.1f} px",
        got=got,
        do="shorten the exposure" if much else "",
    )
    checkup.curves.append(
        MeasuredCurve("Blur of each frame, px", "frame", blurred.astype(np.float64), length)
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
    ray = camera.direction(torch.from_numpy(grid)).numpy()  # [16, 3]
    local = ray / ray[:, 2:] * depth  # on the plane of the mean disparity
    world = local @ poses[:-1, :, :3].swapaxes(1, 2) + poses[:-1, None, :, 3]  # [n, 16, 3]
    then = (world - poses[1:, None, :, 3]) @ poses[1:, :, :3]
    moved = camera.project(torch.from_numpy(then)).numpy() - grid  # [n, 16, 2]
    return np.linalg.norm(moved, axis=-1).mean(-1)


def _poses(capture: Capture, sharp: SfmImages) -> Float64[np.ndarray, "n 3 4"]:
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
    images: np.ndarray, matches: PairMatches, camera: Camera, poses: Float64[np.ndarray, "n 3 4"]
) -> np.ndarray:
    """Two images side by side, their matches coloured by epipolar distance."""
    both = [np.broadcast_to(images[i], (*images[i].shape[:2], 3)) for i in matches.pair]
    shown = np.ascontiguousarray(np.concatenate(both, 1))
    distance_px = sampson_px(matches, camera, poses)
    zoom = 2 if shown.shape[1] < 960 else 1
    shown = cv2.resize(shown, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
    width = zoom * camera.width
    for (one, two), distance in list(zip(matches.xy, distance_px, strict=True))[:120]:
        colour = (40, 200, 90) if distance < POOR_PX else (230, 60, 40)
        a = (round(zoom * one[0]), round(zoom * one[1]))
        b = (round(zoom * two[0]) + width, round(zoom * two[1]))
        cv2.line(shown, a, b, colour, 1, cv2.LINE_AA)
    return shown
