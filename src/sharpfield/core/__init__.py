"""The nouns of the house: what flows from a recording to a rendered picture."""

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Split
from sharpfield.core.depth import DepthMaps
from sharpfield.core.errors import (
    CaptureError,
    MissingExtra,
    OptionError,
    RunError,
    ShapeError,
    SharpfieldError,
)
from sharpfield.core.events import EventStream, SiteColour, merged
from sharpfield.core.exposure import Exposure
from sharpfield.core.frames import Frames
from sharpfield.core.growth import Growth
from sharpfield.core.measurements import Batch, EventPairs, Instants, Pixels
from sharpfield.core.paper import Paper
from sharpfield.core.protocols import (
    Field,
    Formation,
    Growing,
    Head,
    Model,
    PointSet,
    Recipe,
    Renderer,
    Trajectory,
)
from sharpfield.core.radiance import Radiance, Samples
from sharpfield.core.rays import Rays
from sharpfield.core.schedule import Group, Schedule
from sharpfield.core.struct import Struct
from sharpfield.core.views import Views

__all__ = [
    "Batch",
    "Camera",
    "Capture",
    "CaptureError",
    "Clock",
    "DepthMaps",
    "EventPairs",
    "EventStream",
    "Exposure",
    "Field",
    "Formation",
    "Frames",
    "Group",
    "Growing",
    "Growth",
    "Head",
    "Instants",
    "MissingExtra",
    "Model",
    "OptionError",
    "Paper",
    "Pixels",
    "PointSet",
    "Radiance",
    "Rays",
    "Recipe",
    "Renderer",
    "RunError",
    "Samples",
    "Schedule",
    "ShapeError",
    "SharpfieldError",
    "SiteColour",
    "Split",
    "Struct",
    "Trajectory",
    "Views",
    "merged",
]
