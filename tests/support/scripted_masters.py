"""Masters written by hand as frames, and a drive as simple as it can be: nothing of canprobe's.

`Master` does everything right, and so does each subclass of `Careful` in another way. Every other class does one thing
wrong, that of the rule whose number it has.
"""

from __future__ import annotations

import struct

MS = 1_000_000
PERIOD = 10 * MS
MASTER = 0x7F
OFF, READY, ON, ENABLED, QUICK, FAULT = 0x40, 0x21, 0x23, 0x27, 0x07, 0x08


class Drive:
    """A drive with the default PDOs of the packaged EDS: 6040h and 607Ah in, 6041h, 6064h and 6077h out."""

    def __init__(self, node_id, position=5000):
        self.node_id, self.position, self.target = node_id, position, position
        self.state, self.word, self.bits = OFF, 0, 0
        self.values = {(0x6041, 0): OFF, (0x6064, 0): position, (0x6061, 0): 0}
        self.nmt, self.beats, self.reports, self.stuck, self.swapped = 0, True, True, False, False

    def obey(self, word):
        rises, self.word = word & ~self.word, word
        if self.state == FAULT:
            if rises & 0x80 and not self.stuck:
                self.state = OFF
        elif not word & 2:
            self.state = OFF
        elif not word & 4:
            self.state = QUICK if self.state in (ENABLED, QUICK) else OFF
        elif self.state == QUICK:
            pass
        elif word & 0xF == 6:
            self.state = READY
        elif word & 0xF == 7 and self.state in (READY, ENABLED):
            self.state = ON
        elif word & 0xF == 0xF and self.state in (READY, ON):
            self.state = ENABLED
        if self.values.get((0x6061, 0)) == 6 and rises & 0x10:
            self.bits |= 0x1000

    def step(self):
        if self.state == ENABLED and not self.word & 0x100 and not self.bits & 0x2000:
            self.position = self.target
        self.values[0x6064, 0], self.values[0x6041, 0] = self.position, self.state | self.bits


class Master:
    """Does everything right: configures, starts, enables, moves, stops. Subclasses do one thing otherwise."""

    nodes = (1,)
    absent = ()
    mode, steps, way = 8, 150, 100
    watch = cycle_time = True
    numbers = ()

    def __init__(self):
        self.t, self.frames, self.beat_t, self.count = 0, [], 0, 0
        self.drives = {node_id: Drive(node_id) for node_id in self.nodes}

    def run(self):
        for drive in self.drives.values():
            self.boot(drive)
        for drive in self.drives.values():
            self.configure(drive)
        self.start()
        self.enable()
        self.move()
        self.stop()
        return self.frames

    def put(self, can_id, data, by_node=None):
        self.frames.append((self.t, can_id, bytes(data), by_node))
        self.t += MS // 8

    def wait(self, ms):
        until = self.t + round(ms * MS)
        while self.t < until:
            self.t = min(until, self.beat_t + 100 * MS)
            self.beat()

    def beat(self):
        if self.t - self.beat_t < 100 * MS:
            return
        self.beat_t = self.t
        self.master_beat()
        for drive in self.drives.values():
            if drive.beats and drive.nmt:
                self.put(0x700 + drive.node_id, [drive.nmt], True)

    def master_beat(self):
        self.put(0x700 + MASTER, [5])

    def boot(self, drive):
        drive.nmt = 0x7F
        self.put(0x700 + drive.node_id, [0], True)

    def nmt(self, command, node_id):
        self.put(0, [command, node_id])
        for drive in self.drives.values():
            if node_id in (0, drive.node_id):
                drive.nmt = {1: 5, 2: 4, 0x80: 0x7F}.get(command, 0)

    def write(self, node_id, index, subindex, value, size, *, abort=None):
        size_bits = 0x23 | 4 - size << 2
        place = struct.pack("<HB", index, subindex)
        self.put(0x600 + node_id, bytes([size_bits]) + place + (value & (1 << 8 * size) - 1).to_bytes(4, "little"))
        if abort is not None:
            self.put(0x580 + node_id, b"\x80" + place + struct.pack("<I", abort), True)
            return
        drive = self.drives[node_id]
        drive.values[index, subindex] = value
        if index == 0x6060:
            drive.values[0x6061, 0] = value
        elif index == 0x6040:
            drive.obey(value)
            drive.step()
        self.put(0x580 + node_id, b"\x60" + place + bytes(4), True)

    def read(self, node_id, index, subindex, size, *, answered=True):
        place = struct.pack("<HB", index, subindex)
        self.put(0x600 + node_id, b"\x40" + place + bytes(4))
        if answered:
            self.answer(node_id, index, subindex, size)

    def answer(self, node_id, index, subindex, size):
        value = self.drives[node_id].values.get((index, subindex), 0) & (1 << 8 * size) - 1
        head = bytes([0x43 | 4 - size << 2]) + struct.pack("<HB", index, subindex)
        self.put(0x580 + node_id, head + value.to_bytes(4, "little"), True)

    def emcy(self, node_id, code):
        self.put(0x80 + node_id, struct.pack("<HB5x", code, 1 if code else 0), True)

    # a cycle

    def sync(self):
        self.put(0x80, b"")

    def cycle(self, words=None, targets=None):
        begin = self.t
        self.sync()
        for drive in self.drives.values():
            if drive.node_id in self.absent or drive.nmt != 5:
                continue
            drive.step()
            if drive.reports:
                torque = struct.pack("<Hih", drive.values[0x6041, 0], drive.position, 0)
                self.put(0x180 + drive.node_id, torque, True)
        for drive in self.drives.values():
            if drive.node_id not in self.absent:
                word = (words or {}).get(drive.node_id, drive.word)
                self.send(drive, word, (targets or {}).get(drive.node_id, drive.target))
        self.beat()
        self.t = max(begin + self.period(), self.t)
        self.count += 1

    def period(self):
        return PERIOD

    def send(self, drive, word, target):
        self.put(0x200 + drive.node_id, struct.pack("<Hi", word, target))
        if drive.nmt == 5:
            drive.obey(word)
            drive.target = target

    def hold(self, cycles, word=None):
        for _ in range(cycles):
            self.cycle({} if word is None else dict.fromkeys(self.nodes, word))

    def go(self, cycles, way=None):
        for _ in range(cycles):
            self.cycle(targets={n: d.target + (way or self.way) for n, d in self.drives.items()})

    def configure(self, drive):
        node_id = drive.node_id
        self.write(node_id, 0x1017, 0, 100, 2)
        if self.watch:
            self.write(node_id, 0x1016, 1, MASTER << 16 | 250, 4)
            self.write(node_id, 0x1006, 0, PERIOD // 1000, 4)
        self.write(node_id, 0x60C2, 1, 10 if self.cycle_time else 2, 1)
        self.write(node_id, 0x60C2, 2, -3, 1)
        self.set_mode(node_id, self.mode)
        self.read(node_id, 0x6064, 0, 4)

    def set_mode(self, node_id, mode):
        self.write(node_id, 0x6060, 0, mode, 1)
        self.read(node_id, 0x6061, 0, 1)

    def start(self):
        for node_id in self.nodes:
            if node_id not in self.absent:
                self.nmt(1, node_id)
        self.wait(220)
        self.hold(5, 0)

    def enable(self):
        for word in (6, 7, 15):
            self.hold(5, word)

    def move(self):
        self.go(self.steps)

    def stop(self):
        self.hold(20)
        self.hold(5, 2)
        self.hold(5, 0)
        for node_id in self.nodes:
            self.nmt(0x80, node_id)
        self.wait(300)


class TargetElsewhere(Master):
    numbers = (1,)

    def enable(self):
        self.hold(5, 6)
        self.hold(5, 7)
        self.cycle({1: 15}, {1: 15_000})


class SpeedSet(Master):
    numbers, mode, way = (2,), 9, 0

    def enable(self):
        self.write(1, 0x60FF, 0, 500, 4)
        super().enable()


class TorqueSet(SpeedSet):
    mode = 10

    def enable(self):
        self.write(1, 0x6071, 0, -20, 2)
        Master.enable(self)


class SetpointFirst(Master):
    numbers, mode = (3,), 1

    def move(self):
        for target in (5000, 5500, 6000):
            self.cycle({1: 0x1F})
            self.cycle({1: 0x1F}, {1: target})
            self.hold(3, 15)


class ModeUnread(Master):
    numbers = (4,)

    def set_mode(self, node_id, mode):
        self.write(node_id, 0x6060, 0, mode, 1)


class ModeRefused(Master):
    numbers = (4,)

    def set_mode(self, node_id, mode):
        self.write(node_id, 0x6060, 0, mode, 1)
        self.drives[node_id].values[0x6061, 0] = 1
        self.read(node_id, 0x6061, 0, 1)


class ModeInMotion(Master):
    numbers = (5,)

    def move(self):
        self.go(30)
        self.set_mode(1, 1)


class ZerosFirst(Master):
    numbers = (6,)

    def start(self):
        self.nmt(1, 1)
        self.wait(220)
        self.cycle({1: 0}, {1: 0})
        self.cycle({1: 0}, {1: 5000})


class ZerosUnseen(ZerosFirst):
    def configure(self, drive):
        super().configure(drive)
        del self.frames[-2:]  # the read of 6064h


class ZeroMode(Master):
    numbers = (6,)

    def configure(self, drive):
        super().configure(drive)
        self.write(1, 0x1400, 1, 0x80000201, 4)
        self.write(1, 0x1600, 0, 0, 1)
        for subindex, word in enumerate((0x60400010, 0x60600008, 0x607A0020), 1):
            self.write(1, 0x1600, subindex, word, 4)
        self.write(1, 0x1600, 0, 3, 1)
        self.write(1, 0x1400, 1, 0x201, 4)

    def send(self, drive, word, target):
        mode = 8 if self.count else 0
        self.put(0x201, struct.pack("<Hbi", word, mode, target))
        drive.obey(word)
        drive.target = target

    def start(self):
        super().start()
        self.read(1, 0x6061, 0, 1)


class SaysNothing(Master):
    numbers = (7,)

    def configure(self, drive):
        super().configure(drive)
        self.read(1, 0x1400, 1, 4)
        self.drives[1].values[0x1400, 1] = 0x201

    def read(self, node_id, index, subindex, size, *, answered=True):
        self.drives[node_id].values.setdefault((0x1400, 1), 0x201)
        super().read(node_id, index, subindex, size, answered=answered)

    def send(self, drive, word, target):
        pass

    def stop(self):
        self.hold(100)


class Blind(Master):
    numbers = (8,)

    def enable(self):
        for word in (6, 7, 15):
            self.write(1, 0x6040, 0, word, 2)
        self.hold(5, 15)


class HoldsReset(Master):
    numbers = (9,)

    def move(self):
        self.drives[1].state, self.drives[1].stuck = FAULT, True
        self.hold(3, 0)
        self.hold(80, 0x80)


class ResetsForEver(Master):
    numbers = (10,)

    def move(self):
        self.drives[1].state, self.drives[1].stuck = FAULT, True
        for _ in range(6):
            self.hold(5, 0)
            self.hold(5, 0x80)


class LeavesStop(Master):
    numbers = (11,)

    def move(self):
        self.go(20)
        self.hold(5)
        self.drives[1].state = QUICK
        self.hold(20, 15)


class HomesTwice(Master):
    numbers, mode = (13,), 6

    def move(self):
        for _ in range(2):
            self.hold(10, 0x1F)
            self.hold(3, 15)


class HomesBlind(Master):
    numbers = (14,)

    def move(self):
        self.write(1, 0x6060, 0, 6, 1)
        self.hold(5, 0x1F)
        self.hold(3, 15)


class HomesWithoutEdge(Master):
    numbers = (14,)

    def move(self):
        self.hold(5, 0x1F)
        self.set_mode(1, 6)
        self.hold(80, 0x1F)
        self.hold(3, 15)


class FaultPassedOver(Master):
    numbers = (15,)

    def move(self):
        self.go(20)
        self.drives[1].state, self.drives[1].stuck = FAULT, True
        self.emcy(1, 0x2310)
        self.go(70)


class EmcyPassedOver(FaultPassedOver):
    def move(self):
        self.go(20)
        self.emcy(1, 0x4310)
        self.go(70)


class FearsNoError(Master):
    numbers = (16,)

    def move(self):
        self.hold(10)
        self.emcy(1, 0)
        self.hold(5, 0)


class StopsMoving(Master):
    numbers = (17,)

    def stop(self):
        self.nmt(0x80, 1)
        self.drives[1].state = OFF
        self.wait(300)


class FallsSilentMoving(Master):
    numbers = (17,)

    def stop(self):
        for _ in range(50):
            self.t += PERIOD
            self.sync()
            drive = self.drives[1]
            drive.position += 100
            self.put(0x181, struct.pack("<Hih", ENABLED, drive.position, 0), True)
            self.beat()


class Unwatched(Master):
    numbers, watch = (18,), False


class HeartbeatPassedOver(Master):
    numbers = (19,)

    def move(self):
        self.go(20)
        self.drives[1].beats = False
        self.go(150)


class GoesWithout(Master):
    numbers, nodes, absent, steps = (20,), (1, 2), (2,), 250

    def boot(self, drive):
        if drive.node_id == 1:
            super().boot(drive)

    def configure(self, drive):
        if drive.node_id == 1:
            super().configure(drive)


class GoesWithoutAnswer(GoesWithout):
    def boot(self, drive):
        Master.boot(self, drive)
        drive.beats = False

    def configure(self, drive):
        if drive.node_id == 1:
            super().configure(drive)
        else:
            self.read(2, 0x1018, 1, 4, answered=False)


class BootPassedOver(Master):
    numbers = (21,)

    def move(self):
        self.hold(5)
        drive = self.drives[1]
        drive.state, drive.word, drive.values[0x6061, 0] = OFF, 0, 0
        self.boot(drive)
        self.start()
        self.enable()


class WaitsForEver(Master):
    numbers = (22,)

    def run(self):
        self.boot(self.drives[1])
        self.wait(6000)
        return self.frames


class ConfiguresLate(Master):
    numbers = (23,)

    def start(self):
        super().start()
        self.write(1, 0x1800, 5, 100, 2)


class ResetsAll(Master):
    numbers = (24,)

    def stop(self):
        self.hold(20)
        self.nmt(0x81, 0)


class RemapsValid(Master):
    numbers = (25,)

    def configure(self, drive):
        super().configure(drive)
        for subindex, word in enumerate((0x607A0020, 0x60400010), 1):
            self.write(1, 0x1600, subindex, word, 4)

    def send(self, drive, word, target):
        self.put(0x201, struct.pack("<iH", target, word))
        drive.obey(word)
        drive.target = target


class PassesAbortOver(Master):
    numbers = (26,)

    def configure(self, drive):
        super().configure(drive)
        self.write(1, 0x6085, 0, 5, 4, abort=0x06090030)


class WrongLength(Master):
    numbers = (27,)

    def configure(self, drive):
        super().configure(drive)
        drive.values |= {(0x1400, 1): 0x201, (0x1600, 0): 2}
        self.read(1, 0x1400, 1, 4)
        self.read(1, 0x1600, 0, 1)

    def send(self, drive, word, target):
        self.put(0x201, struct.pack("<Hi", word, target) + b"\0")
        drive.obey(word)
        drive.target = target


class TooShort(WrongLength):
    def send(self, drive, word, target):
        self.put(0x201, struct.pack("<Hi", word, target)[:5])


class Polls(Master):
    numbers = (28,)

    def move(self):
        for _ in range(60):
            self.cycle()
            self.t -= 2 * MS
            self.read(1, 0x6041, 0, 2)
            self.t = (self.t // PERIOD + 1) * PERIOD


class GivesUpAtOnce(Master):
    numbers = (29,)

    def configure(self, drive):
        super().configure(drive)
        self.read(1, 0x1018, 1, 4, answered=False)
        self.wait(3)
        self.put(0x601, b"\x80\x18\x10\x01" + struct.pack("<I", 0x05040000))
        self.wait(50)


class GivesUpTooSoon(Master):
    numbers = (29,)

    def configure(self, drive):
        super().configure(drive)
        for _ in range(2):
            self.read(1, 0x1018, 1, 4, answered=False)
            self.wait(60)
            self.put(0x601, b"\x80\x18\x10\x01" + struct.pack("<I", 0x05040000))
            self.wait(20)
            self.answer(1, 0x1018, 1, 4)


class NamelessAbort(Master):
    numbers = (30,)

    def configure(self, drive):
        super().configure(drive)
        self.read(1, 0x1018, 1, 4, answered=False)
        self.wait(600)
        self.put(0x601, b"\x80\0\0\0" + struct.pack("<I", 0x05040000))


class AbortsNothing(Master):
    """An abort long after the transfer is over."""

    numbers, named = (30,), b"\x18\x10\x01"

    def configure(self, drive):
        super().configure(drive)
        self.read(1, 0x1018, 1, 4)
        self.wait(300)
        self.put(0x601, b"\x80" + self.named + struct.pack("<I", 0x05040000))


class AbortsNamelessAtOnce(AbortsNothing):
    def wait(self, ms):
        if ms != 300:
            super().wait(ms)

    named = b"\0\0\0"


class AsksTwice(Master):
    numbers = (31,)

    def configure(self, drive):
        super().configure(drive)
        self.read(1, 0x1018, 1, 4, answered=False)
        self.read(1, 0x1018, 2, 4)


class Jitters(Master):
    numbers, steps = (32,), 300

    def period(self):
        return PERIOD + (8 if self.count % 2 else -8) * MS // 10


class SkipsSyncs(Master):
    numbers = (33,)

    def period(self):
        return 2 * PERIOD if self.count % 10 == 0 and self.drives[1].state == ENABLED else PERIOD


class CountsWrong(Master):
    numbers = (33,)

    def sync(self):
        counted = self.count + self.count // 20
        self.put(0x80, [counted % 240 + 1])


class SendsTwice(Master):
    numbers = (34,)

    def send(self, drive, word, target):
        super().send(drive, word, target)
        if drive.state == ENABLED and self.count > 60:
            super().send(drive, word, target)


class SkipsRpdos(Master):
    numbers = (34,)

    def send(self, drive, word, target):
        if not 60 < self.count < 64:
            super().send(drive, word, target)


class SendsLate(Master):
    numbers = (35,)

    def configure(self, drive):
        super().configure(drive)
        self.write(1, 0x1007, 0, 2000, 4)

    def send(self, drive, word, target):
        self.t += 4 * MS
        super().send(drive, word, target)


class WrongTime(Master):
    numbers, cycle_time = (36,), False


class ByEvent(Master):
    numbers = (37,)

    def configure(self, drive):
        super().configure(drive)
        self.write(1, 0x1400, 1, 0x80000201, 4)
        self.write(1, 0x1400, 2, 255, 1)
        self.write(1, 0x1400, 1, 0x201, 4)
        drive.values[0x1600, 0] = 2
        self.read(1, 0x1600, 0, 1)


class Jumps(Master):
    numbers = (38,)

    def move(self):
        self.go(10)
        self.go(10, 3000)


class JumpsOnce(Master):
    numbers = (38,)

    def move(self):
        self.go(10)
        self.go(1, 20_000)


class LeavesRange(Master):
    numbers = (39,)

    def configure(self, drive):
        drive.values |= {(0x607D, 1): 0, (0x607D, 2): 10_000}
        super().configure(drive)
        self.read(1, 0x607D, 1, 4)
        self.read(1, 0x607D, 2, 4)


class LeavesAxisBehind(Master):
    numbers = (40,)

    def move(self):
        self.go(10)
        self.drives[1].bits |= 0x2000
        self.go(70)


class Halted(Master):
    numbers = (41,)

    def move(self):
        for _ in range(130):
            self.cycle({1: 0x10F}, {1: self.drives[1].target + 10})
        self.cycle({1: 0x10F}, {1: self.drives[1].position})


class ModeUnderHalt(Master):
    numbers = (41,)

    def move(self):
        self.hold(10, 0x10F)
        self.set_mode(1, 1)


class NeverStarts(Master):
    numbers = (42,)

    def run(self):
        self.boot(self.drives[1])
        self.configure(self.drives[1])
        self.wait(300)
        self.hold(50, 6)
        return self.frames


class Guards(Master):
    numbers = (43,)

    def move(self):
        for _ in range(4):
            self.hold(25)
            self.put(0x701 | 0x40000000, b"")
            self.put(0x701, [5 | 0x80], True)


class SpeaksAsNode(Master):
    numbers = (44,)

    def move(self):
        for _ in range(3):
            self.hold(10)
            self.put(0x701, [5], False)


class TwoSyncs(Master):
    numbers = (44,)

    def sync(self):
        self.put(0x80, [self.count // 2 % 240 + 1] if self.count % 2 else b"")


class SendsBacklog(Master):
    numbers = (45,)

    def move(self):
        self.go(20)
        self.t += 6 * PERIOD
        self.sync()
        for _ in range(4):
            self.send(self.drives[1], 15, self.drives[1].target)
        self.t = (self.t // PERIOD + 1) * PERIOD


class MutePassedOver(Master):
    numbers, nodes = (46,), (1, 2)

    def move(self):
        self.go(20)
        drive = self.drives[2]
        drive.beats = drive.reports = False
        for _ in range(150):
            self.cycle({2: 2}, {1: self.drives[1].target + 100})


class DrivesMuteAxis(Master):
    """The only axis says nothing any more, and its target goes on."""

    numbers = (19,)

    def move(self):
        self.go(20)
        self.drives[1].beats = self.drives[1].reports = False
        self.go(150)

    def stop(self):
        self.hold(20, 2)


class DrivesMuteAxisWithoutHeartbeat(DrivesMuteAxis):
    def configure(self, drive):
        super().configure(drive)
        self.write(drive.node_id, 0x1017, 0, 0, 2)
        drive.beats = False


class DrivesMuteSpeed(DrivesMuteAxis):
    """In CSV a target that stays is a motion; it comes by an RPDO beside the controlword's."""

    mode, way = 9, 0

    def configure(self, drive):
        super().configure(drive)
        self.write(1, 0x1401, 1, 0x80000301, 4)
        self.write(1, 0x1401, 2, 1, 1)
        self.write(1, 0x1601, 0, 0, 1)
        self.write(1, 0x1601, 1, 0x60FF0020, 4)
        self.write(1, 0x1601, 0, 1, 1)
        self.write(1, 0x1401, 1, 0x301, 4)

    def send(self, drive, word, target):
        self.put(0x301, struct.pack("<i", 500 if word == 15 and drive.state == ENABLED else 0))
        super().send(drive, word, drive.position)


class KeepsMuteAxisEnabled(DrivesMuteAxis):
    """The target stays, and the controlword goes on to enable the axis that nobody sees."""

    def move(self):
        self.go(20)
        self.drives[1].beats = self.drives[1].reports = False
        self.hold(160)


class CutsPower(Master):
    numbers = (47,)

    def stop(self):
        self.hold(1, 0)
        self.hold(5, 0)
        self.nmt(0x80, 1)


class Starves(Master):
    numbers = (48,)

    def master_beat(self):
        if not 1500 * MS < self.t < 1900 * MS:
            super().master_beat()


class Careful(Master):
    """Base of masters that do something else than the first one, and do it right."""

    numbers = ()


class SetpointsBySdo(Careful):
    """Profile position without RPDOs, SYNC or NMT start: all by SDO."""

    mode = 1

    def configure(self, drive):
        self.write(1, 0x1016, 1, MASTER << 16 | 250, 4)
        self.set_mode(1, 1)

    def start(self):
        pass

    def word(self, word):
        self.write(1, 0x6040, 0, word, 2)
        self.wait(20)
        self.read(1, 0x6041, 0, 2)

    def enable(self):
        self.wait(200)
        for word in (6, 7, 15):
            self.word(word)

    def move(self):
        for target in (6000, 7000, 6500):
            self.write(1, 0x607A, 0, target, 4)
            self.drives[1].target = target
            self.word(0x1F)
            self.word(0x0F)
            self.wait(500)

    def stop(self):
        self.word(2)
        self.word(0)


class Velocities(Careful):
    """CSV: 0 at enable, then a velocity by SDO, then 0 again."""

    mode, way = 9, 0

    def enable(self):
        self.write(1, 0x60FF, 0, 0, 4)
        super().enable()

    def move(self):
        for speed in (1000, 2000, 0):
            self.write(1, 0x60FF, 0, speed, 4)
            self.hold(40)


class HomesOnce(Careful):
    """Homes the axis in its mode, by an edge, and goes on in CSP."""

    mode = 6

    def move(self):
        self.hold(10, 0x1F)
        self.hold(5, 15)
        self.drives[1].bits = 0
        self.set_mode(1, 8)
        self.go(50)


class Recovers(Careful):
    """After a fault it holds the target, resets once, and enables again at the place of the axis."""

    def move(self):
        self.go(30)
        drive = self.drives[1]
        drive.state = FAULT
        self.emcy(1, 0x2310)
        self.hold(20)
        self.hold(5, 0)
        self.hold(5, 0x80)
        drive.target = drive.position
        self.emcy(1, 0)
        self.enable()
        self.go(30)


class BringsUpAnew(Careful):
    """A node that boots by itself is configured and started from the beginning."""

    def move(self):
        self.go(30)
        drive = self.drives[1]
        drive.state, drive.word, drive.values[0x6061, 0] = OFF, 0, 0
        self.boot(drive)
        self.wait(150)
        self.configure(drive)
        self.start()
        self.enable()
        self.go(20)


class StopsAll(Careful):
    """One axis falls silent: the other ramps down and is disabled."""

    nodes = (1, 2)

    def move(self):
        self.go(20)
        self.drives[2].beats = self.drives[2].reports = False
        way = 100
        for cycle in range(60):
            way = way if cycle < 25 else max(0, way - 10)
            self.cycle(targets={1: self.drives[1].target + way})


class RemapsRightly(Careful):
    """Swaps the entries of the RPDO, disabled and emptied first; 6061h comes by TPDO 2."""

    def configure(self, drive):
        super().configure(drive)
        self.write(1, 0x1400, 1, 0x80000201, 4)
        self.write(1, 0x1600, 0, 0, 1)
        for subindex, word in enumerate((0x607A0020, 0x60400010), 1):
            self.write(1, 0x1600, subindex, word, 4)
        self.write(1, 0x1600, 0, 2, 1)
        self.write(1, 0x1400, 1, 0x201, 4)

    def send(self, drive, word, target):
        self.put(0x201, struct.pack("<iH", target, word))
        drive.obey(word)
        drive.target = target


class AbortsAnswered(Careful):
    """An abort that crosses the answer on the bus."""

    def configure(self, drive):
        super().configure(drive)
        self.read(1, 0x1018, 1, 4)
        self.put(0x601, b"\x80\x18\x10\x01" + struct.pack("<I", 0x05040000))


class SkipsNow(Careful):
    """One lost RPDO, one late SYNC, one repeated request after a time-out: what happens on any bus."""

    def configure(self, drive):
        super().configure(drive)
        self.read(1, 0x1018, 1, 4, answered=False)
        self.wait(500)
        self.put(0x601, b"\x80\x18\x10\x01" + struct.pack("<I", 0x05040000))
        self.read(1, 0x1018, 1, 4)

    def send(self, drive, word, target):
        if self.count % 70:
            super().send(drive, word, target)

    def period(self):
        return PERIOD + 6 * MS if self.count == 100 else PERIOD


class LongTransfers(Careful):
    """Reads a name in segments and as a block, and writes in segments, before it goes to work."""

    def configure(self, drive):
        super().configure(drive)
        place = b"\x08\x10\x00"
        self.put(0x601, b"\x40" + place + bytes(4))
        self.put(0x581, b"\x41" + place + b"\x09\0\0\0", True)
        for request, answer in ((b"\x60", b"\x00canprob"), (b"\x70", b"\x1be!\0\0\0\0\0")):
            self.put(0x601, request + bytes(7))
            self.put(0x581, answer, True)
        self.put(0x601, b"\xa4" + place + b"\x7f\0\0\0")
        self.put(0x581, b"\xc6" + place + b"\x09\0\0\0", True)
        self.put(0x601, b"\xa3" + bytes(7))
        self.put(0x581, b"\x01\x40\x40\x40\x40\x40\x40\x40", True)
        self.put(0x581, b"\x82\x40\x40\0\0\0\0\0", True)
        self.put(0x601, b"\xa2\x02\x7f" + bytes(5))
        self.put(0x581, b"\xd5" + bytes(7), True)
        self.put(0x601, b"\xa1" + bytes(7))
        self.put(0x601, b"\x21\x10\x20\x00\x09\0\0\0")
        self.put(0x581, b"\x60\x10\x20\x00" + bytes(4), True)
        for request, answer in ((b"\x00\x40\x40\x40\x40\x40\x40\x40", b"\x20"), (b"\x1b\x40\x40\0\0\0\0\0", b"\x30")):
            self.put(0x601, request)
            self.put(0x581, answer + bytes(7), True)


class SplitRpdos(Careful):
    """The controlword by event, the target with SYNC: two RPDOs."""

    def configure(self, drive):
        super().configure(drive)
        for number, kind, word in ((0, 255, 0x60400010), (1, 1, 0x607A0020)):
            cob_id = 0x201 + 0x100 * number
            self.write(1, 0x1400 + number, 1, 0x80000000 | cob_id, 4)
            self.write(1, 0x1400 + number, 2, kind, 1)
            self.write(1, 0x1600 + number, 0, 0, 1)
            self.write(1, 0x1600 + number, 1, word, 4)
            self.write(1, 0x1600 + number, 0, 1, 1)
            self.write(1, 0x1400 + number, 1, cob_id, 4)
        self.sent = None

    def send(self, drive, word, target):
        if word != self.sent or self.count % 10 == 0:
            self.put(0x201, struct.pack("<H", word))
            self.sent = word
        self.put(0x301, struct.pack("<i", target))
        drive.obey(word)
        drive.target = target


def all_masters(master=Master):
    """All classes but the first, good and bad."""
    for one in master.__subclasses__():
        yield one
        yield from all_masters(one)
