"""Trajectories: the pose of a camera at any time; known, refined, or learned from blur alone.

Poses are world-from-camera, OpenCV axes. Times given to `pose` are 0...1 of the capture and are
clamped to the known interval. A *track* is one camera's path; see `core.protocols.Trajectory`.
"""

from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from sharpfield.core.capture import Clock
from sharpfield.core.errors import CaptureError, ShapeError
from sharpfield.core.protocols import Trajectory
from sharpfield.geometry import se3, spline
from sharpfield.geometry.space import Similarity

ORTHONORMAL = 1e-5
"""How far R^T R may be from the identity; published files keep about 5e-7."""


def check_poses(poses: Float[np.ndarray, "p 3 4"], where: object = "poses") -> None:
    """Make sure that poses are finite and their rotations orthonormal and right-handed.

    Raises:
        ShapeError: The array has another shape.
        CaptureError: They are not; the first bad one is named.
    """
    if np.shape(poses)[1:] != (3, 4):
        raise ShapeError(
            "poses have another shape",
            where=where,
            got=np.shape(poses),
            do="give an array of shape (n, 3, 4), world-from-camera",
        )
    wrong = np.flatnonzero(~np.isfinite(poses).all((1, 2)))
    if len(wrong):
        raise CaptureError("a pose holds NaN or infinity", where=f"{where}, pose {wrong[0]}")
    rotations = poses[:, :, :3]
    error = np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max((1, 2))
    wrong = np.flatnonzero((error > ORTHONORMAL) | (np.linalg.det(rotations) < 0))
    if len(wrong):
        i = int(wrong[0])
        raise CaptureError(
            "a rotation is not orthonormal and right-handed",
            where=f"{where}, pose {i}",
            got=f"|R^T R - 1| up to {error[i]:.2g}, det R = {np.linalg.det(rotations[i]):.4g}",
            do="check the axis convention, and that rows and columns were not exchanged",
        )


class Stamped(nn.Module):
    """Poses at known times, interpolated: rotation by SLERP, translation by a cubic or a line.

    Source: Ev-DeblurNeRF (CVPR 2024); its text says spherical linear interpolation for both, its
    data are interpolated with an interpolating cubic for translation.
    """

    stamps: Float[Tensor, "p"]
    rotation: Float[Tensor, "p 3 3"]
    turn: Float[Tensor, "q 3"]
    """Rotation vector from each pose to the next; q = p - 1."""
    curve: Float[Tensor, "q 4 3"]
    """Coefficients of the translation in each segment, see `spline.cubic_coefficients`."""

    def __init__(
        self,
        times_us: Int64[np.ndarray, "p"],
        poses: Float[np.ndarray, "p 3 4"],
        clock: Clock,
        translation: str = "cubic",
    ) -> None:
        super().__init__()
        if len(times_us) != len(poses) or not len(poses):
            raise CaptureError(
                "there must be one time for each pose, and at least one",
                got=f"{len(times_us)} times, {len(poses)} poses",
            )
        back = np.flatnonzero(np.diff(times_us) <= 0)
        if len(back):
            raise CaptureError(
                "times of poses must ascend",
                where=f"poses {back[0]} and {back[0] + 1}",
                got=f"{times_us[back[0]]} us, then {times_us[back[0] + 1]} us",
                do="sort them, and drop repeated stamps",
            )
        check_poses(poses)
        self.times_us, self.poses = times_us, np.asarray(poses, np.float64)
        self.clock, self.translation = clock, translation
        self._prepare()

    def _prepare(self) -> None:
        unit = self.clock.unit(self.times_us)
        segments = _line if self.translation == "linear" else spline.cubic_coefficients
        rotation = torch.as_tensor(self.poses[:, :, :3])
        turn = se3.rotation_log(rotation[:-1].transpose(-1, -2) @ rotation[1:])
        self.register_buffer("stamps", torch.as_tensor(unit), persistent=False)
        self.register_buffer("rotation", rotation.contiguous(), persistent=False)
        self.register_buffer("turn", turn, persistent=False)
        self.register_buffer(
            "curve", torch.as_tensor(segments(unit, self.poses[:, :, 3])), persistent=False
        )

    def pose(
        self, time: Float[Tensor, "*b"], track: Int64[Tensor, "*b"]
    ) -> Float[Tensor, "*b 3 4"]:
        """World-from-camera at a time; there is one track."""
        time64 = time.double().clamp(self.stamps[0], self.stamps[-1])
        if len(self.stamps) == 1:
            fixed = torch.cat([self.rotation[0], self.curve[0, 0, :, None]], -1)
            return fixed.to(time.dtype).expand(*time.shape, 3, 4)
        i = torch.searchsorted(self.stamps, time64.detach(), right=True) - 1
        i = i.clamp(0, len(self.stamps) - 2)
        s = time64 - self.stamps[i]
        part = s / (self.stamps[i + 1] - self.stamps[i])
        rotation = self.rotation[i] @ se3.rotation_exp(part[..., None] * self.turn[i])
        c0, c1, c2, c3 = self.curve[i].unbind(-2)
        s = s[..., None]
        translation = c0 + s * (c1 + s * (c2 + s * c3))
        return torch.cat([rotation, translation[..., None]], -1).to(time.dtype)

    def known_us(self, track: int) -> tuple[int, int]:
        """First and last stamp."""
        return int(self.times_us[0]), int(self.times_us[-1])


def _line(times: Float[np.ndarray, "p"], values: Float[np.ndarray, "p d"]) -> np.ndarray:
    flat = np.zeros((max(len(times) - 1, 1), 4, values.shape[1]))
    flat[:, 0] = values[:-1] if len(times) > 1 else values
    if len(times) > 1:
        flat[:, 1] = np.diff(values, axis=0) / np.diff(times)[:, None]
    return flat


class Still(nn.Module):
    """Static tracks: one pose each, at any time."""

    fixed: Float[Tensor, "n 3 4"]

    def __init__(self, poses: Float[np.ndarray, "n 3 4"]) -> None:
        super().__init__()
        check_poses(poses)
        self.poses = np.asarray(poses, np.float64)
        self.register_buffer("fixed", torch.as_tensor(self.poses).float(), persistent=False)

    def pose(
        self, time: Float[Tensor, "*b"], track: Int64[Tensor, "*b"]
    ) -> Float[Tensor, "*b 3 4"]:
        """World-from-camera of each track."""
        return self.fixed[track].to(time.dtype)

    def known_us(self, track: int) -> None:
        """Always known."""
        return None


class Tracks(nn.Module):
    """Several tracks: first those that move, then the static ones."""

    moving: Sequence[Trajectory]

    def __init__(self, moving: Sequence[nn.Module], still: Float[np.ndarray, "n 3 4"]) -> None:
        super().__init__()
        self.moving = cast(Sequence[Trajectory], nn.ModuleList(moving))
        self.still = Still(still)

    def pose(
        self, time: Float[Tensor, "*b"], track: Int64[Tensor, "*b"]
    ) -> Float[Tensor, "*b 3 4"]:
        """World-from-camera, each on its track."""
        count = len(self.moving)
        if count and bool((track == 0).all()):
            return self.moving[0].pose(time, track)
        result = time.new_empty(*time.shape, 3, 4)
        for number, path in enumerate(self.moving):
            member = track == number
            result[member] = path.pose(time[member], torch.zeros_like(track[member]))
        member = track >= count
        result[member] = self.still.pose(time[member], track[member] - count)
        return result

    def known_us(self, track: int) -> tuple[int, int] | None:
        """As the track's own."""
        return self.moving[track].known_us(0) if track < len(self.moving) else None


class BSpline(nn.Module):
    """A cubic B-spline on SE(3) with uniform knots; smooth, and passes near its knots.

    Segment i lies between knots i+1 and i+2, so `m` knots span `m - 3` segments.
    """

    knots: Float[Tensor, "m 3 4"]

    def __init__(
        self, knots: Float[Tensor, "m 3 4"], start_us: int, end_us: int, clock: Clock
    ) -> None:
        super().__init__()
        if len(knots) < 4:
            raise CaptureError("a cubic B-spline needs at least 4 knots", got=len(knots))
        self.start_us, self.end_us, self.clock = start_us, end_us, clock
        self.register_buffer("knots", knots, persistent=False)
        self.twist = nn.Parameter(torch.zeros(len(knots), 6))
        """Learned change of each knot, applied in its own axes; zero at first."""

    def pose(
        self, time: Float[Tensor, "*b"], track: Int64[Tensor, "*b"]
    ) -> Float[Tensor, "*b 3 4"]:
        """World-from-camera at a time; there is one track."""
        start, end = (float(self.clock.unit(t)) for t in (self.start_us, self.end_us))
        segments = len(self.knots) - 3
        u = ((time - start) / (end - start)).clamp(0, 1) * segments
        i = u.detach().long().clamp(0, segments - 1)
        moved = se3.compose(self.knots, se3.exp(self.twist.to(self.knots.dtype)))
        near = i[..., None] + torch.arange(4, device=time.device)  # [*b, 4]
        return spline.bspline(moved[near], (u - i).to(moved.dtype)).to(time.dtype)

    def known_us(self, track: int) -> tuple[int, int]:
        """The time its segments span."""
        return self.start_us, self.end_us


class Changed(nn.Module):
    """A trajectory made from another one, over the same times."""

    base: Trajectory

    def known_us(self, track: int) -> tuple[int, int] | None:
        """As the base's."""
        return self.base.known_us(track)


class LearnedTwists(Changed):
    """A trajectory with a cubic B-spline of twists for each track, applied in camera axes."""

    twist: nn.Parameter
    """[tracks, knots, 6]"""

    def _corrected(
        self, time: Float[Tensor, "*b"], track: Int64[Tensor, "*b"], u: Float[Tensor, "*b"]
    ) -> Float[Tensor, "*b 3 4"]:
        """The base's pose, and then the twist at position u in the spline, counted in segments."""
        i = u.detach().long().clamp(0, self.twist.shape[1] - 4)
        near = i[..., None] + torch.arange(4, device=time.device)  # [*b, 4]
        weights = spline.bspline_weights(u - i)
        twist = (weights[..., None] * self.twist[track[..., None], near]).sum(-2)
        return se3.compose(self.base.pose(time, track), se3.exp(twist))


class LearnedKnots(LearnedTwists):
    """A trajectory with a small learned correction, smooth in time; zero at first.

    The correction of a track is a cubic B-spline of twists, applied in camera axes, so that errors
    of a motion-capture or SfM trajectory can be refined together with the scene.
    """

    def __init__(self, base: Trajectory, *, knots: int, tracks: int = 1) -> None:
        super().__init__()
        if knots < 4:
            raise CaptureError("a cubic B-spline needs at least 4 knots", got=knots)
        self.base = base
        self.twist = nn.Parameter(torch.zeros(tracks, knots, 6))

    def pose(
        self, time: Float[Tensor, "*b"], track: Int64[Tensor, "*b"]
    ) -> Float[Tensor, "*b 3 4"]:
        """The base's pose, corrected."""
        segments = self.twist.shape[1] - 3
        return self._corrected(time, track, time.clamp(0, 1) * segments)


class Moved(Changed):
    """A trajectory in another world: scaled, rotated and translated."""

    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]

    def __init__(self, base: Trajectory, change: Similarity) -> None:
        super().__init__()
        self.base, self.change = base, change
        self.register_buffer("rotation", torch.as_tensor(change.rotation), persistent=False)
        self.register_buffer("translation", torch.as_tensor(change.translation), persistent=False)

    def pose(
        self, time: Float[Tensor, "*b"], track: Int64[Tensor, "*b"]
    ) -> Float[Tensor, "*b 3 4"]:
        """The base's pose, in the other world."""
        pose = self.base.pose(time, track)
        turn = self.rotation.to(pose.dtype)
        shift = self.translation.to(pose.dtype)
        centre = self.change.scale * (turn @ pose[..., 3:]) + shift[:, None]
        return torch.cat([turn @ pose[..., :3], centre], -1)


def count_tracks(path: Trajectory) -> int:
    """How many tracks a trajectory has."""
    match path:
        case Still():
            return len(path.poses)
        case Tracks():
            return len(path.moving) + len(path.still.poses)
        case LearnedKnots() | Moved():
            return count_tracks(path.base)
        case _:
            return 1


class LearnedExposureMotion(LearnedTwists):
    """A trajectory whose tracks are photos, each with a learned motion over its exposure.

    The motion is a cubic B-spline of twists in camera axes; outside the exposure the camera is
    static.

    Args:
        base: The pose of each photo.
        opens: When each track's shutter opened, 0...1 of the capture.
        closes: When it closed; later.
        knots: Of each spline, at least 4.
        start: First twists; small random ones, as a motion that is exactly zero never learns.

    Source: BAD-NeRF (CVPR 2023) for the idea, with a line or a spline between the ends.
    """

    opens: Tensor
    closes: Tensor

    def __init__(
        self,
        base: Trajectory,
        opens: Float[Tensor, "n"],
        closes: Float[Tensor, "n"],
        *,
        knots: int,
        start: Float[Tensor, "n m 6"] | None = None,
    ) -> None:
        super().__init__()
        self.base = base
        self.register_buffer("opens", opens, persistent=False)
        self.register_buffer("closes", closes, persistent=False)
        zeros = torch.zeros(len(opens), knots, 6)
        self.twist = nn.Parameter(zeros if start is None else start.clone())

    def pose(
        self, time: Float[Tensor, "*b"], track: Int64[Tensor, "*b"]
    ) -> Float[Tensor, "*b 3 4"]:
        """World-from-camera, with the learned motion."""
        segments = self.twist.shape[1] - 3
        opens, closes = self.opens[track], self.closes[track]
        u = ((time - opens) / (closes - opens)).clamp(0, 1) * segments
        return self._corrected(time, track, u)
