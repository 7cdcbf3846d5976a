"""When to end training early, between two steps: a signal, or time that is up."""

import signal
import threading
import time
from types import FrameType, TracebackType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """While open, turns the first interrupt into a request to end after the step under way.

    A second interrupt ends the program at once, as it would without this.
    """

    def __init__(self, *, minutes: float | None = None) -> None:
        """Allow `minutes` from now; None for as long as it takes."""
        self.deadline = None if minutes is None else time.monotonic() + 60 * minutes
        self.interrupted = ""
        self.earlier: dict[int, Any] = {}

    def __enter__(self) -> "Stop":
        if threading.current_thread() is threading.main_thread():
            self.earlier = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._give_back()

    @property
    def reason(self) -> str:
        """Why training should end now; empty if it should not."""
        if self.interrupted:
            return self.interrupted
        return "the time is up" if self.seconds_left <= 0 else ""

    @property
    def seconds_left(self) -> float:
        """Until the time is up."""
        return float("inf") if self.deadline is None else self.deadline - time.monotonic()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.interrupted = f"interrupted by {signal.Signals(number).name}"
        self._give_back()

    def _give_back(self) -> None:
        for number, handler in self.earlier.items():
            signal.signal(number, handler)
        self.earlier = {}
