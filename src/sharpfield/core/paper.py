"""The publication that a recipe implements, and where the recipe departs from it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Paper:
    """A publication behind a recipe."""

    key: str
    """BibTeX key, e.g. `cannici2024evdeblurnerf`."""
    title: str
    bibtex: str
    departures: tuple[str, ...] = ()
    """Each known departure from the published code, in words, with the reason."""
