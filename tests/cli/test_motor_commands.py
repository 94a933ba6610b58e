"""Motors on the command line, as far as it goes without a bus."""

from __future__ import annotations

import json

import pytest

from canprobe.cell.session import served
from canprobe.cli import main


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
    assert of_motors == ["brown-out", "over-temperature", "over-voltage", "under-voltage"]
