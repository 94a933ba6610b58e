"""The points that `canprobe conform` examines, on a node with every service and on a drive: all pass, without a note.

What only a node of our own must do is in the other modules: the value of a limit, the order of two messages.
"""

from __future__ import annotations

from defects import write_whole_device

from canprobe.fieldbus import Description, load_eds, make_eds_node
from canprobe.fieldbus.tools.conform import POINTS, Examination, ExaminationSettings, WriteList
from canprobe.fieldbus.tools.conform.frame_link import BenchTimes
from canprobe.fieldbus.tools.reports import Verdict

NODE_ID = 5
GROUPS = {
    "nmt": [1, 2, 3, 4, 5, 6, 7],
    "heartbeat": [8, 9, 44, 45],
    "sdo": [10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24],
    "pdo": [25, 26, 27, 28, 29, 30, 31, 32, 33, 34, 35, 36, 37, 38],
    "sync": [39, 40, 41],
    "emcy": [42, 43, 47],
    "lss": [66, 67, 68, 69, 70, 73],
    "drive402": [48, 49, 50, 51, 53, 54, 55],
}
LEFT_OUT = {"1 power on"}  # it needs a person
OTHER_CODES = {"42 empty entry"}  # 1003h:09 is beyond the last sub-index, where 06090011h is as exact


def _make(group, numbers):
    def test(connect, tmp_path):
        eds = "puma260_joint" if group == "drive402" else write_whole_device(tmp_path)
        od = load_eds(eds, NODE_ID)
        bench = connect(make_eds_node(od, NODE_ID, eds=eds)).boot()
        times = BenchTimes(slack_s=0.2) if bench.real_time else BenchTimes()
        written = WriteList.parse("2001h,2002h,reset,history")
        settings = ExaminationSettings(written=written, times=times, motion=True)
        points = [point for point in POINTS if point.group == group and point.title not in LEFT_OUT]
        report = Examination(bench.port, NODE_ID, Description(od), settings).run(points)
        assert [(row.name, row.detail) for row in report.rows if row.verdict is not Verdict.PASS] == []
        assert {row.name: row.detail for row in report.rows if row.detail and row.name not in OTHER_CODES} == {}
        assert {point.number for point in points} >= set(numbers)

    test.__name__ = test.__qualname__ = f"test_cia301_{'_'.join(f'{number:02}' for number in numbers)}_by_conform"
    return test


for _group, _numbers in GROUPS.items():
    _test = _make(_group, _numbers)
    globals()[_test.__name__] = _test
