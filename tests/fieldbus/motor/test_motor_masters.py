"""Masters that others wrote, unchanged, against emulated motors in real time, on python-can's bus `virtual`.

damiao-motor comes from PyPI with a web server, which nothing here needs, so it is not among the packages of the tests:
`pip install --no-deps damiao-motor==1.0.6` beside them runs what else is skipped.
"""

from __future__ import annotations

import time

import can
import pytest

from canprobe.fieldbus.motor.damiao import DamiaoMotor
from canprobe.fieldbus.motor.protocol import SPECIAL, TYPES, Feedback, MitCommand, MotorStatus
from canprobe.fieldbus.tools.emulated_bus import ServedBus
from canprobe.fieldbus.tools.faults.motor_faults import FaultyMotor

PATIENCE_S = 10.0


@pytest.fixture
def motors(tmp_path):
    """Motor 1, a DM4310, and motor 3, a DM4340, served on the channel that is named after the test's folder."""
    made = [DamiaoMotor("dm4310", 1, 0x11), DamiaoMotor("dm4340", 3, 0x13)]
    with ServedBus("virtual", str(tmp_path), 1_000_000, tmp_path / "bus.log") as bus:
        bus.power_on([FaultyMotor(motor) for motor in made])
        yield made


def waited_for(what, does=lambda: None):
    """What a function returns as soon as it is true, with an action before each look."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        does()
        if found := what():
            return found
        time.sleep(0.005)
    raise AssertionError(f"not within {PATIENCE_S} s")


def test_frames_by_hand_with_python_can(motors, tmp_path):
    with can.Bus(interface="virtual", channel=str(tmp_path)) as bus:
        for data in (SPECIAL + b"\xfc", MitCommand(p=0.3, kp=100, kd=2).pack(TYPES["dm4310"])):
            bus.send(can.Message(arbitration_id=1, data=data, is_extended_id=False))
            answer = bus.recv(PATIENCE_S)
            assert answer is not None
            assert answer.arbitration_id == 0x11
            assert Feedback.unpack(bytes(answer.data), TYPES["dm4310"]).status == MotorStatus.ENABLED


@pytest.fixture
def driver(motors, tmp_path):
    package = pytest.importorskip("damiao_motor", reason="damiao-motor is not at hand, see above")
    controller = package.DaMiaoController(str(tmp_path), "virtual")
    yield controller.add_motor(1, 0x11, "4310"), controller.add_motor(3, 0x13, "4340")
    controller.shutdown()


needs_bustype = pytest.mark.filterwarnings("ignore:.*bustype.*")


@needs_bustype
def test_damiao_motor_finds_its_ranges_in_the_registers_and_moves_a_joint(driver, motors):
    small, large = driver
    for one, name in ((small, "dm4310"), (large, "dm4340")):
        assert tuple(one.get_register(rid, PATIENCE_S) for rid in (21, 22, 23)) == TYPES[name][:3]
        one.enable()
        waited_for(lambda one=one: one.get_states().get("status") == "ENABLED")
    waited_for(
        lambda: abs(small.get_states()["pos"] - 0.4) < 5e-3,
        lambda: small.send_cmd_mit(0.4, 0.0, 50.0, 1.0, 0.0),
    )
    assert abs(motors[0].joint.q - 0.4) < 5e-3
    assert motors[1].joint.q == 0.0
