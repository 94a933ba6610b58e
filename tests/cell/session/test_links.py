"""How an interface is set, from what `ip` prints, and what is said about it. No interface is touched."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace

import pytest

import canprobe
import canprobe.cli
from canprobe.cell.session.links import ExpectedLink, check_link, check_links, expected_of
from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.port import ControllerState
from canprobe.fieldbus.bus.real.link import LinkState, parse_link, read_link, setting_line, sudo
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus

# iproute2 6.1 on a virtual interface
VCAN = """[{"ifindex":2,"ifname":"vcan0","flags":["NOARP","UP","LOWER_UP"],"mtu":72,"qdisc":"noqueue",
"operstate":"UNKNOWN","linkmode":"DEFAULT","group":"default","txqlen":1000,"link_type":"can","promiscuity":0,
"allmulti":0,"min_mtu":0,"max_mtu":0,"linkinfo":{"info_kind":"vcan"},"num_tx_queues":1,"stats64":{"rx":{"bytes":0,
"packets":0,"errors":0,"dropped":0,"over_errors":0,"multicast":0},"tx":{"bytes":0,"packets":0,"errors":0,"dropped":0,
"carrier_errors":0,"collisions":0}}}]"""
# a controller of an Allwinner chip that has heard two frames and 135 errors
PASSIVE = """[{"ifindex":3,"ifname":"can0","flags":["NOARP","UP","LOWER_UP","ECHO"],"mtu":16,"qdisc":"pfifo_fast",
"operstate":"UP","linkmode":"DEFAULT","group":"default","txqlen":100,"link_type":"can","promiscuity":0,"linkinfo":
{"info_kind":"can","info_data":{"state":"ERROR-PASSIVE","berr_counter":{"tx":0,"rx":135},"restart_ms":100,"bittiming":
{"bitrate":250000,"sample_point":0.875,"tq":250,"prop_seg":6,"phase_seg1":7,"phase_seg2":2,"sjw":1},"bittiming_const":
{"name":"sun4i_can","tseg1":{"min":1,"max":16},"tseg2":{"min":1,"max":8},"sjw":{"min":1,"max":4},"brp":{"min":1,
"max":64},"brp_inc":1},"clock":24000000},"info_xstats":{"restarts":0,"bus_error":2,"arbitration_lost":0,
"error_warning":1,"error_passive":1,"bus_off":0}},"num_tx_queues":1,"num_rx_queues":1}]"""
# a CAN FD adapter; an iproute2 that writes the sample point as text, and empty objects between the links
FD = """[{},{"ifname":"can1","flags":["NOARP","UP","ECHO"],"mtu":72,"txqlen":10,"link_type":"can","linkinfo":
{"info_kind":"can","info_data":{"ctrlmode":["FD","LISTEN-ONLY"],"state":"ERROR-ACTIVE","berr_counter":{"tx":0,"rx":0},
"restart_ms":0,"bittiming":{"bitrate":1000000,"sample_point":"0.750","tq":12},"data_bittiming":{"bitrate":8000000,
"sample_point":"0.700","tq":12},"clock":80000000}}}]"""
# an adapter with a table of fixed rates, which tells no sample point
FIXED = """[{"ifname":"can2","flags":["UP"],"txqlen":10,"linkinfo":{"info_kind":"can","info_data":
{"state":"ERROR-ACTIVE","restart_ms":0,"bittiming_bitrate":500000,"bitrate_const":[125000,500000]}}}]"""

GOOD = LinkState("can0", "can", True, 1000, 1_000_000, None, 0.8, 100, "ERROR-ACTIVE", 0, 0, (), 0)
EXPECTED = ExpectedLink(1_000_000, None, 16)


def test_what_ip_prints_is_read():
    assert parse_link(VCAN) == LinkState("vcan0", "vcan", tx_queue=1000)
    assert parse_link(PASSIVE) == LinkState(
        "can0", "can", True, 100, 250_000, None, 0.875, 100, "ERROR-PASSIVE", 0, 135, (), 0
    )
    assert parse_link(FD) == LinkState(
        "can1", "can", True, 10, 1_000_000, 8_000_000, 0.75, 0, "ERROR-ACTIVE", 0, 0, ("FD", "LISTEN-ONLY")
    )
    assert parse_link(FIXED) == LinkState(
        "can2", "can", tx_queue=10, bitrate=500_000, restart_ms=0, state="ERROR-ACTIVE"
    )


@pytest.mark.parametrize("text", ["", "{}", "[]", "[{}]", "[1]", "null", VCAN[:-1], "[" + VCAN[1:-1] + "," + VCAN[1:]])
def test_what_is_no_link_is_refused(text):
    with pytest.raises(ValueError):
        parse_link(text)


def test_strange_values_are_left_out():
    info = {"state": 3, "berr_counter": 7, "restart_ms": "soon", "bittiming": [], "ctrlmode": {}}
    text = json.dumps([{"ifname": "can0", "flags": None, "txqlen": None, "linkinfo": {"info_data": info}}])
    assert parse_link(text) == LinkState("can0", is_up=False)


def texts(link, expected=EXPECTED):
    return [(remark.is_error, remark.text) for remark in check_link(link, expected)]


def test_a_good_link_and_a_virtual_one_have_no_remarks():
    assert texts(GOOD) == []
    assert texts(parse_link(VCAN), ExpectedLink(125_000, 2_000_000, 5000)) == []
    assert texts(replace(GOOD, bitrate=None, sample_point=None, restart_ms=None, tx_queue=None, state=None)) == []


@pytest.mark.parametrize(
    ("change", "is_error", "words"),
    [
        ({"bitrate": 500_000}, True, ("bit rate is 500000 bit/s, the scene's 1000000", "can bitrate 1000000 sample-")),
        ({"sample_point": 0.7}, False, ("samples at 70.0 % of the bit, 80 % is recommended", "sample-point 0.8 ")),
        ({"sample_point": 0.95}, False, ("samples at 95.0 %",)),
        ({"restart_ms": 0}, False, ("restart-ms is 0", "restart-ms 100")),
        ({"tx_queue": 10}, False, ("holds 10 frames, and 16 may be sent at once", "txqueuelen 1000")),
        ({"state": "BUS-OFF", "tx_errors": 256}, True, ("bus-off (error counters: 256 transmit", "60 ohm", "restart")),
        ({"state": "ERROR-PASSIVE", "tx_errors": 128}, False, ("error-passive", "nobody acknowledges", "60 ohm")),
        ({"state": "ERROR-PASSIVE", "rx_errors": 135}, False, ("error-passive", "frames arrive broken", "60 ohm")),
        ({"state": "ERROR-WARNING", "rx_errors": 97}, False, ("error-warning", "97 receive")),
        ({"bus_offs": 3}, False, ("it was bus-off 3 times since",)),
        ({"bus_offs": 1}, False, ("it was bus-off once since",)),
        ({"modes": ("LISTEN-ONLY",)}, True, ("listen-only mode and cannot send", "listen-only off")),
        ({"modes": ("LOOPBACK",)}, True, ("hears only itself", "loopback off")),
        ({"modes": ("ONE-SHOT",)}, False, ("one-shot",)),
    ],
)
def test_each_wrong_setting_is_told_with_what_mends_it(change, is_error, words):
    ((severity, text),) = texts(replace(GOOD, **change))
    assert severity is is_error
    assert all(word in text for word in words), text


@pytest.mark.parametrize(
    ("bitrate", "point", "good"),
    [
        *((500_000, point, good) for point, good in ((0.84, False), (0.85, True), (0.9, True), (0.91, False))),
        *((1_000_000, point, good) for point, good in ((0.74, False), (0.75, True), (0.875, True))),
    ],
)
def test_the_sample_point_is_that_of_cia_301_on_slow_buses_or_what_the_kernel_chooses(bitrate, point, good):
    link = replace(GOOD, bitrate=bitrate, sample_point=point)
    assert bool(texts(link, ExpectedLink(bitrate))) is not good


def test_all_that_is_wrong_with_a_fd_link_is_told():
    remarks = texts(parse_link(FD), ExpectedLink(1_000_000, 5_000_000, 16))
    assert [is_error for is_error, _ in remarks] == [True, True, False, False]
    assert "data bit rate is 8000000 bit/s, the scene's 5000000" in remarks[0][1]
    assert "dbitrate 5000000 fd on" in remarks[0][1]
    assert texts(replace(GOOD, data_bitrate=8_000_000)) == []  # a classical cell has no use for it


def test_a_plan_says_how_many_frames_go_at_once():
    """Twice SYNC, heartbeat and the RPDOs: six, or with grouped targets six controlwords and three targets."""
    plan = canprobe.plan(canprobe.load_scene("free"))
    assert expected_of(plan) == {"can0": ExpectedLink(1_000_000, None, 16)}
    grouped = replace(plan.scene, arm=replace(plan.scene.arm, grouped_rpdo=True))
    assert expected_of(canprobe.plan(grouped))["can0"].frames_at_once == 22
    assert expected_of(canprobe.plan(canprobe.load_scene("listen")))["can0"].frames_at_once == 4


@pytest.fixture
def ip(monkeypatch):
    """Lets `ip` print something else for each interface."""
    answers = {}

    def run(command, **_):
        text, error = answers.get(command[-1], ("", f'Device "{command[-1]}" does not exist.'))
        if text is None:
            raise FileNotFoundError("ip")
        return subprocess.CompletedProcess(command, 1 if error else 0, text, error)

    monkeypatch.setattr("canprobe.fieldbus.bus.real.link.subprocess.run", run)
    monkeypatch.setattr("canprobe.fieldbus.bus.real.socketcan.has_socketcan", lambda: True)
    return answers


def check(channel="can0", **how):
    said = []
    check_links("socketcan", {channel: EXPECTED}, said.append, **how)
    return said


def test_a_wrong_bit_rate_ends_it_and_the_rest_is_said(ip):
    ip["can0"] = (PASSIVE, "")
    said = []
    with pytest.raises(
        InterfaceError, match=rf"^can0: its bit rate is 250000 bit/s, the scene's 1000000; type: {sudo()}ip link"
    ):
        check_links("socketcan", {"can0": EXPECTED}, said.append)
    assert len(said) == 1 and said[0].startswith("warning: can0: it is error-passive")
    said = check(must=False)
    assert [line.partition(" is ")[0] for line in said] == ["warning: can0: its bit rate", "warning: can0: it"]


def test_who_sends_nothing_needs_no_queue_no_restart_and_no_mode_to_send_in():
    link = replace(GOOD, tx_queue=1, restart_ms=0, modes=("LISTEN-ONLY",))
    assert len(texts(link)) == 3 and texts(link, replace(EXPECTED, frames_at_once=0)) == []


def test_of_a_virtual_interface_nothing_is_said(ip):
    ip["vcan0"] = (VCAN, "")
    assert check("vcan0") == []


def test_without_ip_it_says_so_with_the_line_to_type(ip, monkeypatch):
    ip["can0"] = ("not JSON", "")
    monkeypatch.setattr("shutil.which", lambda _: "/usr/sbin/ip")
    assert check() == ["can0: its setting is not checked: `ip` of iproute2 does not show it"]
    ip["can0"] = (None, "")
    monkeypatch.setattr("shutil.which", lambda _: None)
    (line,) = check()
    assert line.startswith("can0: its setting is not checked: `ip` is not installed; type:")
    assert line.endswith("apt-get install -y iproute2")
    assert read_link("can0") is None
    monkeypatch.setattr("canprobe.fieldbus.bus.real.socketcan.has_socketcan", lambda: False)
    assert check() == [], "opening it says so"


def test_other_buses_and_interfaces_that_are_down_or_missing_are_left_to_who_opens_them(ip):
    check_links("pcan", {"PCAN_USBBUS1": EXPECTED}, pytest.fail)
    ip["can0"] = (PASSIVE.replace('"NOARP","UP"', '"NOARP"'), "")
    assert check() == []
    del ip["can0"]
    assert check() == []


@pytest.mark.parametrize(
    ("name", "rates", "line"),
    [
        (
            "can0",
            (500_000,),
            "ip link set can0 down && ip link set can0 type can bitrate 500000 sample-point 0.875 restart-ms 100"
            " && ip link set can0 txqueuelen 1000 up",
        ),
        (
            "can1",
            (1_000_000, 5_000_000),
            "ip link set can1 down && ip link set can1 type can bitrate 1000000 sample-point 0.8 dbitrate 5000000 fd on"
            " restart-ms 100 && ip link set can1 txqueuelen 1000 up",
        ),
        ("vcan0", (500_000,), "ip link set vcan0 up"),
        ("vcan0", (500_000, 2_000_000), "ip link set vcan0 down && ip link set vcan0 mtu 72 up"),
    ],
)
def test_the_line_that_sets_an_interface_is_whole(name, rates, line, monkeypatch):
    monkeypatch.setattr("os.geteuid", lambda: 0)
    assert setting_line(name, *rates) == line
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    assert setting_line(name, *rates) == line.replace("ip link", "sudo ip link")


WAYS_ONTO_A_BUS = {
    "run": ("run", "free", "--bus", "socketcan", "--channel", "can0"),
    "up": ("up", "free", "--bus", "socketcan", "--channel", "can0"),
    "first motion": ("up", "free", "--check-joints", "--yes", "--bus", "socketcan", "--channel", "can0"),
    "emulate": ("emulate", "free", "--channel", "can0"),
    "emulate --eds": ("emulate", "--eds", "puma260_joint", "--node-id", "1", "--channel", "can0"),
}


@pytest.mark.parametrize("words", WAYS_ONTO_A_BUS.values(), ids=WAYS_ONTO_A_BUS)
def test_whatever_sends_stops_at_a_wrong_bit_rate_before_it_opens_the_bus(ip, words, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    opened = []
    monkeypatch.setattr("canprobe.fieldbus.bus.real.opening.open_port", lambda *args, **_: opened.append(args))
    ip["can0"] = (PASSIVE, "")
    assert canprobe.cli.main(words) == 3
    *_, line = capsys.readouterr().err.splitlines()
    whose = "the one asked for" if "--eds" in words else "the scene's"
    setting = setting_line("can0", 1_000_000)
    assert line == f"canprobe: can0: its bit rate is 250000 bit/s, {whose} 1000000; type: {setting}"
    assert opened == [] and list(tmp_path.iterdir()) == []


def state(name, transmit=0, receive=0):
    """What `ip` prints of an interface with the right bit rate and this state."""
    counters = f'"berr_counter":{{"tx":{transmit},"rx":{receive}}}'
    return (
        PASSIVE.replace('"berr_counter":{"tx":0,"rx":135}', counters)
        .replace("ERROR-PASSIVE", name)
        .replace('"bitrate":250000', '"bitrate":1000000')
    )


@pytest.fixture
def silent_bus(ip, monkeypatch):
    """can0 in the time of its own clock, with nobody on it."""
    bus = LockstepBus(VirtualClock())
    monkeypatch.setattr("canprobe.fieldbus.bus.real.opening.open_port", lambda *_, **__: bus.port())
    monkeypatch.setattr("canprobe.fieldbus.bus.clock.MonotonicClock", lambda: bus.clock)
    monkeypatch.setattr("canprobe.cell.session.buses.MonotonicClock", lambda: bus.clock)
    return bus


LOOKS = {
    "scan": (("scan", "--channel", "can0"), "no node answers on can0"),
    "scan --lss": (("scan", "--lss", "--channel", "can0"), "no node answers on can0"),
    "monitor": (("monitor", "free", "--bus", "socketcan", "--channel", "can0", "--duration", "2"), "not heard"),
}


@pytest.mark.parametrize(("words", "told"), LOOKS.values(), ids=LOOKS)
def test_whoever_only_looks_is_warned_of_a_wrong_bit_rate_and_goes_on(ip, silent_bus, words, told, capsys):
    ip["can0"] = (state("ERROR-ACTIVE").replace('"bitrate":1000000', '"bitrate":250000'), "")
    assert canprobe.cli.main(words) == 0
    captured = capsys.readouterr()
    assert captured.err.startswith("warning: can0: its bit rate is 250000 bit/s, ") and told in captured.out


RESTART, EMPTY = (
    f"then type: {sudo()}ip link set can0 type can restart",
    f"then type: {sudo()}ip link set can0 down && {sudo()}ip link set can0 up",
)
UNHEARD, BROKEN = "nobody acknowledges what it sends", "frames arrive broken"
TROUBLES = [
    (state("ERROR-PASSIVE", 128), ("error-passive (error counters: 128 transmit, 0 receive)", UNHEARD, EMPTY)),
    (state("ERROR-PASSIVE", 0, 135), ("error-passive (error counters: 0 transmit, 135 receive)", BROKEN, EMPTY)),
    (state("BUS-OFF", 256).replace('"restart_ms":100', '"restart_ms":0'), ("bus-off (error", "check wiring", RESTART)),
    (state("BUS-OFF", 256), ("bus-off (error", "check wiring", "restarts by itself every 100 ms")),
]


@pytest.mark.parametrize(
    ("look", "trouble"),
    [*(("scan", trouble) for trouble in TROUBLES), ("scan --lss", TROUBLES[0]), ("monitor", TROUBLES[0])],
)
def test_a_silent_bus_whose_controller_is_in_trouble_is_no_empty_bus(ip, silent_bus, look, trouble, capsys):
    printed, told = trouble
    ip["can0"] = (printed, "")
    assert canprobe.cli.main(LOOKS[look][0]) == 3
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith("canprobe: can0: its CAN controller is ") and all(part in line for part in told), line


@pytest.mark.parametrize(("printed", "told"), [TROUBLES[0], TROUBLES[2]])
def test_a_bring_up_that_fails_names_the_controllers_state(ip, silent_bus, printed, told, monkeypatch):
    """It was well when it was looked at; nobody answered the resets."""
    ip["can0"] = (state("ERROR-ACTIVE"), "")
    monkeypatch.setattr("canprobe.cell.session.session.rehearse", lambda plan: ip.update(can0=(printed, "")))
    scene = canprobe.load_scene("free")
    scene = replace(scene, arm=replace(scene.arm, emulated=False))
    with pytest.raises(InterfaceError, match=r"^can0: its CAN controller is ") as caught:
        canprobe.run(scene, bus="socketcan", files=False)
    assert all(part in str(caught.value) for part in (*told, "; node 1: (joint 1) sent no boot-up"))
    assert caught.value.summary["stop_reason"] == str(caught.value)


def test_where_ip_tells_no_state_the_last_error_frame_does(ip, silent_bus, monkeypatch, capsys):
    ip["can0"] = (None, "")
    port = silent_bus.port()
    port.state = ControllerState.PASSIVE
    monkeypatch.setattr("canprobe.fieldbus.bus.real.opening.open_port", lambda *_, **__: port)
    assert canprobe.cli.main(["scan", "--channel", "can0"]) == 3
    *_, line = capsys.readouterr().err.splitlines()
    assert "can0: its CAN controller is error-passive: nobody acknowledges what it sends" in line and EMPTY in line
    port = silent_bus.port()
    port.state = ControllerState.BUS_OFF
    assert canprobe.cli.main(["scan", "--bus", "pcan", "--channel", "PCAN_USBBUS1"]) == 3
    *_, line = capsys.readouterr().err.splitlines()
    assert "PCAN_USBBUS1: its CAN controller is bus-off: check wiring" in line and "type" not in line
