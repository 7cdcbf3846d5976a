"""A camera's own files, one module per format, opened without being loaded."""

from sharpfield.recordings.aedat4_writer import write_aedat4
from sharpfield.recordings.open import FORMATS, Format, Told, open_events, open_recording
from sharpfield.recordings.recording import Frame, Recording, Triggers, Trouble
from sharpfield.recordings.ros1_bag_writer import write_ros1_bag

__all__ = [
    "FORMATS",
    "Format",
    "Frame",
    "Recording",
    "Told",
    "Triggers",
    "Trouble",
    "open_events",
    "open_recording",
    "write_aedat4",
    "write_ros1_bag",
]
