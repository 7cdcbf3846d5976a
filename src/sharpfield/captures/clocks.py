"""Do the clocks of a capture agree? A wrong unit of time is the commonest mistake of all."""

from sharpfield.core.errors import CaptureError

THOUSAND = (300.0, 3000.0)
"""A ratio of two durations in here is taken for a factor of 1000 between their units."""


def expect_overlap(
    events_us: tuple[int, int], known_us: tuple[int, int], *, where: object, known: str, do: str
) -> None:
    """Make sure that events happened while poses or frames were taken.

    Args:
        events_us: Times of the first and the last event.
        known_us: First and last time of the other clock.
        where: The file of events.
        known: What the other clock belongs to, e.g. "poses".
        do: How to say another unit.

    Raises:
        CaptureError: The two hardly overlap, or one lasts about 1000 times as long as the other.
    """
    lasts, expected = (max(span[1] - span[0], 1) for span in (events_us, known_us))
    common = min(events_us[1], known_us[1]) - max(events_us[0], known_us[0])
    hint = _hint(lasts / expected) or _hint(max(events_us[1], 1) / max(known_us[1], 1))
    if common >= 0 and not _hint(lasts / expected):
        return
    raise CaptureError(
        f"events and {known} were not taken at the same time",
        where=where,
        got=f"events from {events_us[0]} to {events_us[1]} us,"
        f" {known} from {known_us[0]} to {known_us[1]} us",
        do=f"{hint}: {do}" if hint else f"check that both count from the same instant; {do}",
    )


def _hint(ratio: float) -> str:
    if THOUSAND[0] < ratio < THOUSAND[1]:
        return "event times look like ns where us were expected"
    if THOUSAND[0] < 1 / ratio < THOUSAND[1]:
        return "event times look like us where ns were expected"
    return ""
