"""`up` tells what it lives with: at once when it is new, counted at the end."""

from __future__ import annotations

import canprobe
from canprobe.cell.measurement import Command
from canprobe.note_report import news_teller, telling_notes
from canprobe.protocol.emcy import Emcy
from canprobe.protocol.frames import EMCY_BASE
from canprobe.session import Session


def test_each_kind_is_told_when_it_comes_and_counted_at_the_end():
    lines = []
    session = Session(canprobe.load_scene("free"))

    def disturb(measurement):
        if measurement.cycle in (60, 70):
            session.lockstep.port().send_batch([(EMCY_BASE + 4, Emcy(0x8210, 0x11).pack())])
        return Command(done=measurement.cycle > 80)

    with telling_notes(session, lines.append):
        session.run(disturb, news_teller(session, lines.append))
        assert len(lines) == 1, "the second of the same kind is no news"
    what = "noted: node 4: EMCY 8210h, PDO not processed due to length error, "
    first, last = (session.cell.start_ns * 1e-9 + cycle * 0.0025 for cycle in (60, 70))  # on the clock of bus.log
    assert lines == [what + f"at {first:.2f} s", what + f"2 times, first at {first:.2f} s, last at {last:.2f} s"]
