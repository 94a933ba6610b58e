"""Logs that cannot be replayed: each is told with what is wrong and where."""

from __future__ import annotations

import pytest
from candump_lines import can_id_of, restamped, stamp_us

import canprobe
from canprobe.errors import UsageError


def test_a_node_that_is_not_in_the_log_is_named(lockstep_run, copy_of):
    folder = copy_of(lockstep_run.out, lambda lines: [x for x in lines if can_id_of(x) not in ("183", "511")])
    with pytest.raises(UsageError) as caught:
        canprobe.replay(folder)
    first, second = str(caught.value).splitlines()
    assert "node 3 (joint 3) was never heard: no TPDO 183h" in first
    assert "node 16 (tactile array) was never heard: no TPDO 511h" in second


def test_pdos_of_another_mapping_are_told(lockstep_run, copy_of):
    folder = copy_of(lockstep_run.out, lambda lines: [x[:-4] if can_id_of(x) == "182" else x for x in lines])
    with pytest.raises(UsageError, match=r"node 2 .*\(\d+ PDOs of a wrong length\)"):
        canprobe.replay(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: [x for x in lines if can_id_of(x) != "080"], "on can0 0 SYNC"),
        (lambda lines: [*lines[:1999], lines[1999][:25], *lines[2000:]], r"bus\.log:2000: no candump line"),
        (lambda lines: [], "no frame at all; node 1 "),
        (lambda lines: [restamped(x, 2 * stamp_us(x)) for x in lines], "a SYNC every 5.000 ms, but .* every 2.500 ms"),
        (lambda lines: [line for line in lines for _ in range(2)], r"on can0 \d+ of \d+ SYNCs .*logged twice\?"),
        (lambda lines: lines[: len(lines) // 4], "nothing was touched"),
        (
            lambda lines: [x.replace("183#37", "183#FF") for x in lines],
            r"bus\.log: on can0: node 3: statusword 0x..ff is no CiA 402 state",
        ),
    ],
    ids=["no sync", "torn line", "empty", "other rate", "doubled", "no contact", "no state"],
)
def test_a_log_that_cannot_be_replayed(lockstep_run, copy_of, change, message):
    with pytest.raises(UsageError, match=message):
        canprobe.replay(copy_of(lockstep_run.out, change))


def test_what_is_missing_or_wrong_in_the_request(lockstep_run, tmp_path):
    with pytest.raises(UsageError, match=r"no bus\.log in this folder"):
        canprobe.replay(tmp_path)
    (tmp_path / "bus.log").write_text("")
    with pytest.raises(UsageError, match=r"no scene\.toml in this folder: name the scene"):
        canprobe.replay(tmp_path)
    with pytest.raises(UsageError, match="name the scene"):
        canprobe.replay(tmp_path / "bus.log")
    with pytest.raises(UsageError, match=r"none\.log: no such folder or file"):
        canprobe.replay(tmp_path / "none.log", scene="cylinder")
    with pytest.raises(UsageError, match='did you mean "recursive"'):
        canprobe.replay(lockstep_run.out, method="recursve")
    with pytest.raises(UsageError, match="task press estimates no shape"):
        canprobe.replay(lockstep_run.out, scene="press")
