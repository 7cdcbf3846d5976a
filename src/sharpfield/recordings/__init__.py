"""A camera's own files, one module per format, opened without being loaded."""

from sharpfield.recordings.recording import Frame, Recording, Triggers, Trouble

__all__ = ["Frame", "Recording", "Triggers", "Trouble"]
