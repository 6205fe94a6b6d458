"""Ctrl-C and SIGTERM."""

import signal

import pytest

from dds_lightning.console import interrupts
from dds_lightning.console.interrupts import Interrupted, caught, deferred, pending


@pytest.mark.parametrize(("signum", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_outside_a_training_a_signal_stops_at_once_with_the_status_shells_expect(signum, status):
    with caught(), pytest.raises(Interrupted) as stop:
        signal.raise_signal(signum)
    assert stop.value.code == status


def test_inside_a_training_the_first_signal_waits_and_a_later_one_does_not(monkeypatch):
    monkeypatch.setattr(interrupts, "TOGETHER", 0.0)
    with caught(), deferred():
        signal.raise_signal(signal.SIGTERM)
        assert pending() == signal.SIGTERM
        with pytest.raises(Interrupted) as stop:
            signal.raise_signal(signal.SIGINT)
    assert stop.value.signum == signal.SIGINT
    assert pending() is None


def test_a_signal_that_nobody_asked_about_stops_at_the_end():
    with caught(), pytest.raises(Interrupted), deferred():
        signal.raise_signal(signal.SIGINT)
    assert pending() is None


def test_the_handlers_of_before_are_restored():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with caught():
        assert signal.getsignal(signal.SIGINT) != before[0]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
