"""Before training: make the most of a recording."""

from sharpfield.formation.event_motion import EventMotion
from sharpfield.preparation.deblur import DeblurOptions, Deblurred, deblur
from sharpfield.preparation.deblur_report import deblur_to
from sharpfield.preparation.thresholds import Found, find_thresholds

__all__ = [
    "DeblurOptions",
    "Deblurred",
    "EventMotion",
    "Found",
    "deblur",
    "deblur_to",
    "find_thresholds",
]
