"""Progress on the console."""

from rich.console import Console
from rich.progress import Progress, ProgressColumn


def progress_on(console: Console, *columns: ProgressColumn) -> Progress:
    """Progress bars that vanish when done; disabled where the output is no terminal."""
    quiet = not console.is_terminal
    return Progress(*columns, console=console, transient=True, disable=quiet)
