"""A camera's own files, one module per format, opened without being loaded."""

from sharpfield.recordings.open import FORMATS, Format, Told, open_events, open_recording
from sharpfield.recordings.recording import Frame, Recording, Triggers, Trouble

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
]
