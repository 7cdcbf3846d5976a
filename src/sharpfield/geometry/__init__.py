"""Pure functions of poses and space."""

from sharpfield.geometry.cast import cast
from sharpfield.geometry.shake import LearnedShake
from sharpfield.geometry.space import Frustum, Metric, Similarity, Space, ndc, normalisation
from sharpfield.geometry.trajectory import (
    BSpline,
    LearnedKnots,
    Moved,
    Stamped,
    Still,
    Tracks,
    check_poses,
    count_tracks,
)

__all__ = [
    "BSpline",
    "Frustum",
    "LearnedKnots",
    "LearnedShake",
    "Metric",
    "Moved",
    "Similarity",
    "Space",
    "Stamped",
    "Still",
    "Tracks",
    "cast",
    "check_poses",
    "count_tracks",
    "ndc",
    "normalisation",
]
