import os
import signal

import pytest

from sharpfield.training.session import Stop


def test_nothing_asks_to_stop_by_itself():
    with Stop() as stop:
        assert stop.reason == "" and stop.seconds_left == float("inf")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_interrupt_is_noted_and_the_second_acts(number: signal.Signals):
    acted = []
    earlier = signal.signal(number, lambda *_: acted.append(number))
    try:
        with Stop() as stop:
            os.kill(os.getpid(), number)
            assert stop.reason == f"interrupted by {number.name}" and not acted
            os.kill(os.getpid(), number)
            assert acted == [number]
    finally:
        signal.signal(number, earlier)


def test_handlers_are_given_back():
    before = signal.getsignal(signal.SIGTERM)
    with Stop():
        assert signal.getsignal(signal.SIGTERM) != before
    assert signal.getsignal(signal.SIGTERM) == before


def test_time_runs_out():
    assert Stop(minutes=1.0).reason == "" and 59 < Stop(minutes=1.0).seconds_left <= 60
    assert Stop(minutes=0.0).reason == "the time is up"
