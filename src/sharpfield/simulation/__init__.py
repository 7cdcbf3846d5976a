"""Make captures with known truth: scenes, camera paths, blurry frames and events."""

from sharpfield.simulation.blur import Exposing, FrameSensor, decode, encode, store
from sharpfield.simulation.bodies import Bodies
from sharpfield.simulation.cameras import Carried, Standing, Views, hand_held, ring, ring_pose
from sharpfield.simulation.event_sensor import SENSORS, EventSensor
from sharpfield.simulation.events import EventPixels, watch
from sharpfield.simulation.flow import depth_and_flow
from sharpfield.simulation.footage import (
    Footage,
    folder_footage,
    simulate_footage,
    video_footage,
)
from sharpfield.simulation.motion import MOTIONS, CameraPath, Motion, motion, stamped
from sharpfield.simulation.moving_scenes import MOVING_SCENES, moving_scene
from sharpfield.simulation.scenes import SCENES, Scene, scene
from sharpfield.simulation.simulate import Rig, Timing, pictures, simulate, view
from sharpfield.simulation.simulate_moving import MOVING_RIG, MOVING_TIMING, simulate_moving

__all__ = [
    "MOTIONS",
    "MOVING_RIG",
    "MOVING_SCENES",
    "MOVING_TIMING",
    "SCENES",
    "SENSORS",
    "Bodies",
    "CameraPath",
    "Carried",
    "EventPixels",
    "EventSensor",
    "Exposing",
    "Footage",
    "FrameSensor",
    "Motion",
    "Rig",
    "Scene",
    "Standing",
    "Timing",
    "Views",
    "decode",
    "depth_and_flow",
    "encode",
    "folder_footage",
    "hand_held",
    "motion",
    "moving_scene",
    "pictures",
    "ring",
    "ring_pose",
    "scene",
    "simulate",
    "simulate_footage",
    "simulate_moving",
    "stamped",
    "store",
    "video_footage",
    "view",
    "watch",
]
