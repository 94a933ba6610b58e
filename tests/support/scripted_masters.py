"""Masters written by hand as frames, and a drive as simple as it can be: nothing of canprobe's.

`Master` does everything right, and so does each one without a number in another way. Every other one does one thing
wrong, that of the rule whose number it has. What each does otherwise is a row of steps, `do.METHOD(…)` of `Master`.
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
        self.nmt, self.beats, self.reports, self.stuck = 0, True, True, False

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


class Steps:
    """`do.go(20)` is the step that calls `go(20)` of a master."""

    def __getattr__(self, name):
        return lambda *args, **options: lambda master: getattr(master, name)(*args, **options)


do = Steps()
ENABLE = (do.hold(5, 6), do.hold(5, 7), do.hold(5, 15))
MASTERS = []


class Master:
    """Does everything right: configures, starts, enables, moves, stops. Subclasses do one thing otherwise."""

    number = None
    nodes = (1,)
    absent = ()
    mode, steps, way = 8, 150, 100
    watch = cycle_time = heard = True
    send_delay = 0
    running = (do.boot_all(), do.configure_all(), do.start(), do.enable(), do.move(), do.stop())
    configuring = ()
    starting, enabling, moving = (do.hold(5, 0),), ENABLE, (do.go(),)
    stopping = (do.hold(20), do.hold(5, 2), do.hold(5, 0), do.leave())

    def __init_subclass__(cls):
        MASTERS.append(cls)

    def __init__(self):
        self.t, self.frames, self.beat_t, self.count = 0, [], 0, 0
        self.drives = {node_id: Drive(node_id) for node_id in self.nodes}

    def act(self, steps):
        for step in steps:
            step(self)

    def run(self):
        self.act(self.running)
        return self.frames

    def put(self, can_id, data, by_node=None):
        self.frames.append((self.t, can_id, bytes(data), by_node))
        self.t += MS // 8

    def unseen(self, count):
        """The last frames were not recorded."""
        del self.frames[-count:]

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

    # what happens to a drive

    def drive(self, node_id, **values):
        for name, value in values.items():
            setattr(self.drives[node_id], name, value)

    def know(self, values):
        self.drives[1].values |= values

    def stay(self, node_id):
        self.drives[node_id].target = self.drives[node_id].position

    def boot(self, node_id):
        self.drives[node_id].nmt = 0x7F
        self.put(0x700 + node_id, [0], True)

    def reboot(self, node_id):
        self.drive(node_id, state=OFF, word=0)
        self.drives[node_id].values[0x6061, 0] = 0
        self.boot(node_id)

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
                for _ in range(self.copies(drive)):
                    self.send(drive, word, (targets or {}).get(drive.node_id, drive.target))
        self.beat()
        self.t = max(begin + self.period(), self.t)
        self.count += 1

    def period(self):
        return PERIOD

    def copies(self, drive):
        return 1

    def pack(self, word, target):
        return struct.pack("<Hi", word, target)

    def send(self, drive, word, target):
        self.t += self.send_delay
        self.put(0x200 + drive.node_id, self.pack(word, target))
        if drive.nmt == 5 and self.heard:
            drive.obey(word)
            drive.target = target

    def hold(self, cycles, word=None):
        for _ in range(cycles):
            self.cycle({} if word is None else dict.fromkeys(self.nodes, word))

    def go(self, cycles=None, way=None, *, words=None, nodes=None):
        way = self.way if way is None else way
        for _ in range(cycles or self.steps):
            self.cycle(words, {n: self.drives[n].target + way for n in nodes or self.nodes})

    # the parts of its work

    def boot_all(self):
        for node_id in self.nodes:
            self.boot(node_id)

    def configure_all(self):
        for node_id in self.nodes:
            self.configure(node_id)

    def configure(self, node_id):
        self.write(node_id, 0x1017, 0, 100, 2)
        if self.watch:
            self.write(node_id, 0x1016, 1, MASTER << 16 | 250, 4)
            self.write(node_id, 0x1006, 0, PERIOD // 1000, 4)
        self.write(node_id, 0x60C2, 1, 10 if self.cycle_time else 2, 1)
        self.write(node_id, 0x60C2, 2, -3, 1)
        self.set_mode(node_id, self.mode)
        self.read(node_id, 0x6064, 0, 4)
        self.act(self.configuring)

    def set_mode(self, node_id, mode):
        self.write(node_id, 0x6060, 0, mode, 1)
        self.read(node_id, 0x6061, 0, 1)

    def start(self):
        for node_id in self.nodes:
            if node_id not in self.absent:
                self.nmt(1, node_id)
        self.wait(220)
        self.act(self.starting)

    def enable(self):
        self.act(self.enabling)

    def move(self):
        self.act(self.moving)

    def stop(self):
        self.act(self.stopping)

    def leave(self):
        for node_id in self.nodes:
            self.nmt(0x80, node_id)
        self.wait(300)

    def command(self, word):
        """A controlword by SDO."""
        self.write(1, 0x6040, 0, word, 2)
        self.wait(20)
        self.read(1, 0x6041, 0, 2)


UNANSWERED = do.read(1, 0x1018, 1, 4, answered=False)
ANSWERED = do.read(1, 0x1018, 1, 4)
TIMED_OUT = struct.pack("<I", 0x05040000)
ABORT, NAMELESS_ABORT = (do.put(0x601, head + TIMED_OUT) for head in (b"\x80\x18\x10\x01", b"\x80\0\0\0"))
STUCK_FAULT, MUTE = do.drive(1, state=FAULT, stuck=True), do.drive(1, beats=False, reports=False)
TARGET_FIRST = (0x607A0020, 0x60400010)


def remap(number, words, kind=None):
    """Steps that map an RPDO of node 1 as one should: off, empty, its entries, their number, on."""
    parameters, mapping, cob_id = 0x1400 + number, 0x1600 + number, 0x201 + 0x100 * number
    return (
        do.write(1, parameters, 1, 0x80000000 | cob_id, 4),
        *([] if kind is None else [do.write(1, parameters, 2, kind, 1)]),
        do.write(1, mapping, 0, 0, 1),
        *(do.write(1, mapping, subindex, word, 4) for subindex, word in enumerate(words, 1)),
        do.write(1, mapping, 0, len(words), 1),
        do.write(1, parameters, 1, cob_id, 4),
    )


def pack_target_first(master, word, target):
    return struct.pack("<iH", target, word)


def scripted(name, number=None, base=Master, **own):
    """A master with other attributes and methods; one without a number is good."""
    return type(name, (base,), own if number is None else {"number": number, **own})


# masters with one fault

TargetElsewhere = scripted(
    "TargetElsewhere", 1, enabling=(do.hold(5, 6), do.hold(5, 7), do.cycle({1: 15}, {1: 15_000}))
)
scripted("SpeedSet", 2, mode=9, way=0, enabling=(do.write(1, 0x60FF, 0, 500, 4), *ENABLE))
scripted("TorqueSet", 2, mode=10, way=0, enabling=(do.write(1, 0x6071, 0, -20, 2), *ENABLE))
SETPOINTS = [(do.cycle({1: 0x1F}), do.cycle({1: 0x1F}, {1: n}), do.hold(3, 15)) for n in (5000, 5500, 6000)]
scripted("SetpointFirst", 3, mode=1, moving=sum(SETPOINTS, ()))
scripted("ModeUnread", 4, set_mode=lambda master, node_id, mode: master.write(node_id, 0x6060, 0, mode, 1))


class ModeRefused(Master):
    number = 4

    def set_mode(self, node_id, mode):
        self.write(node_id, 0x6060, 0, mode, 1)
        self.drives[node_id].values[0x6061, 0] = 1
        self.read(node_id, 0x6061, 0, 1)


ZEROS = (do.cycle({1: 0}, {1: 0}), do.cycle({1: 0}, {1: 5000}))
scripted("ModeInMotion", 5, moving=(do.go(30), do.set_mode(1, 1)))
scripted("ZerosFirst", 6, starting=ZEROS)
scripted("ZerosUnseen", 6, starting=ZEROS, configuring=(do.unseen(2),))  # the read of 6064h


class ZeroMode(Master):
    number = 6
    configuring = remap(0, (0x60400010, 0x60600008, 0x607A0020))
    starting = (do.hold(5, 0), do.read(1, 0x6061, 0, 1))

    def pack(self, word, target):
        return struct.pack("<Hbi", word, 8 if self.count else 0, target)


KNOWN_RPDO = (do.know({(0x1400, 1): 0x201}), do.read(1, 0x1400, 1, 4))
HOMES = (do.hold(10, 0x1F), do.hold(3, 15))
scripted("SaysNothing", 7, copies=lambda *_: 0, configuring=KNOWN_RPDO, stopping=(do.hold(100),))
scripted("Blind", 8, enabling=(*(do.write(1, 0x6040, 0, word, 2) for word in (6, 7, 15)), do.hold(5, 15)))
scripted("HoldsReset", 9, moving=(STUCK_FAULT, do.hold(3, 0), do.hold(80, 0x80)))
scripted("ResetsForEver", 10, moving=(STUCK_FAULT, *6 * (do.hold(5, 0), do.hold(5, 0x80))))
scripted("LeavesStop", 11, moving=(do.go(20), do.hold(5), do.drive(1, state=QUICK), do.hold(20, 15)))
scripted("HomesTwice", 13, mode=6, moving=2 * HOMES)
scripted("HomesBlind", 14, moving=(do.write(1, 0x6060, 0, 6, 1), do.hold(5, 0x1F), do.hold(3, 15)))
scripted("HomesWithoutEdge", 14, moving=(do.hold(5, 0x1F), do.set_mode(1, 6), do.hold(80, 0x1F), do.hold(3, 15)))
scripted("FaultPassedOver", 15, moving=(do.go(20), STUCK_FAULT, do.emcy(1, 0x2310), do.go(70)))
scripted("EmcyPassedOver", 15, moving=(do.go(20), do.emcy(1, 0x4310), do.go(70)))
scripted("FearsNoError", 16, moving=(do.hold(10), do.emcy(1, 0), do.hold(5, 0)))
scripted("StopsMoving", 17, stopping=(do.nmt(0x80, 1), do.drive(1, state=OFF), do.wait(300)))


class FallsSilentMoving(Master):
    number = 17

    def stop(self):
        for _ in range(50):
            self.t += PERIOD
            self.sync()
            drive = self.drives[1]
            drive.position += 100
            self.put(0x181, struct.pack("<Hih", ENABLED, drive.position, 0), True)
            self.beat()


scripted("Unwatched", 18, watch=False)
scripted("HeartbeatPassedOver", 19, moving=(do.go(20), do.drive(1, beats=False), do.go(150)))


class GoesWithout(Master):
    number, nodes, absent, steps = 20, (1, 2), (2,), 250

    def boot(self, node_id):
        if node_id == 1:
            super().boot(node_id)

    def configure(self, node_id):
        if node_id == 1:
            super().configure(node_id)


class GoesWithoutAnswer(GoesWithout):
    def boot(self, node_id):
        Master.boot(self, node_id)
        self.drive(node_id, beats=False)

    def configure(self, node_id):
        super().configure(node_id)
        if node_id == 2:
            self.read(2, 0x1018, 1, 4, answered=False)


SWAPPED = tuple(do.write(1, 0x1600, subindex, word, 4) for subindex, word in enumerate(TARGET_FIRST, 1))
KNOWN_MAPPING = (do.know({(0x1600, 0): 2}), *KNOWN_RPDO, do.read(1, 0x1600, 0, 1))
scripted("BootPassedOver", 21, moving=(do.hold(5), do.reboot(1), do.start(), do.enable()))
scripted("WaitsForEver", 22, running=(do.boot(1), do.wait(6000)))
scripted("ConfiguresLate", 23, starting=(do.hold(5, 0), do.write(1, 0x1800, 5, 100, 2)))
scripted("ResetsAll", 24, stopping=(do.hold(20), do.nmt(0x81, 0)))
scripted("RemapsValid", 25, configuring=SWAPPED, pack=pack_target_first)
scripted("PassesAbortOver", 26, configuring=(do.write(1, 0x6085, 0, 5, 4, abort=0x06090030),))
scripted("WrongLength", 27, configuring=KNOWN_MAPPING, pack=lambda *row: Master.pack(*row) + b"\0")
scripted("TooShort", 27, configuring=KNOWN_MAPPING, pack=lambda *row: Master.pack(*row)[:5], heard=False)


class Polls(Master):
    number = 28

    def move(self):
        for _ in range(60):
            self.cycle()
            self.t -= 2 * MS
            self.read(1, 0x6041, 0, 2)
            self.t = (self.t // PERIOD + 1) * PERIOD


LATE_ANSWER = (UNANSWERED, do.wait(60), ABORT, do.wait(20), do.answer(1, 0x1018, 1, 4))
scripted("GivesUpAtOnce", 29, configuring=(UNANSWERED, do.wait(3), ABORT, do.wait(50)))
scripted("GivesUpTooSoon", 29, configuring=2 * LATE_ANSWER)
scripted("NamelessAbort", 30, configuring=(UNANSWERED, do.wait(600), NAMELESS_ABORT))
scripted("AbortsNothing", 30, configuring=(ANSWERED, do.wait(300), ABORT))  # long after the transfer is over
scripted("AbortsNamelessAtOnce", 30, configuring=(ANSWERED, NAMELESS_ABORT))
scripted("AsksTwice", 31, configuring=(UNANSWERED, do.read(1, 0x1018, 2, 4)))
scripted("Jitters", 32, steps=300, period=lambda master: PERIOD + (8 if master.count % 2 else -8) * MS // 10)


class SkipsSyncs(Master):
    number = 33

    def period(self):
        return 2 * PERIOD if self.count % 10 == 0 and self.drives[1].state == ENABLED else PERIOD


class SendsTwice(Master):
    number = 34

    def send(self, drive, word, target):
        super().send(drive, word, target)
        if drive.state == ENABLED and self.count > 60:
            super().send(drive, word, target)


BY_EVENT = (do.write(1, 0x1400, 1, 0x80000201, 4), do.write(1, 0x1400, 2, 255, 1), do.write(1, 0x1400, 1, 0x201, 4))
RANGE = (do.know({(0x607D, 1): 0, (0x607D, 2): 10_000}), do.read(1, 0x607D, 1, 4), do.read(1, 0x607D, 2, 4))
HALTED = (do.go(130, 10, words={1: 0x10F}), do.stay(1), do.hold(1, 0x10F))
GUARDS = (do.hold(25), do.put(0x701 | 0x40000000, b""), do.put(0x701, [5 | 0x80], True))
scripted("CountsWrong", 33, sync=lambda master: master.put(0x80, [(master.count + master.count // 20) % 240 + 1]))
scripted("SkipsRpdos", 34, copies=lambda master, _: 0 if 60 < master.count < 64 else 1)
scripted("SendsLate", 35, configuring=(do.write(1, 0x1007, 0, 2000, 4),), send_delay=4 * MS)
scripted("WrongTime", 36, cycle_time=False)
scripted("ByEvent", 37, configuring=(*BY_EVENT, do.know({(0x1600, 0): 2}), do.read(1, 0x1600, 0, 1)))
scripted("Jumps", 38, moving=(do.go(10), do.go(10, 3000)))
scripted("JumpsOnce", 38, moving=(do.go(10), do.go(1, 20_000)))
scripted("LeavesRange", 39, configuring=RANGE)
scripted("LeavesAxisBehind", 40, moving=(do.go(10), do.drive(1, bits=0x2000), do.go(70)))
scripted("Halted", 41, moving=HALTED)
scripted("ModeUnderHalt", 41, moving=(do.hold(10, 0x10F), do.set_mode(1, 1)))
scripted("NeverStarts", 42, running=(do.boot(1), do.configure(1), do.wait(300), do.hold(50, 6)))
scripted("Guards", 43, moving=4 * GUARDS)
scripted("SpeaksAsNode", 44, moving=3 * (do.hold(10), do.put(0x701, [5], False)))


class TwoSyncs(Master):
    number = 44

    def sync(self):
        self.put(0x80, [self.count // 2 % 240 + 1] if self.count % 2 else b"")


class SendsBacklog(Master):
    number = 45

    def move(self):
        self.go(20)
        self.t += 6 * PERIOD
        self.sync()
        for _ in range(4):
            self.send(self.drives[1], 15, self.drives[1].target)
        self.t = (self.t // PERIOD + 1) * PERIOD


MutePassedOver = scripted(
    "MutePassedOver", 46, nodes=(1, 2),
    moving=(do.go(20), do.drive(2, beats=False, reports=False), do.go(150, words={2: 2}, nodes=(1,))),
)  # fmt: skip
# the only axis says nothing any more, and its target goes on
DrivesMuteAxis = scripted("DrivesMuteAxis", 19, moving=(do.go(20), MUTE, do.go(150)), stopping=(do.hold(20, 2),))
BEATLESS = (do.write(1, 0x1017, 0, 0, 2), do.drive(1, beats=False))
scripted("DrivesMuteAxisWithoutHeartbeat", base=DrivesMuteAxis, configuring=BEATLESS)
# the target stays, and the controlword goes on to enable the axis that nobody sees
scripted("KeepsMuteAxisEnabled", base=DrivesMuteAxis, moving=(do.go(20), MUTE, do.hold(160)))


class DrivesMuteSpeed(DrivesMuteAxis):
    """In CSV a target that stays is a motion; it comes by an RPDO beside the controlword's."""

    mode, way = 9, 0
    configuring = remap(1, (0x60FF0020,), 1)

    def send(self, drive, word, target):
        self.put(0x301, struct.pack("<i", 500 if word == 15 and drive.state == ENABLED else 0))
        super().send(drive, word, drive.position)


scripted("CutsPower", 47, stopping=(do.hold(1, 0), do.hold(5, 0), do.nmt(0x80, 1)))


class Starves(Master):
    number = 48

    def master_beat(self):
        if not 1500 * MS < self.t < 1900 * MS:
            super().master_beat()


# good ones

SETPOINT = (do.command(0x1F), do.command(0x0F), do.wait(500))
PLACES = [(do.write(1, 0x607A, 0, n, 4), do.drive(1, target=n), *SETPOINT) for n in (6000, 7000, 6500)]
WITHOUT_RPDOS = (do.boot(1), do.write(1, 0x1016, 1, MASTER << 16 | 250, 4), do.set_mode(1, 1), do.wait(200))
RAMP = (do.go(25, nodes=(1,)), *(do.go(1, way, nodes=(1,)) for way in range(90, -1, -10)), do.go(25, 0, nodes=(1,)))
RECOVERY = (do.hold(20), do.hold(5, 0), do.hold(5, 0x80), do.stay(1), do.emcy(1, 0), do.enable(), do.go(30))
# profile position without RPDOs, SYNC or NMT start: all by SDO
scripted("SetpointsBySdo", running=(
    *WITHOUT_RPDOS, *(do.command(word) for word in (6, 7, 15)), *sum(PLACES, ()), do.command(2), do.command(0)
))  # fmt: skip
# CSV: 0 at enable, then a velocity by SDO, then 0 again
scripted("Velocities", mode=9, way=0, enabling=(do.write(1, 0x60FF, 0, 0, 4), *ENABLE), moving=sum(
    [(do.write(1, 0x60FF, 0, speed, 4), do.hold(40)) for speed in (1000, 2000, 0)], ()
))  # fmt: skip
# homes the axis in its mode, by an edge, and goes on in CSP
scripted("HomesOnce", mode=6, moving=(
    do.hold(10, 0x1F), do.hold(5, 15), do.drive(1, bits=0), do.set_mode(1, 8), do.go(50)
))  # fmt: skip
# after a fault it holds the target, resets once, and enables again at the place of the axis
scripted("Recovers", moving=(do.go(30), do.drive(1, state=FAULT), do.emcy(1, 0x2310), *RECOVERY))
# a node that boots by itself is configured and started from the beginning
scripted("BringsUpAnew", moving=(
    do.go(30), do.reboot(1), do.wait(150), do.configure(1), do.start(), do.enable(), do.go(20)
))  # fmt: skip
# one axis falls silent: the other ramps down and is disabled
scripted("StopsAll", nodes=(1, 2), moving=(do.go(20), do.drive(2, beats=False, reports=False), *RAMP))
# swaps the entries of the RPDO, disabled and emptied first; 6061h comes by TPDO 2
scripted("RemapsRightly", configuring=remap(0, TARGET_FIRST), pack=pack_target_first)
# an abort that crosses the answer on the bus
scripted("AbortsAnswered", configuring=(ANSWERED, ABORT))
# one lost RPDO, one late SYNC, one repeated request after a time-out: what happens on any bus
scripted(
    "SkipsNow", configuring=(UNANSWERED, do.wait(500), ABORT, ANSWERED),
    copies=lambda master, _: 1 if master.count % 70 else 0,
    period=lambda master: PERIOD + 6 * MS if master.count == 100 else PERIOD,
)  # fmt: skip
TRANSFERS = """
601 40 081000       | 581 41 081000 09
601 60              | 581 00 63616E70726F62
601 70              | 581 1B 6521
601 A4 081000 7F    | 581 C6 081000 09
601 A3              | 581 01 40404040404040 | 581 82 4040
601 A2 02 7F        | 581 D5
601 A1              | 601 21 102000 09      | 581 60 102000
601 00 40404040404040 | 581 20
601 1B 4040         | 581 30
"""
"""A name that is read in segments and as a block, and a value that is written in segments."""
FRAMES = [frame.split() for line in TRANSFERS.splitlines() for frame in line.split("|") if frame.strip()]
scripted("LongTransfers", configuring=[
    do.put(int(can_id, 16), bytes.fromhex("".join(data)).ljust(8, b"\0"), can_id == "581" or None)
    for can_id, *data in FRAMES
])  # fmt: skip


class SplitRpdos(Master):
    """The controlword by event, the target with SYNC: two RPDOs."""

    configuring = (*remap(0, (0x60400010,), 255), *remap(1, (0x607A0020,), 1))
    sent = None

    def send(self, drive, word, target):
        if word != self.sent or self.count % 10 == 0:
            self.put(0x201, struct.pack("<H", word))
            self.sent = word
        self.put(0x301, struct.pack("<i", target))
        drive.obey(word)
        drive.target = target
