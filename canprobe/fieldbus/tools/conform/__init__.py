"""Examination of a device that somebody else made: is it what CiA 301, CiA 402, CiA 305 and its EDS promise?

    with open_port("socketcan", "can0", 500_000, MonotonicClock()) as port: ...
    report = Examination(port, 5, Description(load_eds("drive.eds", 5))).run()
    print(closing_text(report))

What comes in are a port, a node id, the device's EDS if there is one, and what the user permits to be written; what
goes out is a `Report` with one row for each `Point`: PASS, FAIL, NOT APPLICABLE, or ERROR where the bench failed.
Points send raw frames and accept every reaction that the standard leaves open.

The device is not ours, and may belong to a machine. So every frame passes one gate, `Permits`: it knows what each
object may be written with, and what must not be sent beside another master. What may be written is in the `Journal`,
on disk before the first write; it is put back and read back after each point and on every way out. Of a drive 6041h is
read before and after each point: where the power stage is on, the examination ends.

    point, registry     a point; the list of all; outcome: how one may end
    points/             the points, one module a service; hints.toml: what to look at where one fails
    examination         the order of things: hear, read, examine, put back
    bench, pdo_bench    what points use: entries, states, EMCY; PDOs; below it sdo_client and frame_link
    permits, journal    what may be sent; what is put back
    surroundings        what else is on the bus
    device, accepted    what the device answered; which abort codes are accepted

Times are those of the port's clock: on a virtual bus an examination takes some 50 ms. Start reading at `examination`,
then `points.sdo`.
"""

from canprobe.fieldbus.tools.conform.examination import Examination, ExaminationSettings, restore_snapshot
from canprobe.fieldbus.tools.conform.permits import WriteList
from canprobe.fieldbus.tools.conform.point import Point
from canprobe.fieldbus.tools.conform.registry import POINTS

__all__ = ["POINTS", "Examination", "ExaminationSettings", "Point", "WriteList", "restore_snapshot"]
