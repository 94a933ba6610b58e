"""SIGHUP as a terminal has it."""

import signal
from collections.abc import Iterator

import pytest


@pytest.fixture
def hangup_heard() -> Iterator[None]:
    """A test of what SIGHUP does passes under `nohup` too, which has it ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)
