"""What a recipe implements, and where it differs from what its authors published."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Paper:
    """A publication behind a recipe."""

    key: str
    """BibTeX key, e.g. `cannici2024evdeblurnerf`."""
    title: str
    bibtex: str
    departures: tuple[str, ...] = ()
    """Each place where we knowingly differ from the published code, in words, with the reason."""
