"""Make captures with known truth: scenes, camera paths, blurry frames and events."""

from sharpfield.simulation.blur import Exposing, FrameSensor, decode, encode, store
from sharpfield.simulation.bodies import Bodies
from sharpfield.simulation.cameras import Carried, Standing, Views, hand_held, ring, ring_pose
from sharpfield.simulation.depth_sensor import DepthSensor
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
from sharpfield.simulation.motion_kernel import (
    DrawnBlur,
    KernelRange,
    blurred,
    drawn_blur,
    motion_kernel,
)
from sharpfield.simulation.moving_scenes import MOVING_SCENES, moving_scene
from sharpfield.simulation.room import room
from sharpfield.simulation.scenes import SCENES, Scene, scene
from sharpfield.simulation.simulate import Rig, Timing, pictures, simulate, view
from sharpfield.simulation.simulate_moving import MOVING_RIG, MOVING_TIMING, simulate_moving
from sharpfield.simulation.simulate_room import (
    BLUR_NOTE,
    ROOM_RIG,
    RoomSensors,
    RoomTiming,
    simulate_room,
)
from sharpfield.simulation.travel import travel
from sharpfield.simulation.walk import Walk, walk

__all__ = [
    "DepthSensor",
    "BLUR_NOTE",
    "MOTIONS",
    "MOVING_RIG",
    "MOVING_SCENES",
    "MOVING_TIMING",
    "ROOM_RIG",
    "SCENES",
    "SENSORS",
    "Bodies",
    "CameraPath",
    "Carried",
    "DrawnBlur",
    "EventPixels",
    "EventSensor",
    "Exposing",
    "Footage",
    "FrameSensor",
    "KernelRange",
    "Motion",
    "Rig",
    "RoomSensors",
    "RoomTiming",
    "Scene",
    "Standing",
    "Timing",
    "Views",
    "Walk",
    "blurred",
    "decode",
    "depth_and_flow",
    "drawn_blur",
    "encode",
    "folder_footage",
    "hand_held",
    "motion",
    "motion_kernel",
    "moving_scene",
    "pictures",
    "ring",
    "ring_pose",
    "room",
    "scene",
    "simulate",
    "simulate_footage",
    "simulate_moving",
    "simulate_room",
    "stamped",
    "store",
    "travel",
    "video_footage",
    "view",
    "walk",
    "watch",
]
