"""Make captures with known truth: scenes, camera paths, blurry frames and events."""

from typing import TYPE_CHECKING

from sharpfield._lazy import lazily

if TYPE_CHECKING:
    from sharpfield.simulation.footage import folder_footage as folder_footage
    from sharpfield.simulation.footage import simulate_footage as simulate_footage
    from sharpfield.simulation.footage import video_footage as video_footage
    from sharpfield.simulation.sensors.event_pixels import SENSORS as SENSORS
    from sharpfield.simulation.sensors.event_pixels import EventSensor as EventSensor
    from sharpfield.simulation.sensors.events import events_of as events  # noqa: F401
    from sharpfield.simulation.sensors.frames import FrameSensor as FrameSensor
    from sharpfield.simulation.static_capture import Rig as Rig
    from sharpfield.simulation.static_capture import Timing as Timing

__getattr__, __dir__ = lazily(__name__, __file__, check_shapes=True)
