"""Motors on the command line, as far as it goes without a bus."""

from __future__ import annotations

import json

import pytest

from canprobe.cell.session import bus_tools, served
from canprobe.cli import main
from canprobe.fieldbus import LockstepBus, VirtualClock
from canprobe.fieldbus.motor.damiao import DamiaoMotor
from canprobe.fieldbus.motor.protocol import SPECIAL, TYPES, MitCommand, RegisterOp, Rid, pack_register


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("--motor damiao:4310 --id 1", "did you mean damiao:dm4310?"),
        ("--motor damiao:dm4310", "1 --motor, 0 --id"),
        ("--motor damiao:dm4310 --id 1 --motor damiao:dm4310 --id 2 --mst-id 0x12", "all of them an --mst-id or none"),
        ("--motor damiao:dm4310 --id 0", "from 1 to 127"),
        ("--motor damiao:dm4310 --id 1 --mst-id 0x800", "an identifier such as 0x11, got '0x800'"),
        ("--motor damiao:dm4310 --id 1 --eds puma260_joint --node-id 5", "is NMT; give --mst-id 0x11"),
        ("--motor damiao:dm4310 --id 5 --mst-id 0x11 --eds puma260_joint --node-id 5", "another device hears 205h"),
        ("--motor damiao:dm4310 --id 1 --seed 3", "--seed belongs to a scene, not to --motor"),
        ("free --id 1", "--id belongs to --motor"),
        ("free --motor damiao:dm4310 --id 1", "name a SCENE, or else"),
    ],
)
def test_emulate_says_what_is_wrong_with_a_motor(line, message, capsys):
    assert main(["emulate", *line.split(), "--channel", "vcan0"]) == 2
    assert message in capsys.readouterr().err


def test_emulate_serves_motors_and_nodes_on_one_channel(monkeypatch):
    calls = []
    monkeypatch.setattr(served, "emulate_eds", lambda files, target, **named: calls.append((files, named["motors"])))
    motors = "--motor damiao:dm4310 --id 1 --mst-id 0x11 --motor damiao:dm8009 --id 2 --mst-id 18"
    assert main(["emulate", *motors.split(), "--eds", "puma260_joint", "--node-id", "5", "--channel", "vcan0"]) == 0
    assert calls == [([("puma260_joint", 5)], (["damiao:dm4310", "damiao:dm8009"], [1, 2], [0x11, 18]))]


def test_inject_lists_the_faults_of_motors_once(capsys):
    assert main(["inject", "--list", "--json"]) == 0
    kinds = json.loads(capsys.readouterr().out)
    names = [kind["name"] for kind in kinds]
    assert len(names) == len(set(names))
    of_motors = [kind["name"] for kind in kinds if kind["needs"] == "motor"]
    limits = ["over-temperature", "over-voltage", "under-voltage"]
    assert of_motors == ["brown-out", *limits, "watchdog-trip", "wrong-range", "encoder-wrap"]


@pytest.mark.parametrize(("first", "status"), [(0.3, 0), (0.0, 1)])
def test_a_log_of_a_master_is_judged(first, status, tmp_path, capsys):
    motor, log, lines = DamiaoMotor("dm4310", 1, 0x11, q=0.3), tmp_path / "candump.log", []
    timeout = pack_register(1, RegisterOp.WRITE, Rid.TIMEOUT, (300).to_bytes(4, "little"))
    held = MitCommand(first, kp=50.0, kd=1.0).pack(TYPES["dm4310"])
    sent = [(0x7FF, timeout), (1, SPECIAL + b"\xfd"), (1, SPECIAL + b"\xfc"), *[(1, held)] * 5]
    for cycle, frame in enumerate(sent, 1):
        for can_id, data in (frame, *motor.receive(*frame, cycle * 5_000_000)):
            lines.append(f"({cycle * 5e-3:.6f}) can0 {can_id:03X}#{data.hex().upper()}\n")
    log.write_text("".join(lines))
    judge = ["judge", "--motor", "damiao:dm4310", "--id", "1", "--mst-id", "0x11", "--record", str(log)]
    assert main(judge) == status
    assert ("with kp 50 at 0.300 rad: 15.0 N·m" in capsys.readouterr().out) == bool(status)
    assert main([*judge[:-3], "0x12", *judge[-2:]]) == 2
    assert "no answer of a motor with this --id and --mst-id" in capsys.readouterr().err


def test_the_command_prints_a_row_a_motor(monkeypatch, capsys):
    bus = LockstepBus(VirtualClock())
    for motor in (DamiaoMotor("dm4310", 1), DamiaoMotor("dm4310", 1), DamiaoMotor("dm4340", 2, 0x12)):
        bus.attach(motor)
    found = bus_tools.scan(bus.port(), motors=True)
    monkeypatch.setattr(bus_tools, "scan", lambda *_, motors, **__: found if motors else [])
    assert main(["scan", "--motors", "--channel", "can0"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[1].split() == ["1", "000h", "12.5", "30", "10", "dm4310", "off", "MIT"]
    assert out[2].split() == ["2", "012h", "12.5", "10", "28", "dm4340", "or", "dm4340_48v", "off", "MIT"]
    assert out[3] == "motor 1: 2 answer with this id; leave one on the bus, and change it"
    assert main(["scan", "--motors", "--lss", "--channel", "can0"]) == 2
