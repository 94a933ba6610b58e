"""Which bus a command takes: of its options, of the scene, of python-can's configuration."""

import json
import signal
import subprocess
import sys
from argparse import Namespace
from dataclasses import replace

import pytest
from network_buses import bare, group  # noqa: F401
from patience import patience_s

from canprobe.cell.scene.load import load_scene
from canprobe.cell.session.target import Target
from canprobe.cli import main
from canprobe.cli.target import target_of
from canprobe.errors import UsageError


def test_without_a_configuration_there_is_no_bus(bare, capsys):
    assert main(["run", "free", "--bus", "config", "--duration", "0.01"]) == 2
    assert "names no interface; set CAN_INTERFACE" in capsys.readouterr().err


@pytest.mark.realtime
def test_nodes_of_a_bus_yml_are_scanned_over_multicast(group, tmp_path, capsys):
    """Emulator and scan both find their bus in python-can's environment."""
    assert main(["plan", "listen", "--export", "bus.yml", "--out", str(tmp_path)]) == 0
    emulator = subprocess.Popen(
        [sys.executable, "-m", "canprobe", "emulate", "--bus-yml", str(tmp_path / "bus.yml")],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert emulator.stderr is not None and f"serving nodes 16 on {group}" in emulator.stderr.readline()
        capsys.readouterr()
        assert main(["scan", "--json"]) == 0
        (node,) = json.loads(capsys.readouterr().out)
        assert (node["node_id"], node["vendor_id"], node["product_code"]) == (16, 0xCA5E, 0x1616)
    finally:
        emulator.send_signal(signal.SIGINT)
        assert emulator.wait(patience_s(20)) == 0
        emulator.stderr.close()


def test_the_command_line_and_the_scene_come_before_the_configuration(bare, monkeypatch):
    """A scene whose nodes are all emulated stays in lockstep; one with real nodes takes what is configured."""
    monkeypatch.setenv("CAN_INTERFACE", "pcan")
    monkeypatch.setenv("CAN_CHANNEL", "PCAN_USBBUS1")
    monkeypatch.setenv("CAN_BITRATE", "500000")
    silent = Namespace(bus=None, channel=[], bitrate=None)
    scene = load_scene("free")
    real = replace(scene, arm=replace(scene.arm, emulated=False))
    named = replace(real, bus=replace(real.bus, interface="kvaser"))
    configured = Target("pcan", "PCAN_USBBUS1", 500_000)
    assert target_of(silent, scene) == Target("lockstep", "can0", 1_000_000)
    assert target_of(silent, real) == configured
    assert target_of(silent, named) == Target("kvaser", "can0", 1_000_000)
    assert target_of(Namespace(bus="config", channel=[], bitrate=None), scene) == configured
    assert target_of(Namespace(bus="config", channel=[(None, "X")], bitrate=250_000), scene) == Target(
        "pcan", "X", 250_000
    )
    assert target_of(Namespace(bus="slcan", channel=[], bitrate=None), real) == Target("slcan", "can0", 1_000_000)


def test_channels_of_a_scene_with_two_buses(bare):
    scene = load_scene("press")
    scene = replace(scene, sensor=replace(scene.sensor, channel="can1"))

    def target(*channels):
        return target_of(Namespace(bus="socketcan", channel=list(channels), bitrate=None), scene)

    assert target() == Target("socketcan", "can0", 1_000_000)
    assert target((None, "vcan0")) == Target("socketcan", "vcan0", 1_000_000)
    both = target(("can0", "a"), ("can1", "b"))
    assert both == Target("socketcan", "a", 1_000_000, {"can1": "b"})
    joint = replace(next(iter(scene.joints.values())), channel="can1")
    placed = both.applied_to(replace(scene, joints={**scene.joints, "shoulder": joint}))
    assert (placed.channels, placed.joints["shoulder"].channel) == (("a", "b"), "b")
    with pytest.raises(UsageError, match="no channel can2, only can0, can1; did you mean can1"):
        target(("can2", "x"))
    with pytest.raises(UsageError, match="given 2 times, but the scene has the channels can0 and can1"):
        target(("can0", "x"), (None, "y"))
