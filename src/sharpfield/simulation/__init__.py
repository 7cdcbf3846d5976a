"""Make captures with known truth: scenes, camera paths, blurry frames and events."""

from sharpfield.simulation.blur import Exposing, FrameSensor, decode, encode, store
from sharpfield.simulation.event_sensor import SENSORS, EventSensor
from sharpfield.simulation.events import EventPixels, watch
from sharpfield.simulation.footage import (
    Footage,
    folder_footage,
    simulate_footage,
    video_footage,
)
from sharpfield.simulation.motion import MOTIONS, Motion, motion, stamped
from sharpfield.simulation.scenes import SCENES, Scene, scene
from sharpfield.simulation.simulate import Rig, Timing, pictures, simulate, view

__all__ = [
    "MOTIONS",
    "SCENES",
    "SENSORS",
    "EventPixels",
    "EventSensor",
    "Exposing",
    "Footage",
    "FrameSensor",
    "Motion",
    "Rig",
    "Scene",
    "Timing",
    "decode",
    "encode",
    "folder_footage",
    "motion",
    "pictures",
    "scene",
    "simulate",
    "simulate_footage",
    "stamped",
    "store",
    "video_footage",
    "view",
    "watch",
]
