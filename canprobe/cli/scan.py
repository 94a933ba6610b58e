"""List the nodes on a bus with their identities; with --lss also assign ids to nodes that have none.

LSS (CiA 305) finds nodes without an id by vendor, product, revision and serial number (1018h). --assign gives an id to
one device. With a SCENE, its nodes get their ids; EDS files and serial_numbers identify the devices. A device
boots with its new id at once and keeps it, unless --no-store is given.

A node that only sends heartbeats is listed with its state, and a node id that two devices have with both serial
numbers. "-" stands for what a node does not answer.

With --motors it is motors that speak no CANopen (Damiao), on a bus of their own: their registers are read, no more.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from canprobe.cli.argument_types import number_of_32_bits, seconds, whole
from canprobe.cli.output import print_answer, print_table
from canprobe.cli.parser import Parser
from canprobe.cli.target import loaded, real_target
from canprobe.errors import UsageError

if TYPE_CHECKING:
    from canprobe.cell.master.commission import Commissioned

HELP = "list the nodes on a bus"
EXAMPLE = """\
examples:
  canprobe scan --bus socketcan --channel can0
  canprobe scan --channel can0 --timeout 2             # nodes that are slow to answer
  canprobe scan --lss --channel can0                   # also the nodes without an id
  canprobe scan --lss --assign 3 --channel can0        # the only node without an id gets 3
  canprobe scan --lss --assign 0x4711=3 --assign 0x4712=4 --channel can0
  canprobe scan mine.toml --lss --channel can0         # the nodes of the scene get their ids
  canprobe scan --motors --channel can0                # Damiao motors: ids, ranges, watchdog, mode
"""
_COLUMNS = ("node_id", "state", "vendor_id", "product_code", "revision_number", "serial_number", "device_name")
_NUMBERS = 4
_STOPPED = "a stopped node answers none (CiA 301): a master must take it out of that state"
Assignment = tuple[tuple[int | None, int | None, int | None, int | None], int]


def add_arguments(parser: Parser) -> None:
    parser.add_shared("[SCENE]")
    parser.add_real_bus()
    parser.add_option(
        "--timeout S",
        "longest time to one SDO answer in seconds [0.5, as bring-up waits; the scene's bring_up.sdo_s]",
        seconds,
    )
    parser.add_option("--lss", "also find nodes without an id")
    parser.add_option(
        "--assign [SERIAL=]ID",
        "assign this id to the device with this serial number or VENDOR:PRODUCT:REVISION:SERIAL; may be repeated",
        assignment,
        many=True,
    )
    parser.add_option("--motors", "find motors that speak no CANopen, on a bus without CANopen nodes")
    parser.add_option("--no-store", "the devices lose their new ids when they lose power")
    parser.add_shared("--json", "-v")


def assignment(text: str) -> Assignment:
    """An argument type: `ID`, `SERIAL=ID` or `VENDOR:PRODUCT:REVISION:SERIAL=ID`."""
    device, _, node_id = text.rpartition("=")
    parts = [number_of_32_bits(part) for part in device.split(":")] if device or "=" in text else []
    if len(parts) not in (0, 1, _NUMBERS):
        raise argparse.ArgumentTypeError(f"expected SERIAL=ID or VENDOR:PRODUCT:REVISION:SERIAL=ID, got {text!r}")
    vendor, product, revision, serial = [None] * (_NUMBERS - len(parts)) + parts
    return (vendor, product, revision, serial), whole(1, 127)(node_id)


def run(args: argparse.Namespace) -> None:
    """Print one row for each node."""
    from canprobe.cell.session.target import refuse_virtual

    refuse_virtual(args.bus, "scan")
    _check(args)

    from canprobe import api

    target = real_target(args, args.channel, channel_else="can0")
    if not args.lss:
        found = api.scan(target, timeout_s=args.timeout, motors=args.motors, say=args.report.say)
        show = _print_motors if args.motors else _print_nodes
        print_answer(args, found, lambda: show(found, target.channel))
        return
    scene = None if args.scene is None else loaded(args)
    done = api.commission(
        target, scene=scene, assign=args.assign, store=not args.no_store, timeout_s=args.timeout, say=args.report.say
    )
    print_answer(args, done.as_document(), lambda: _print_commissioned(done, target.channel))


def _check(args: argparse.Namespace) -> None:
    if args.motors and args.lss:
        raise UsageError("scan: --motors or --lss, not both: motors have no LSS")
    for given, name in ((args.assign, "--assign"), (args.scene, "SCENE"), (args.no_store, "--no-store")):
        if given and not args.lss:
            raise UsageError(f"scan: {name} goes with --lss")
    if args.scene is not None and args.assign:
        raise UsageError("scan: --assign or SCENE, not both")
    ids = [node_id for _, node_id in args.assign]
    if twice := [node_id for node_id in ids if ids.count(node_id) > 1]:
        raise UsageError(f"scan: --assign gives id {twice[0]} to more than one device")


def _print_nodes(nodes: list[dict[str, Any]], where: str) -> None:
    if not nodes:
        print(f"no node answers on {where}")
        return
    print_table([_COLUMNS, *([_cell(key, node[key]) for key in _COLUMNS] for node in nodes)])
    for node in nodes:
        name = f"node {node['node_id']}"
        if node["devices"] > 1:
            serials = " and ".join(f"{number:#x}" for number in node["serial_numbers"]) or "not stated"
            print(
                f"{name}: {node['devices']} devices answer with this id, serial numbers {serials}:"
                " disconnect one and give the other another id"
            )
        elif not node["devices"]:
            state = node["state"]
            way = _STOPPED if state == "STOPPED" else "if it is only slow, give a larger --timeout"
            print(f"{name}: sends heartbeats ({state}), but answers no SDO request; {way}")


def _print_motors(motors: list[dict[str, Any]], where: str) -> None:
    if not motors:
        print(f"no motor answers on {where}")
        return
    rows = [("motor", "MST_ID", "PMAX VMAX TMAX", "type", "watchdog", "mode")]
    for one in motors:
        ranges = " ".join("-" if each is None else f"{each:g}" for each in one["ranges"])
        watchdog = {None: "-", 0: "off"}.get(one["timeout_ms"], f"{one['timeout_ms']} ms")
        types = " or ".join(one["types"]) or "none that is known"
        rows.append((str(one["motor_id"]), f"{one['mst_id']:03X}h", ranges, types, watchdog, one["mode"] or "-"))
    print_table(rows)
    for one in motors:
        if one["devices"] > 1:
            print(f"motor {one['motor_id']}: {one['devices']} answer with this id; leave one on the bus, and change it")


def _print_commissioned(done: Commissioned, where: str) -> None:
    for one, stored in done.assigned:
        before = "" if one.before is None else f", before {one.before}"
        print(f"{one.address} is node {one.node_id} now{before}{'' if stored else '; until its power goes'}")
    _print_nodes(done.nodes, where)
    for address in done.unconfigured:
        print(f"without an id: {address} (vendor:product:revision:serial)")
    if not done.unconfigured and not done.assigned:
        print(f"no node without an id answers on {where}")


def _cell(key: str, value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, int):
        return str(value) if key == "node_id" else f"{value:#x}"
    return "".join(c if c.isprintable() else "?" for c in str(value))
