"""Columns of events on disk: what captures and recordings both read and write."""

from sharpfield.storage.event_file import EventFile
from sharpfield.storage.event_formats import exporting_events
from sharpfield.storage.event_layouts import open_events
from sharpfield.storage.event_writer import EventWriter, write_events, writing_events

__all__ = [
    "EventFile",
    "EventWriter",
    "exporting_events",
    "open_events",
    "write_events",
    "writing_events",
]
