"""What commands with a report of an examination share: options, facts of the bench, and the files that are written."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path

from canprobe.cli.parser import Parser
from canprobe.errors import UsageError
from canprobe.fieldbus.eds.packaged import eds_file
from canprobe.fieldbus.tools import reports


def add_report_options(parser: Parser) -> None:
    """Add --baseline, --fail-on, --junit, --html and --json."""
    parser.add_option("--baseline FILE", "compare with an older --json report", Path)
    parser.add_option(
        "--fail-on WHAT",
        "exit with 1 for any deviation, or for a new one: not in the --baseline [deviation]",
        choices=("deviation", "new"),
        default="deviation",
    )
    parser.add_option("--junit FILE", "write JUnit XML, for CI servers", Path)
    parser.add_option("--html FILE", "write one HTML file, for people", Path)
    parser.add_shared("--json")


def read_baseline(args: argparse.Namespace) -> reports.Report | None:
    """The older report, read before anything is sent; None where none is named."""
    if args.fail_on == "new" and args.baseline is None:
        raise UsageError("--fail-on new compares with an older report: --baseline FILE names it")
    return reports.read_json(args.baseline) if args.baseline is not None else None


def write_report(
    args: argparse.Namespace, report: reports.Report, baseline: reports.Report | None
) -> reports.ReportChange | None:
    """Write the files that are asked for, and the step summary of GitHub; what changed since the baseline."""
    change = None if baseline is None else reports.compare(report, baseline)
    if change is not None and args.fail_on == "new":
        bad = [row.key for row in report.rows if row.verdict is reports.Verdict.FAIL]
        report.known = tuple(key for key in bad if key not in (*change.worse, *change.new))
    if args.junit is not None:
        reports.write_junit(report, args.junit)
    if args.html is not None:
        reports.write_html(report, args.html, change)
    reports.append_step_summary(report, os.environ, change)
    return change


def bench_facts(bus: Mapping[str, str]) -> dict[str, str]:
    """Facts of the bench: the command as it was typed, those of the bus, and versions."""
    import platform

    import canprobe

    versions = f"canprobe {canprobe.__version__}, Python {platform.python_version()}, {platform.platform()}"
    return {"command": shlex.join(["canprobe", *sys.argv[1:]]), **bus, "versions": versions}


def eds_and_hash(name: str) -> str:
    """Name of an EDS file with the hash of its content."""
    import hashlib

    path = eds_file(name)
    return f"{path.name}, SHA-256 {hashlib.sha256(path.read_bytes()).hexdigest()}"
