"""The example for an arm of Universal Robots: ur_rtde, against a controller in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import patience_s

from canprobe.mechanics.robot.denavit_hartenberg import tool_z_offset

pytestmark = pytest.mark.skipif(
    sys.version_info >= (3, 13) and find_spec("rtde_control") is None, reason="ur-rtde has no wheel for this Python"
)
ROOT = Path(__file__).parents[3]
CLOCK_S = 86_400.0
START = "0.5", "0", "0.4", "3.141592653589793", "0", "0"


class Controller:
    """The process, and what it has said so far."""

    def __init__(self, *arguments: str) -> None:
        number = os.getpid()
        self.host = f"127.{100 + number // 62_500 % 100}.{number // 250 % 250}.{number % 250 + 1}"
        program = ROOT / "tests" / "support" / "ur_controller.py"
        line = [sys.executable, str(program), self.host, *arguments]
        self.process = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
        self.next("ready")

    def next(self, event: str) -> dict[str, Any]:
        """The next event of a kind."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            said: dict[str, Any] = json.loads(line)
            if said["event"] == event:
                return said
        raise AssertionError(f"the controller has ended without {event!r}")


@pytest.fixture
def controller() -> Iterator[Controller]:
    one = Controller("--version", "3.15", "--clock-s", str(CLOCK_S), "--at", *START)
    yield one
    one.process.kill()
    one.process.communicate()


@pytest.fixture
def ur_arm(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "example" / "arm"))
    from ur_arm import UrArm

    return UrArm


def brought_to(arm: Any, T: np.ndarray) -> float:
    """Command a pose as long as it takes; the distance that is left, m."""
    end_s = time.monotonic() + patience_s(10.0)
    while True:
        arm.command(T)
        left = float(np.abs(arm.read()[0] - T).max())
        if left < 1e-5 or time.monotonic() > end_s:
            return left
        time.sleep(0.008)


def test_the_flange_goes_where_it_is_sent_and_every_way_out_stops_it(controller: Controller, ur_arm: Any) -> None:
    class LeftError(Exception):
        pass

    with pytest.raises(LeftError), ur_arm(controller.host, silence_s=20.0, rate_hz=125.0) as arm:
        assert controller.next("tcp")["pose"] == [0.0] * 6, "its poses are those of the flange"
        start, t_ns = arm.read()
        assert 1e-9 * t_ns > CLOCK_S, "the controller's clock, which is not that of the cell"
        target = start @ tool_z_offset(10.0)
        target[:3, :3] = target[:3, :3] @ np.array(((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
        assert brought_to(arm, target) < 1e-5
        assert controller.next("watchdog")["longest_s"] == pytest.approx(20.0)
        assert arm.read()[1] > t_ns
        raise LeftError
    stopped = controller.next("servo stop")
    assert stopped["flange"][:3] == pytest.approx(target[:3, 3].tolist(), abs=1e-4)
    assert controller.next("end")["why"] == "stop"


def test_the_controller_stops_the_arm_where_no_command_comes(controller: Controller, ur_arm: Any) -> None:
    with ur_arm(controller.host, silence_s=0.3, rate_hz=125.0) as arm:
        T, _ = arm.read()
        far = T.copy()
        far[2, 3] += 0.2
        arm.command(far)
        assert controller.next("end")["why"] == "watchdog"
        with pytest.raises(ConnectionError, match="program has ended"):
            for _ in range(100):  # until the controller's next package says so
                arm.command(far)
                time.sleep(0.008)
        arm.stop()
