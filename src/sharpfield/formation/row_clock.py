"""Events on the clock of a rolling shutter.

Each row of a frame opens and closes a little later than the one above. On a clock that is late by
as much for each row, all rows are exposed at the same time again, and whatever compares frames and
events of a pixel works as if the shutter were global.
"""

from dataclasses import replace

import numpy as np

from sharpfield.core.events import EventStream


def on_row_clock(events: EventStream, row_delay_us: float) -> EventStream:
    """The same events, each as much earlier as its row is read later, in order of these times.

    Args:
        events: Of pixels of the frames.
        row_delay_us: From one row to the next.
    """
    if row_delay_us == 0 or not len(events):
        return events
    late = np.rint(np.asarray(events.y, np.float64) * row_delay_us).astype(np.int64)
    t_us = np.asarray(events.t_us) - late
    order = np.argsort(t_us, kind="stable")
    return replace(
        events,
        x=events.x[order],
        y=events.y[order],
        t_us=t_us[order],
        p=events.p[order],
        track=None if events.track is None else events.track[order],
    )
