"""Adapters: what an interface of python-can needs is said where it is missing, and what is here is found."""

from __future__ import annotations

import sys
import types

import can
import pytest

from canprobe.errors import InterfaceError, UsageError
from canprobe.fieldbus import MonotonicClock, open_port
from canprobe.fieldbus.bus.real import adapters
from canprobe.fieldbus.bus.real.adapters import (
    BACKENDS,
    Backend,
    backend_channel,
    check_interface_name,
    find_adapters,
    missing_here,
)
from canprobe.fieldbus.bus.real.link import LinkState


def lacking(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without any package, library or kernel interface."""
    monkeypatch.setattr(adapters.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(adapters.ctypes.util, "find_library", lambda name: None)
    monkeypatch.setattr(adapters, "has_socketcan", lambda: False)


def test_the_table_names_interfaces_of_python_can_and_its_extras():
    from importlib.metadata import distribution

    assert set(BACKENDS) <= set(can.VALID_INTERFACES)
    extras = set(distribution("python-can").metadata.get_all("Provides-Extra") or ())
    assert {backend.extra for backend in BACKENDS.values() if backend.extra} <= extras


def test_the_table_has_the_bit_rates_of_python_can():
    """python-can sets a PCAN to 500 kbit/s where it does not know the rate, so that an unknown one must be refused."""
    from can.interfaces.pcan.basic import PCAN_BITRATES
    from can.interfaces.seeedstudio.seeedstudio import SeeedBus
    from can.interfaces.slcan import slcanBus

    known = {"pcan": PCAN_BITRATES, "slcan": slcanBus._BITRATES, "seeedstudio": SeeedBus.BITRATE}
    for name, backend in BACKENDS.items():
        assert {rate / 1000 for rate in known.get(name, ())} == set(backend.bitrates_kbit)
    with pytest.raises(UsageError, match=r"PCAN_USBBUS1: pcan has no bit rate of 444 kbit/s, only 1000, 800, 500"):
        open_port("pcan", "PCAN_USBBUS1", 444_000, MonotonicClock())


@pytest.mark.parametrize(("name", "has"), [(name, one.features) for name, one in BACKENDS.items() if not one.indexed])
def test_can_fd_is_asked_for_as_an_interface_takes_it(name, has, monkeypatch):
    given = {}
    monkeypatch.setattr(can, "Bus", lambda **options: given.update(options))
    if name == "socketcan":
        return  # a port of our own
    if not has & {"fd", "fd-timing"}:
        with pytest.raises(UsageError, match=f"{name} has no CAN FD in python-can"):
            open_port(name, "x", 500_000, MonotonicClock(), data_bitrate=2_000_000)
        return
    open_port(name, "x", 500_000, MonotonicClock(), data_bitrate=2_000_000)
    if "fd" in has:
        assert (given["fd"], given["data_bitrate"]) == (True, 2_000_000)
    else:
        assert (given["timing"].nom_bitrate, given["timing"].data_bitrate) == (500_000, 2_000_000)


@pytest.mark.parametrize(
    "name", [name for name, one in BACKENDS.items() if one.package or one.library or one.windows_only]
)
def test_a_port_that_cannot_be_opened_says_what_is_missing(name, monkeypatch):
    lacking(monkeypatch)
    monkeypatch.setattr(can, "Bus", lambda **_: exec("raise NameError('canGetNumberOfChannels')"))
    backend = BACKENDS[name]
    with pytest.raises(InterfaceError) as caught:
        open_port(name, backend.example, 500_000, MonotonicClock())
    said = str(caught.value)
    assert said.startswith(f"{backend.example}: {name} cannot be opened: ") and "NameError" not in said
    if backend.package:
        assert f"install 'python-can[{backend.extra}]'" in said
    if backend.driver:
        assert backend.driver in said
    assert said.endswith("`canprobe adapters` shows what works here")


def test_where_nothing_is_missing_the_form_of_a_channel_is_said(monkeypatch):
    monkeypatch.setattr(adapters.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(can, "Bus", lambda **_: exec("raise OSError('no such port')"))
    with pytest.raises(InterfaceError, match=r"--channel takes a serial port, such as /dev/ttyACM0; .*no such port"):
        open_port("slcan", "can0", 500_000, MonotonicClock())


def test_a_channel_by_number_is_given_as_one(monkeypatch):
    given = {}
    monkeypatch.setattr(can, "Bus", lambda **options: given.update(options))
    open_port("gs_usb", "1", 500_000, MonotonicClock())
    assert given["channel"] == 1 and isinstance(given["channel"], int)
    assert backend_channel("pcan", "PCAN_USBBUS1") == "PCAN_USBBUS1" and backend_channel("vector", "0") == "0"


@pytest.mark.parametrize("name", [name for name, one in BACKENDS.items() if one.indexed])
def test_a_name_in_the_place_of_a_number_is_wrong_usage(name):
    with pytest.raises(UsageError, match=f"{name}: its channels are numbers: expected --channel [01], .*, got can0"):
        open_port(name, "can0", 500_000, MonotonicClock())


@pytest.mark.parametrize(("name", "own", "meant"), [("dirct", ("direct",), "direct"), ("socketcam", (), "socketcan")])
def test_an_unknown_interface_is_named_as_what_was_meant(name, own, meant):
    with pytest.raises(UsageError, match=f"no interface '{name}'; did you mean {meant}") as caught:
        check_interface_name(name, own)
    assert all(one in str(caught.value) for one in own)
    check_interface_name(meant, own)


@pytest.mark.parametrize("name", ["can0", "vcan0", "slcan1"])
def test_a_channel_in_the_place_of_an_interface_is_told_with_the_line_to_type(name):
    with pytest.raises(UsageError, match=f"name both: --bus socketcan --channel {name}$"):
        check_interface_name(name)


def test_interfaces_of_the_kernel_are_found_with_their_state_and_line(tmp_path, monkeypatch):
    for name, number in (("can0", 280), ("can1", 280), ("vcan0", 280), ("eth0", 1)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{number}\n")
    links = {
        "can0": LinkState("can0", kind="can", bitrate=500_000, state="ERROR-ACTIVE"),
        "can1": LinkState("can1", kind="can", is_up=False, bitrate=250_000),
        "vcan0": LinkState("vcan0", kind="vcan"),
    }
    lacking(monkeypatch)
    monkeypatch.setattr(adapters, "has_socketcan", lambda: True)
    monkeypatch.setattr(adapters, "_NET_FOLDER", tmp_path)
    monkeypatch.setattr(adapters, "_DEVICE_FOLDER", tmp_path)
    monkeypatch.setattr(adapters, "read_link", links.get)
    found = {one.channel: one for one in find_adapters()}
    assert set(found) == {"can0", "can1", "vcan0"}
    assert found["can0"].is_up and found["can0"].state == "up, 500000 bit/s, ERROR-ACTIVE"
    assert found["can0"].type_next == "canprobe scan --bus socketcan --channel can0"
    assert not found["can1"].is_up and "ip link set can1 type can bitrate 250000" in found["can1"].type_next
    assert found["vcan0"].state == "up, vcan"
    assert missing_here("socketcan") == ()


def test_serial_ports_and_a_kernel_without_can_say_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "ttyACM0").touch()
    lacking(monkeypatch)
    monkeypatch.setattr(adapters, "_DEVICE_FOLDER", tmp_path)
    (port,) = find_adapters()
    assert (port.interface, port.channel, port.is_up) == ("slcan", str(tmp_path / "ttyACM0"), False)
    assert "install 'python-can[serial]'" in port.type_next
    assert "canprobe vcan -- COMMAND" in missing_here("socketcan")[0]


def test_serial_ports_of_windows_are_those_that_pyserial_lists(monkeypatch):
    ports = types.SimpleNamespace(comports=lambda: [types.SimpleNamespace(device="COM7")])
    monkeypatch.setattr(adapters, "has_socketcan", lambda: False)
    monkeypatch.setattr(adapters.importlib.util, "find_spec", lambda name: object() if name == "serial" else None)
    monkeypatch.setitem(sys.modules, "serial.tools.list_ports", ports)
    monkeypatch.setattr(adapters, "_detected", list)
    monkeypatch.setattr(sys, "platform", "win32")
    assert [(port.channel, port.type_next) for port in find_adapters()] == [
        ("COM7", "canprobe scan --bus slcan --channel COM7")
    ]


def test_a_kernel_driver_is_named_only_where_there_is_one(monkeypatch):
    lacking(monkeypatch)
    monkeypatch.setattr(sys, "platform", "linux")
    assert "peak_usb" in BACKENDS["pcan"].missing[-1] and len(BACKENDS["vector"].missing) == 1
    monkeypatch.setattr(sys, "platform", "win32")
    assert BACKENDS["usb2can"].missing == () and len(BACKENDS["pcan"].missing) == 1
    assert Backend("none", "any", "x").missing == ()
