"""The terminal as all commands use it."""

from rich.console import Console
from rich.progress import Progress, ProgressColumn


def screen() -> Console:
    """Where commands print; numbers in a text are not coloured."""
    return Console(highlight=False)


def progress_on(console: Console, *columns: ProgressColumn) -> Progress:
    """Bars that vanish when done, and are not there where nobody watches."""
    quiet = not console.is_terminal
    return Progress(*columns, console=console, transient=True, disable=quiet)
