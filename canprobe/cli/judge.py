"""Judge a CANopen master by what it sends: known faults of masters, each a rule on the frames of the bus.

With --eds each file is an emulated node, with a SCENE or a cell its nodes are, and with --motor a motor that speaks no
CANopen; COMMAND is your master, which is started once they are served, with no input, and its output goes into a file.
Without COMMAND a master that runs elsewhere is awaited, and Ctrl-C ends the judgement. With --record a log is judged
for what can be seen in it.

Once a drive has been enabled for two seconds, faults are thrown at it, one after the other, and the reaction is judged:
slow SDO answers, a lost heartbeat, a mute node, a fault of the drive, a reboot; at a motor: silence, a rotor that is
too hot, its watchdog, a brown-out. --inject names others, and --passive throws none. Your master never drives anything
real here, as long as no real node is on the same bus.
"""

from __future__ import annotations

import argparse
import shlex
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from canprobe.cli.argument_types import seconds
from canprobe.cli.emulate import eds_files
from canprobe.cli.interrupts import first_ctrl_c, left_by_ctrl_c
from canprobe.cli.output import print_answer, print_json, print_table, say
from canprobe.cli.parser import Parser
from canprobe.cli.reports import add_report_options, bench_facts, eds_and_hash, read_baseline, write_report
from canprobe.cli.target import loaded, one_channel, real_target, scene_target
from canprobe.errors import UsageError
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.tools import reports

if TYPE_CHECKING:
    from canprobe.cell.session.target import Target
    from canprobe.fieldbus.eds.description import Description
    from canprobe.fieldbus.tools.judge import Judge
    from canprobe.fieldbus.tools.judge.bench import MasterBench
    from canprobe.fieldbus.tools.judge.seen_motor import SeenMotor

HELP = "judge a CANopen master by what it sends"
EXAMPLE = """\
exit status: 0 nothing found, 1 a rule was raised, 2 wrong usage, 3 COMMAND failed without a finding or the bus did,
124 COMMAND was still running after --seconds

examples:
  canprobe judge --eds drive.eds --node-id 5 --channel vcan0 -- python my_master.py
  canprobe judge free --channel vcan0 --passive --seconds 60 -- ./bring_up --can vcan0
  canprobe judge puma560 --channel vcan0 --inject "node 3: mute on enabled for 2 s" -- ./bring_up
  canprobe judge --eds drive.eds --node-id 5 --record candump.log --html judge.html
  canprobe judge free --record runs/free/bus.log
  canprobe judge --motor damiao:dm4310 --id 1 --mst-id 0x11 --channel vcan0 -- python my_master.py
  canprobe judge --motor damiao:dm4310 --id 1 --mst-id 0x11 --record candump.log
  canprobe judge --list
"""
_TIMED_OUT = 124
_SHOWN_FRAMES = 6
Nodes = Mapping[int, "Description"]
"""What is known of each node, by its id."""


def add_arguments(parser: Parser) -> None:
    parser.takes_command = True
    parser.usage = "canprobe judge [SCENE | --eds FILE --node-id N ...] [--record FILE] [options] [-- COMMAND...]"
    parser.add_shared("[SCENE]", "BUS")
    parser.add_eds_nodes()
    parser.add_motors()
    parser.add_option("--record FILE", "judge a log, and serve nothing", Path)
    parser.add_option("--seconds S", "end after S seconds [at the end of COMMAND, or at Ctrl-C]", seconds)
    parser.add_inject("throw this fault in the place of the sequence")
    parser.add_option("--passive", "throw no faults")
    parser.add_option(
        "--without RULES",
        "leave out rules, such as 32,33,34,45 on a machine that keeps no time",
        rule_numbers,
        default=(),
    )
    parser.add_option("--output FILE", "file for the output of COMMAND [a temporary one]", Path)
    parser.add_option("--log FILE", "write the frames as a candump log", Path)
    parser.add_option("--list", "list the rules, and end")
    add_report_options(parser)
    parser.add_shared("-v")


def rule_numbers(text: str) -> tuple[int, ...]:
    """An argument type: numbers of rules."""
    from canprobe.fieldbus.tools.judge import RULES

    known = {rule.number for rule in RULES}
    words = [word.strip() for word in text.split(",")]
    if wrong := [word for word in words if not word.isdecimal() or int(word) not in known]:
        raise argparse.ArgumentTypeError(f"expected numbers of rules, got {wrong[0]!r}; `canprobe judge --list`")
    return tuple(map(int, words))


def run(args: argparse.Namespace) -> int:
    """Judge a log, or a master on served nodes."""
    if args.list:
        return _list(args)
    if (args.scene is None) is not bool(args.eds or args.motor):
        raise UsageError("judge: name a SCENE or a cell, or else --eds FILE --node-id N, or --motor TYPE --id N")
    if args.inject and args.passive:
        raise UsageError("judge: --inject throws faults, and --passive throws none; choose one")
    args.older = read_baseline(args)
    return _judge_served(args) if args.record is None else _judge_record(args)


def _judge_record(args: argparse.Namespace) -> int:
    for option in ("command", "inject", "seconds", "log", "output"):
        if getattr(args, option):
            name = "COMMAND" if option == "command" else f"--{option}"
            raise UsageError(f"judge: {name} belongs to served nodes, not to --record")
    from canprobe.fieldbus.tools.judge import Judge, nodes_of, read_record

    channel = one_channel(args, "judge: a log is judged for one channel: --channel CH")
    nodes = _descriptions(args, channel)
    motors = _motors(args, nodes)
    judge = Judge(nodes, bitrate=args.bitrate or 1_000_000, without=args.without, motors=motors)
    judge.hear(read_record(args.record, channel))
    known = any(node.seen or node.addressed for node in judge.bus.nodes.values())
    if not known and not any(motor.shown for motor in motors):
        raise UsageError(_no_such_node(args, nodes, nodes_of(read_record(args.record, channel))))
    if not judge.bus.now_ns:
        args.report.say(f"{args.record} has no times, so no interval or time-out is judged; record with candump -ta")
    facts = {**_facts(args), "frames": str(judge.frame_count)}
    report = judge.report(f"the master in {args.record}", facts, log=str(args.record))
    _print(args, report)
    return report.exit_status


def _motors(args: argparse.Namespace, nodes: Nodes) -> list[SeenMotor]:
    """What is known of each motor of the command line before its first frame."""
    from canprobe.fieldbus.motor.on_bus import motors_on_bus
    from canprobe.fieldbus.motor.protocol import Rid
    from canprobe.fieldbus.tools.judge.seen_motor import SeenMotor

    made = motors_on_bus(args.motor, args.id, args.mst_id, nodes)
    return [SeenMotor(one.node_id, int(one.registers[Rid.MST_ID]), one.ranges) for one in made]


def _no_such_node(args: argparse.Namespace, asked: Iterable[int], found: Sequence[int]) -> str:
    """The message where a log has no frame of the nodes that are judged: which it has, and what to type."""
    if args.motor:
        return f"judge: {args.record} has no answer of a motor with this --id and --mst-id"
    ids = ", ".join(map(str, asked))
    head = f"judge: {args.record} has no frame of node {ids} or to it"
    if not found:
        return f"{head}, and no heartbeat, EMCY or SDO answer of any other: is it a log of a CANopen bus?"
    way = f"type --node-id {found[0]}" if args.eds else "name a scene or a cell with them, or --eds FILE --node-id N"
    return f"{head}; nodes that it shows: {', '.join(map(str, found))}; {way}"


def _judge_served(args: argparse.Namespace) -> int:
    from canprobe.fieldbus.tools.judge.bench import MasterBench, write_log

    nodes = _descriptions(args)
    output = args.output or Path(tempfile.mkstemp(prefix="canprobe-judge-", suffix=".txt")[1])
    bench = MasterBench(args.command, args.seconds, () if args.passive else args.inject or None, output)
    try:
        target, serve = _server(args, bench, nodes)
        with left_by_ctrl_c(), first_ctrl_c(bench.ask):
            serve()
    finally:
        bench.close()
        if args.output is None and not output.stat().st_size:
            output.unlink()
    if bench.command is not None and output.exists():
        args.report.say(f"output of {args.command[0]}: {output}")
    judge = bench.judged(nodes, target.bitrate, args.without, _motors(args, nodes))
    if args.log is not None:
        write_log(bench.record(), args.log, target.channel)
    report = _report_of(args, bench, judge, nodes, target)
    _print(args, report)
    if report.exit_status:
        return report.exit_status
    heard = any(frame.from_node is False for frame in bench.frames)
    if not heard:
        say(f"judge: no master was heard on {target.channel}: does it use this channel and bit rate?")
    status = _TIMED_OUT if bench.timed_out else _status_of_command(bench)
    return status if heard else max(3, status)


def _server(args: argparse.Namespace, bench: MasterBench, nodes: Nodes) -> tuple[Target, Callable[[], None]]:
    """The bus, and the function that serves the nodes on it; drives stand away from 0, where a jump to 0 is seen."""
    channel = one_channel(args, "judge: the nodes are served on one channel, without a name: --channel CH")
    if args.scene is None:
        from canprobe.cell.session.served import emulate_eds
        from canprobe.fieldbus.tools.judge.bench import start_position

        target = real_target(args, channel)
        files = eds_files("judge", args)
        positions = [start_position(node) for node in nodes.values()]
        motors = (args.motor, args.id, args.mst_id)
        return target, lambda: emulate_eds(
            files, target, positions=positions, motors=motors, observer=bench, say=args.report.say
        )
    from canprobe import api

    scene = loaded(args)
    target = scene_target(args, scene)
    others = (scene.sensor if scene.array_is_node else None, scene.carrier)
    node_ids = (*scene.drives, *(one.node_id for one in others if one is not None))
    return target, lambda: api.emulate(scene, target, node_ids=node_ids, observer=bench, say=args.report.say)


def _status_of_command(bench: MasterBench) -> int:
    """Status where nothing was found: 3 where the command failed, and no fault of ours can be the reason."""
    if not bench.status or bench.thrown():
        return 0
    assert bench.command is not None
    end = f"status {bench.status}" if bench.status > 0 else f"signal {-bench.status}"
    say(f"judge: {bench.command.words[0]} ended with {end}; its last lines, of {bench.command.output}:")
    for line in bench.command.last_lines():
        say(f"  {line}")
    return 3


def _descriptions(args: argparse.Namespace, channel: str | None = None) -> Nodes:
    """What is known of each node, by its id; of a scene with several channels, those on one of them."""
    from canprobe.fieldbus.eds.description import Description

    if args.scene is None:
        files = eds_files("judge", args)
        if any(one == 255 for _, one in files):
            raise UsageError("judge: nodes without an id (255) are not judged")
    else:
        from canprobe.cell.planning.make import make_plan
        from canprobe.cell.scene.resolve import resolve

        planned = make_plan(resolve(loaded(args))).nodes
        several = len({node.channel for node in planned}) > 1
        files = [(node.eds, node.node_id) for node in planned if not several or channel in (None, node.channel)]
    return {one: Description(load_eds(name, one)) for name, one in files}


def _report_of(
    args: argparse.Namespace, bench: MasterBench, judge: Judge, nodes: Nodes, target: Target
) -> reports.Report:
    from canprobe.fieldbus.tools.judge.bench import first_answers

    facts = {**_facts(args), "adapter": f"{target.interface} {target.channel}", "frames": str(judge.frame_count)}
    if bench.command is not None:
        status = "ended by us" if bench.status is None else f"status {bench.status}"
        facts["master"] = f"{shlex.join(bench.command.words)}: {status}"
        if bench.command.output.exists():
            facts["output of the master"] = str(bench.command.output)
    thrown = bench.thrown()
    found = first_answers(bench.record(), thrown, nodes, _motors(args, nodes))
    times = []
    for number, (one, answer) in enumerate(zip(thrown, found, strict=True), 1):
        text = "no answer"
        if answer is not None:
            times.append((answer.t_ns - one.begin_ns) * 1e-6)
            text = f"first answer {times[-1]:.1f} ms later: {answer}"
        span = f"from {one.begin_ns * 1e-9:.3f} to {one.end_ns * 1e-9:.3f} s"
        facts[f"fault {number}"] = f"{one.text} {span}; {text}"
    report = judge.report("the master", facts, log=None if args.log is None else str(args.log))
    if times:
        report.distributions["first answer to a fault"] = tuple(times)
    left = bench.injections.not_thrown if bench.injections is not None else []
    report.left_out += [
        (f"fault {text}", "no drive or motor was enabled for two seconds before the end") for text in left
    ]
    return report


def _facts(args: argparse.Namespace) -> dict[str, str]:
    """What the report says of the bench."""
    facts = bench_facts({"bit rate": f"{args.bitrate or 1_000_000} bit/s"})
    for name, one in zip(args.eds, args.node_id, strict=False):
        facts[f"EDS of node {one}"] = eds_and_hash(name)
    return facts


def _print(args: argparse.Namespace, report: reports.Report) -> None:
    """Write the files, and print the findings and the closing table."""
    change = write_report(args, report, args.older)
    if args.json:
        print_json(reports.report_document(report))
        return
    for row in report.rows:
        if row.verdict is reports.Verdict.FAIL:
            more = [
                *(f"{key}: {getattr(row, key)}" for key in ("severity", "expected", "hint")),
                *row.came[:_SHOWN_FRAMES],
            ]
            print(reports.row_text(row), *(f"       {line}" for line in more), sep="\n")
        elif args.report.verbosity > 0:
            print(reports.row_text(row))
    for name, fact in report.facts.items():
        if name.startswith("fault "):
            print(f"{name}: {fact}")
    print(reports.closing_text(report, change))


def _list(args: argparse.Namespace) -> int:
    from canprobe.fieldbus.tools.judge import RULES

    keys = ("number", "name", "group", "severity", "source", "expected", "hint")
    document = [{key: getattr(rule, key) for key in keys} for rule in RULES]
    rows = [(f"{r.number:02}", r.group, r.name, r.severity.value, r.expected) for r in RULES]
    head = ("rule", "family", "fault of a master", "severity", "what a good one does")
    print_answer(args, document, lambda: print_table([head, *rows]))
    return 0
