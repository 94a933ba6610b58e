"""A node that we did not write, canopen-python's LocalNode: what it is known not to do is found."""

from __future__ import annotations

from local_node import examined

from canprobe.fieldbus.tools.reports import Verdict

# By its source and its issues, not by what the examination found: canopen 2.4.1, node/local.py, sdo/server.py, nmt.py.
KNOWN = {
    "nmt 1 boot-up",  # 82h sends no boot-up
    "nmt 5 stopped",  # SDO is served in stopped
    "sdo 17 limits",  # set_data checks no limit
    "sdo 23 block upload",  # no block server
    "heartbeat 44 consumer",  # 1016h is an entry like any other
    "pdo 30 type 1",  # SYNC triggers nothing
    "sync 40 wrong length",
    "hostile 93 SDO of every length",  # the server looks at the command byte alone
}


def test_its_known_deviations_are_found_and_the_bench_does_not_fail():
    report = examined()
    failed = {f"{row.group} {row.name}" for row in report.rows if row.verdict is Verdict.FAIL}
    assert failed >= KNOWN
    assert report.counts()[Verdict.ERROR] == 0
    assert report.counts()[Verdict.PASS] > 30  # what it does well: abort codes, segments, access rights
