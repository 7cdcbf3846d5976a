"""Columns of events on disk: what captures and recordings both read and write."""

from sharpfield.storage.event_file import EventFile
from sharpfield.storage.event_formats import exporting_events
from sharpfield.storage.event_layouts import open_events
from sharpfield.storage.event_writer import EventWriter, write_events, writing_events
from sharpfield.storage.evt_writer import EvtWriter, writing_evt

__all__ = [
    "EventFile",
    "EventWriter",
    "EvtWriter",
    "exporting_events",
    "open_events",
    "write_events",
    "writing_events",
    "writing_evt",
]
