"""Progress on the console."""

from rich.console import Console
from rich.progress import Progress, ProgressColumn


def progress_on(console: Console, *columns: ProgressColumn) -> Progress:
    """Bars that vanish when done, and are not there where nobody watches."""
    quiet = not console.is_terminal
    return Progress(*columns, console=console, transient=True, disable=quiet)
