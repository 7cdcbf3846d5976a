"""The types that flow from a recording to a rendered image."""

from typing import TYPE_CHECKING

from sharpfield._lazy import lazily

if TYPE_CHECKING:
    from sharpfield.core.camera import Camera as Camera
    from sharpfield.core.capture import Capture as Capture
    from sharpfield.core.capture import Clock as Clock
    from sharpfield.core.capture import Known as Known
    from sharpfield.core.capture import Split as Split
    from sharpfield.core.capture import Thresholds as Thresholds
    from sharpfield.core.errors import CaptureError as CaptureError
    from sharpfield.core.errors import OptionError as OptionError
    from sharpfield.core.errors import RunError as RunError
    from sharpfield.core.errors import ShapeError as ShapeError
    from sharpfield.core.errors import SharpfieldError as SharpfieldError
    from sharpfield.core.events import EventStream as EventStream
    from sharpfield.core.frames import DepthMaps as DepthMaps
    from sharpfield.core.frames import Exposure as Exposure
    from sharpfield.core.frames import Frames as Frames
    from sharpfield.core.rays import Radiance as Radiance
    from sharpfield.core.rays import Rays as Rays
    from sharpfield.core.rays import Views as Views

__getattr__, __dir__ = lazily(__name__, __file__)
