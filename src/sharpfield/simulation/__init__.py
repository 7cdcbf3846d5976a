"""Make captures with known truth: scenes, camera paths, blurry frames and events."""

from sharpfield.simulation.blur import Exposing, FrameSensor, encode, store
from sharpfield.simulation.event_sensor import SENSORS, EventSensor
from sharpfield.simulation.events import EventPixels, watch
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
    "FrameSensor",
    "Motion",
    "Rig",
    "Scene",
    "Timing",
    "encode",
    "motion",
    "pictures",
    "scene",
    "simulate",
    "stamped",
    "store",
    "view",
    "watch",
]
