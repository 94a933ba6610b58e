"""Points 66–72: layer setting services, by raw frames. Source: CiA 305, "LSS services and protocols"."""

from __future__ import annotations

from functools import partial

import pytest
from conformance_bench import ON_BOTH_BUSES

from canprobe.fieldbus import SlaveNode, load_eds
from canprobe.fieldbus.node import Abort, SdoAbort

EDS = "puma260_joint"
VENDOR, PRODUCT, REVISION, SERIAL = NUMBERS = (0xCA5E, 0x260, 0x10000, 0xA5000321)
REQUEST, ANSWER = 0x7E5, 0x7E4
WAITING, CONFIGURATION = "0400", "0401"
IDENTIFIED = (ANSWER, "4f" + 14 * "0")


def make_node(node_id=255, serial=SERIAL):
    node = SlaveNode(load_eds(EDS, 1 if node_id == 255 else node_id), node_id, od_of=partial(load_eds, EDS))
    node.dictionary.set_default(0x1018, 4, serial)
    return node


@pytest.fixture
def blank(connect):
    """A node without an id, powered; it says nothing."""
    bench = connect(make_node())
    bench.power_on()
    bench.silence()
    return bench


@pytest.fixture
def five(connect):
    """The same device with node id 5, booted."""
    return connect(make_node(5)).boot()


def lss(bench, text):
    bench.send(REQUEST, text.ljust(16, "0"))


def number(command, value):
    return f"{command:02x}" + value.to_bytes(4, "little").hex()


def answered(bench, text, answer):
    lss(bench, text)
    bench.expect((ANSWER, answer.ljust(16, "0")))


def select(bench, numbers=NUMBERS):
    for command, value in enumerate(numbers, start=0x40):
        lss(bench, number(command, value))


def selected(bench):
    select(bench)
    bench.expect((ANSWER, "44" + 14 * "0"))


def test_cia305_lss_66_switch_selective_takes_the_one_address(blank):
    lss(blank, WAITING)
    for wrong in range(4):
        select(blank, [value ^ (position == wrong) for position, value in enumerate(NUMBERS)])
        blank.silence()
    select(blank, (*NUMBERS[:2], REVISION))
    lss(blank, number(0x41, PRODUCT))
    lss(blank, number(0x43, SERIAL))
    blank.silence()  # out of order
    selected(blank)
    select(blank)
    blank.silence()  # it is in configuration already


def test_cia305_lss_67_identify_remote_slave_within_bounds(blank):
    exact = [VENDOR, PRODUCT, REVISION, REVISION, SERIAL, SERIAL]

    def identify(values):
        for command, value in enumerate(values, start=0x46):
            lss(blank, number(command, value))

    for state in (WAITING, CONFIGURATION):
        lss(blank, state)
        identify(exact)
        blank.expect(IDENTIFIED)
        identify([VENDOR, PRODUCT, 0, 0xFFFFFFFF, 0, 0xFFFFFFFF])
        blank.expect(IDENTIFIED)
        for place, change in enumerate((1, 1, 1, -1, 1, -1)):
            identify([value + change * (i == place) for i, value in enumerate(exact)])
            blank.silence()


def fastscan(bench, value, bit, position, following):
    lss(bench, f"51{value.to_bytes(4, 'little').hex()}{bit:02x}{position:02x}{following:02x}")


@ON_BOTH_BUSES
def test_cia305_lss_68_fastscan_finds_every_bit_and_selects(blank):
    """Each question alone: the bits above are those found, so that a wrong answer anywhere shows."""
    fastscan(blank, 0, 0x80, 0, 0)
    blank.expect(IDENTIFIED)
    for position, wanted in enumerate(NUMBERS):
        for bit in range(31, -1, -1):
            above = wanted >> bit + 1 << bit + 1
            if wanted >> bit & 1 == 0:
                fastscan(blank, above, bit, position, position)
                blank.expect(IDENTIFIED)
        if position == 1:
            fastscan(blank, wanted ^ 0x10, 0, position, position)
            blank.silence()
        fastscan(blank, wanted, 0, position, (position + 1) % 4)
        blank.expect(IDENTIFIED)
    answered(blank, "5e", "5eff")
    fastscan(blank, 0, 0x80, 0, 0)
    blank.silence()  # found, so it no longer takes part


@pytest.mark.parametrize("question", [(0, 32, 0, 0), (0, 0x7F, 0, 0), (0, 31, 4, 0), (0, 31, 0, 4), (0, 31, 1, 1)])
def test_cia305_lss_68_fastscan_ignores_what_it_does_not_ask(blank, question):
    fastscan(blank, *question)
    blank.silence()


@pytest.mark.parametrize(("node_id", "error"), [(0, 1), (1, 0), (127, 0), (128, 1), (254, 1), (255, 0)])
def test_cia305_lss_69_configure_node_id_within_its_range(blank, node_id, error):
    lss(blank, CONFIGURATION)
    answered(blank, f"11{node_id:02x}", f"11{error:02x}")
    answered(blank, "5e", f"5e{255 if error else node_id:02x}")


def test_cia305_lss_69_configure_needs_the_configuration_state(blank):
    for text in ("1105", "130000", "17", "5a", "5e"):
        lss(blank, text)
    blank.silence()


@pytest.mark.parametrize(("table", "index", "error"), [(0, 0, 0), (0, 2, 1), (0, 5, 1), (0, 99, 1), (1, 0, 1)])
def test_cia305_lss_70_bit_timing_of_the_bus_or_none(blank, table, index, error):
    lss(blank, CONFIGURATION)
    answered(blank, f"13{table:02x}{index:02x}", f"13{error:02x}")


@pytest.mark.parametrize("stored", [True, False])
def test_cia305_lss_71_72_a_stored_id_survives_a_power_cycle(connect, stored):
    node, again = make_node(), make_node()
    bench = connect(node)
    bench.power_on()
    lss(bench, CONFIGURATION)
    answered(bench, "1109", "1100")
    if stored:
        answered(bench, "17", "1700")
    lss(bench, WAITING)
    bench.expect((0x709, "00"))
    bench.end()
    again.store.node_id = node.store.node_id
    bench = connect(again)
    bench.power_on()
    if stored:
        bench.expect((0x709, "00"))
    else:
        bench.silence()


def test_cia305_lss_71_a_memory_that_cannot_be_written_is_error_2(connect):
    node = make_node()

    def full():
        raise SdoAbort(Abort.HARDWARE)

    node.store.changed = full
    bench = connect(node)
    bench.power_on()
    lss(bench, CONFIGURATION)
    answered(bench, "1109", "1100")
    answered(bench, "17", "1702")
    assert node.store.node_id is None


def test_cia305_lss_72_a_node_without_id_boots_when_it_is_let_go(blank):
    blank.send(0, "8200")
    blank.send(0, "8100")
    blank.silence()  # NMT does not reach it
    lss(blank, CONFIGURATION)
    lss(blank, WAITING)
    blank.silence()  # still none
    lss(blank, CONFIGURATION)
    answered(blank, "1109", "1100")
    blank.silence()
    lss(blank, WAITING)
    blank.expect((0x709, "00"))
    blank.node_id = 9
    assert blank.state() == 0x7F
    assert blank.read(0x1014) == 0x89  # $NODEID + 80h
    assert blank.read(0x1018, 4) == SERIAL


def test_cia305_lss_72_another_id_counts_from_the_reset_on(five):
    five.set((0x6081, 0, 1234, 4), (0x1015, 0, 500, 2))
    lss(five, CONFIGURATION)
    answered(five, "1109", "1100")
    answered(five, "5e", "5e05")
    lss(five, WAITING)
    assert five.read(0x1014) == 0x85
    five.nmt(0x82)
    five.expect((0x709, "00"))
    five.send(0x605, "4014100000000000")
    five.silence()
    five.node_id = 9
    assert (five.read(0x1014), five.read(0x1015)) == (0x89, 0)
    assert five.read(0x6081) == 1234  # a reset of communication leaves the application alone
    selected(five)
    answered(five, "5e", "5e09")


def test_cia305_lss_72_an_id_can_be_taken_away(five):
    lss(five, CONFIGURATION)
    answered(five, "11ff", "1100")
    lss(five, WAITING)
    five.nmt(0x82)
    five.silence()
    answered(five, "4c", "50")
