"""Pure functions of poses and space."""

from typing import TYPE_CHECKING

from sharpfield._lazy import lazily

if TYPE_CHECKING:
    from sharpfield.geometry import se3 as se3
    from sharpfield.geometry.trajectory import BSpline as BSpline
    from sharpfield.geometry.trajectory import Stamped as Stamped
    from sharpfield.geometry.trajectory import Still as Still

__getattr__, __dir__ = lazily(__name__, __file__)
