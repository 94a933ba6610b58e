"""`canprobe console`: lines that move the arm, and what ends a motion; the screen's keys as lines."""

import asyncio
import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import urllib.request

import numpy as np
import pytest
from makes import write_eds

import canprobe
from canprobe.cell.master.readings import READ_EVERY_NS
from canprobe.cell.scene.load import packaged_files
from canprobe.cell.tasks.guided_arm import LIFETIME_S
from canprobe.cli.console_words import Words
from canprobe.cli.hand_session import HandSession
from canprobe.errors import PlanError, UsageError
from canprobe.fieldbus.bus.system import system
from canprobe.fieldbus.eds.packaged import eds_path
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of

READY = [70.0, 65.0, 10.0, 0.0, 100.0, 0.0]
QUIET = {"bus.timed": False, "outputs.figures": False}


class Typist:
    """Types lines at times of the cell, s after the last thing that was waited for; no line is typed in real time."""

    def __init__(self, scene="puma260", path="puma260", **keys):
        self.said, self.states, self.script = [], [], iter(())
        cell = canprobe.open_cell(scene, QUIET | keys, bus="lockstep", to_home=True, observers=[self._observe])
        self.cell = cell
        self.session = HandSession(cell, self._show, path, paced=False)
        self.session.take = Words(self.session, self._typed, self._show).take

    def run(self, script):
        """Run a generator of what is typed; it gets (t_s) and yields a line, None for nothing, or ends the input."""
        self.script = script
        with self.cell:
            self.session.run()
        log = self.cell.session.cell.log.arrays()
        return log["t_s"], log.get("q_target_rad")

    def _show(self, what):
        (self.said if isinstance(what, str) else self.states).append(what)

    def _observe(self, observation):
        self.session.view.observe(observation)

    def _typed(self):
        try:
            line = next(self.script)
        except StopIteration:
            return b"", False
        return b"" if line is None else line.encode() + b"\n", True

    # parts of a script

    @property
    def t_s(self):
        return 1e-9 * self.session.view.seen.t_ns

    def wait(self, seconds, every=None, line="renew"):
        """Let time pass, with a line every so many seconds."""
        start = last = self.t_s
        while self.t_s - start < seconds:
            due = every is not None and self.t_s - last >= every
            last = self.t_s if due else last
            yield line if due else None

    def enabled(self):
        """The first yes of a session."""
        yield "enable"
        yield "yes"
        while not self.states or self.states[-1]["state"] != "holds":
            yield None

    def q(self):
        return np.degrees(self.session.view.seen.q)

    def heard(self, words):
        return [line for line in self.said if words in line]


def moving(t, q):
    """Times of cycles in which the targets move."""
    return t[1:][np.abs(np.diff(q, axis=0)).max(axis=1) > 0]


def powered(cell):
    nodes = cell.session.buses.world.nodes
    return [n for n in nodes if hasattr(n, "node") and state_of(n.node.dictionary.number(0x6041)) in POWERED_STATES]


def test_nothing_moves_before_a_yes_and_then_a_step_goes_its_way():
    typist, seen = Typist(), {}

    def script():
        yield "jog 3 +"
        yield from typist.wait(0.3)
        assert typist.states[-1]["state"] == "disabled" and typist.states[-1]["asks"].endswith("free to move?")
        yield "no"
        yield "yes"
        yield "jog 3 +"
        assert typist.heard("nothing was asked")
        yield from typist.enabled()
        seen["start"] = typist.q()
        yield "jog 3 +"
        yield from typist.wait(0.6, every=0.05)
        seen["step"] = typist.q()
        yield "step 10"
        yield "jog z -"
        yield from typist.wait(2.0, every=0.05)
        seen["tip"] = typist.cell.probe(np.radians(typist.q()))[0]
        yield "quit"

    typist.run(script())
    np.testing.assert_allclose(seen["step"] - seen["start"], [0, 0, 1, 0, 0, 0], atol=0.02)
    before = typist.cell.probe(np.radians(seen["step"]))[0]
    np.testing.assert_allclose(seen["tip"][:3, 3] - before[:3, 3], [0, 0, -0.01], atol=2e-4)


@pytest.mark.parametrize("speed", ["1%", "100%"])
def test_a_jog_goes_on_while_it_is_repeated_and_stands_150_ms_after_the_last_stroke(speed):
    typist, seen = Typist("free"), {}

    def script():
        yield from typist.enabled()
        yield f"speed {speed}"
        yield "step 0.1"
        yield "jog 2 -"
        yield from typist.wait(1.0, every=0.04, line="jog 2 -")
        yield "jog 2 -"
        seen["last"] = typist.t_s
        while typist.states[-1]["state"] != "holds":
            yield "renew"  # the screen is there, the key is not
        seen["stands"] = typist.t_s
        yield from typist.wait(0.3)
        yield "quit"

    t, q = typist.run(script())
    moves = moving(t, q)
    assert 0.05 < moves[-1] - seen["last"] <= seen["stands"] - seen["last"] <= LIFETIME_S
    assert moves[-1] - moves[0] > 0.9, "it went on"
    measured = np.array([[joint["actual"] for joint in state["joints"]] for state in typist.states])
    assert np.degrees(q[np.isfinite(q).all(axis=1)][-1][1]) == pytest.approx(measured[-1][1], abs=0.02)


@pytest.mark.parametrize("ends", ["stall", "eof", "interrupt"])
def test_a_move_ends_with_whoever_renews_it_and_leaves_the_drives_disabled(ends):
    typist, seen = Typist(), {}

    def script():
        yield from typist.enabled()
        yield f"move {','.join(map(str, READY))}"
        yield from typist.wait(0.2)
        assert typist.heard("the way: ") and typist.heard("joint 1: 90.00 to 70.00 deg (-20.00)")
        yield "yes"
        yield from typist.wait(0.2, every=0.02)
        seen["last"] = typist.t_s
        if ends == "interrupt":
            signal.raise_signal(signal.SIGINT)
            yield from typist.wait(0.5)
        if ends == "stall":
            yield from typist.wait(0.5)
            assert typist.heard("paused") and abs(typist.q()[2] - 10.0) > 1.0
            yield "renew"  # which a screen that has come back sends by itself
            yield from typist.wait(0.3, every=0.02)
            assert abs(typist.q()[2] - 10.0) > 1.0, "only a person lets it go on"
            yield ""
            yield from typist.wait(1.0, every=0.04, line="")
            np.testing.assert_allclose(typist.q(), READY, atol=0.02)
            seen["last"] = None

    if ends == "interrupt":
        with pytest.raises(KeyboardInterrupt):
            typist.run(script())
        log = typist.cell.session.cell.log.arrays()
        t, q = log["t_s"], log["q_target_rad"]
    else:
        t, q = typist.run(script())
    if seen["last"] is not None:
        assert moving(t, q)[-1] - seen["last"] <= LIFETIME_S
    assert not powered(typist.cell)


def test_a_contact_stops_a_jog_and_a_typed_yes_alone_goes_on():
    typist, seen = Typist("press"), {}

    def script():
        yield from typist.enabled()
        yield from typist.wait(3.0, every=0.05, line="jog 3 +")
        assert typist.states[-1]["state"] == "stopped" and typist.heard("jog_force_n = 1) after")
        yield "jog 3 -"
        yield "enable"
        assert typist.heard("the cell was stopped; type `reset`")
        yield "reset"
        yield "jog 3 -"
        yield from typist.wait(0.2)
        assert typist.states[-1]["state"] == "stopped"
        yield "reset"
        yield "yes"
        yield from typist.wait(1.0)
        seen["before"] = typist.q()[2]
        yield "jog 3 -"
        yield from typist.wait(1.0, every=0.05)
        yield "quit"

    typist.run(script())
    assert typist.q()[2] - seen["before"] == pytest.approx(-1.0, abs=0.02)
    assert 1.0 < typist.cell.session.buses.truth["force_n"].max() < 3.0


@pytest.mark.parametrize("fault", ["sto", "drive-fault"])
def test_a_drive_that_stops_by_itself_is_a_stop_and_no_key_alone_clears_it(fault):
    """An emergency stop shows as a drive's state, and lasts; a fault is reset as the drives are enabled."""
    typist = Typist(**{"arm.when_disabled": "sinks"})
    faulty = typist.cell.session.buses.world.make_faulty()

    def script():
        yield from typist.enabled()
        yield "jog 1 +"
        yield from typist.wait(0.1, every=0.02)
        faulty.inject(f"node 2: {fault}", typist.cell.session.buses.lockstep.clock.now_ns())
        yield "tare"
        yield "yes"  # it does not come to that
        yield from typist.wait(0.5, every=0.02)
        assert typist.states[-1]["state"] == "stopped" and typist.heard("stopped: node 2")
        assert not typist.heard("tared") and (fault == "sto") == bool(typist.heard("as with STO or an emergency stop"))
        yield "reset"
        yield from typist.wait(0.2)
        assert len(typist.heard("when its drives are disabled, it sinks: hold it")) == 3, (
            "at the first yes, tare, reset"
        )
        assert typist.states[-1]["state"] == "stopped" and "may the arm move again?" in typist.states[-1]["asks"]
        yield "yes"
        yield from typist.wait(3.0)
        assert typist.states[-1]["state"] == ("stopped" if fault == "sto" else "holds")
        yield "quit"

    typist.run(script())
    assert not powered(typist.cell)


@pytest.mark.parametrize(
    ("scene", "jog", "keys", "said"),
    [
        ("puma260", "jog z -", {"keep_out.boxes_mm": [[[-250, -250, 0], [-60, -60, 345]]]}, "from box 1 of keep_out"),
        ("free", "jog z -", {"limits.workspace_min_mm": [-999, -999, 350]}, "workspace ends at 350.0 mm"),
        ("free", "jog 3 +", {"joints.joint_3.start_deg": 53.0}, "joint 3 is at its limit"),
        ("free", "jog z +", {"joints.joint_3.start_deg": -75.0}, "the arm cannot go there, after"),
    ],
    ids=["keep out", "workspace", "range", "reach"],
)
def test_a_jog_ends_softly_before_a_limit(scene, jog, keys, said):
    keys = keys | ({"limits.workspace_max_mm": [999, 999, 999]} if "limits.workspace_min_mm" in keys else {})
    typist = Typist(scene, **keys)

    def script():
        yield from typist.enabled()
        yield from typist.wait(2.0, every=0.04, line=jog)
        yield from typist.wait(0.2)
        assert typist.states[-1]["state"] == "holds" and typist.heard(said)
        yield "quit"

    _, q = typist.run(script())
    q = q[np.isfinite(q).all(axis=1)]
    assert np.abs(q[-1] - q[0]).max() > np.radians(1.0), "it went there"
    assert np.abs(np.diff(q, n=2, axis=0)).max() * 400**2 < 1.05 * typist.cell.plan.setup.arm.model.qdd_max.max()


def test_an_arm_beyond_a_limit_is_jogged_back_only():
    typist = Typist("free", **{"joints.joint_3.start_deg": 50.0})
    q_max = typist.cell.plan.setup.arm.model.q_max
    q_max.setflags(write=True)
    q_max[2] = np.radians(49.0)  # a stop that was set while the arm stood beyond it

    def script():
        yield from typist.enabled()
        yield from typist.wait(0.3, every=0.04, line="jog 3 +")
        assert typist.heard("joint 3 is at its limit") and typist.q()[2] < 50.02
        yield "jog 3 -"
        yield from typist.wait(0.5, every=0.04)
        assert typist.q()[2] == pytest.approx(49.0, abs=0.02)
        yield "quit"

    typist.run(script())


def test_postures_a_tare_and_a_quick_stop(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(packaged_files("cells")["puma260"].read_text())
    typist = Typist(path, path)

    def script():
        yield from typist.enabled()
        yield "teach there"
        yield "jog 3 +"
        yield from typist.wait(0.6, every=0.05)
        yield "tare"
        yield "yes"
        yield from typist.wait(1.5)
        assert typist.heard("tared: 0.000 N") and typist.states[-1]["state"] == "holds"
        yield "move there"
        yield from typist.wait(0.2)
        yield "yes"
        yield from typist.wait(0.1, every=0.02)
        yield "stop"
        yield from typist.wait(0.3)
        assert typist.states[-1]["state"] == "stopped" and typist.heard("quick stop")
        yield "quit"

    typist.run(script())
    assert "there = [" in path.read_text()


def start(*words, **streams):
    command = [sys.executable, "-m", "canprobe", "console", "puma260", *words]
    return subprocess.Popen(command, stderr=subprocess.PIPE, **streams)


def test_a_closed_terminal_ends_the_session_with_the_drives_disabled():
    master, slave = pty.openpty()
    process = start("--plain", stdin=slave, stdout=slave, start_new_session=True)
    os.close(slave)
    text = b""
    for waited, line in ((b"`enable` begins", b"enable\n"), (b"[yes, no]", b"yes\n")):
        while waited not in text:
            text += os.read(master, 4096)
        os.write(master, line)
    while b"enable the drives" not in process.stderr.readline():
        pass
    os.write(master, b"jog 1 +\n")
    os.close(master)
    assert b"stop and disable the drives" in process.communicate(timeout=30)[1]
    assert process.returncode == 0


@pytest.mark.slow(reason="a browser's page takes seconds to come up")
def test_the_view_is_beside_the_console():
    process = start("--json", "--view", stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    said = ""
    while "http" not in said:
        said = json.loads(process.stdout.readline()).get("says", "")
    with urllib.request.urlopen(said.removeprefix("bridge view: ")) as page:
        assert page.status == 200
    assert not process.communicate(b"quit\n", timeout=60)[1] and process.returncode == 0


def test_nobody_has_to_read_what_a_session_prints():
    process = start("--json", stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    process.stdin.write(b"help\n" * 50 + b"enable\nyes\n")
    process.stdin.flush()
    assert not select.select([process.stderr], [], [], 2.0)[0], "nothing has failed"
    out, errors = process.communicate(timeout=30)
    documents = [json.loads(line) for line in out.splitlines()]
    assert process.returncode == 0 and not errors
    assert documents[-1] == {"says": "stop and disable the drives"}


def test_what_cannot_be_is_one_clear_line():
    typist = Typist()

    def script():
        yield from typist.enabled()
        for line, said in (
            ("jgo 1 +", "did you mean jog?"),
            ("jog 1", "expected `jog N +`"),
            ("jog 9 +", "expected a joint from 1 to 6, got 9"),
            ("jog w +", "one of x, y, z, rx, ry, rz"),
            ("jog 1 up", "expected + or -"),
            ("step 2", "expected one of 0.1, 1, 10"),
            ("speed fast", "expected a share such as 20%"),
            ("frame tool", "expected base or probe"),
            ("move nowhere", "posture nowhere: the cell has start"),
            ("move 1,2", "expected positions of 6 joints, got 2"),
            ("move 300,65,15,0,100,0", "joint 1 would come to 109."),
            ("teach start", "choose another name"),
            ("home 1", 'joint 1 of puma260 has zero = "homing"'),
            ("reset", "nothing was stopped"),
        ):
            typist.said.clear()
            yield line
            yield from typist.wait(0.2)
            assert said in "\n".join(typist.said), line
        yield "quit"

    _, q = typist.run(script())
    q = q[np.isfinite(q).all(axis=1)]
    assert (q == q[0]).all(), "nothing has moved"
    with pytest.raises(UsageError, match="listen has no arm; `canprobe listen` shows an array"):
        Typist("listen")
    with pytest.raises(UsageError, match=r"cycle.rate_hz = 20 .* cannot stand within 150 ms: expected a higher rate"):
        Typist("free", **{"cycle.rate_hz": 20.0})


def in_profile_position_alone(folder):
    path = folder / "mode_1.eds"
    path.write_text(eds_path("prbt_joint.eds").read_text().replace("DefaultValue=0x43", "DefaultValue=0x01"))
    return path


@pytest.mark.parametrize(
    ("cell", "make"),
    [
        ("gantry", None),
        ("seven-axis", None),
        ("prbt", None),  # interpolated position every 10 ms, units of 1/1000 degree
        ("puma260", "no_cyclic_mode"),  # profile position
        ("prbt", in_profile_position_alone),  # at 100 Hz, without 6084h
    ],
)
def test_other_arms_and_drives_are_jogged_and_moved_in_the_same_way(cell, make, tmp_path):
    keys = {}
    if make is not None:
        eds = make(tmp_path) if callable(make) else write_eds(make, tmp_path)
        keys = {"arm.eds": str(eds), "cycle.rate_hz": 200.0, "sensor.rate_hz": 100.0}
    typist, seen = Typist(cell, **keys), {}
    joints = typist.cell.plan.setup.arm.model.joints

    def q():
        return np.array([its.shown(value) for its, value in zip(joints, typist.session.view.seen.q, strict=True)])

    def stepped(line):
        yield line
        yield from typist.wait(0.2, every=0.02)
        while typist.states[-1]["state"] == "moves":
            yield "renew"

    def script():
        yield from typist.enabled()
        seen["start"] = q()
        yield from stepped("jog 2 +")
        seen["step"] = q()
        before = typist.cell.probe(typist.session.view.seen.q)[0]
        yield from stepped("jog z +")
        seen["way"] = typist.cell.probe(typist.session.view.seen.q)[0][:3, 3] - before[:3, 3]
        yield "jog 1 -"
        yield from typist.wait(0.5, every=0.03, line="jog 1 -")
        last = typist.t_s
        while typist.states[-1]["state"] != "holds":
            yield None
        assert typist.t_s - last <= LIFETIME_S
        yield "move start"
        yield from typist.wait(0.5)
        yield "yes"
        while not typist.heard("the arm stands at"):
            yield "renew"
        yield "quit"

    typist.run(script())
    step = seen["step"] - seen["start"]
    np.testing.assert_allclose(step, np.eye(len(joints))[1], atol=0.03)
    np.testing.assert_allclose(1e3 * seen["way"], [0, 0, 1], atol=0.1)
    np.testing.assert_allclose(q(), seen["start"], atol=0.03)
    assert not powered(typist.cell)


def test_a_drive_without_a_cyclic_mode_holds_no_contact(tmp_path):
    with pytest.raises(PlanError, match=r"6502h.*too slow for .*\"press\".*`canprobe console CELL`"):
        Typist("press", **{"arm.eds": str(write_eds("no_cyclic_mode", tmp_path))})


def test_voltage_and_temperature_are_read_beside_the_cycle(tmp_path):
    """A drive has 6079h and an entry of its maker's; the others have the latter not: that is said, and asked once."""
    text = eds_path("puma260_joint.eds").read_text()
    count = int(re.search(r"\[OptionalObjects\]\s+SupportedObjects=(\d+)", text)[1])
    listed = f"SupportedObjects={count + 1}\n{count + 1}=0x6079"
    text = text.replace(f"[OptionalObjects]\nSupportedObjects={count}", f"[OptionalObjects]\n{listed}")
    text += "\n[6079]\nParameterName=DC link circuit voltage\nDataType=0x0007\nAccessType=ro\nDefaultValue=48100\n"
    (tmp_path / "drive.eds").write_text(text)
    keys = {"arm.temperature_object": "6079h:00", "arm.temperature_unit_c": 0.001}
    typist = Typist(**keys, **{"joints.joint_2.eds": str(tmp_path / "drive.eds")})

    def script():
        yield from typist.wait(0.5)
        yield from typist.enabled()
        yield from typist.wait(4.0, every=0.04, line="jog 1 -")
        yield "quit"

    frames = []
    typist.session.view.observe = lambda seen: frames.extend(seen.frames)
    typist.run(script())
    node = next(node for node in typist.states[-1]["nodes"] if node["node_id"] == 2)
    assert (node["voltage_v"], node["temperature_c"]) == (48.1, 48.1)
    assert len(typist.heard("6079h:00 is not in puma260_joint.eds; it is not read again")) == 5
    asked = [i for i, (can_id, data, _) in enumerate(frames) if can_id == 0x602 and data[:3] == b"\x40\x79\x60"]
    assert len(asked) > 10 and min(np.diff([frames[i][2] for i in asked])) >= READ_EVERY_NS
    in_cycle = [can_id for i in asked for can_id in [c for c, _, _ in frames[:i] if c in (0x80, 0x201)][-1:]]
    assert set(in_cycle[2:]) == {0x201}, "behind the commands of a cycle"


class Cell:
    """The cell behind a screen: what the screen writes can be read, and it shows what is said."""

    def __init__(self):
        ends = [os.pipe(), os.pipe()]
        self.stdout, self._says = (os.fdopen(end, mode, 0) for end, mode in zip(ends[0], ("rb", "wb"), strict=True))
        self._typed, self.stdin = (os.fdopen(end, mode, 0) for end, mode in zip(ends[1], ("rb", "wb"), strict=True))

    def says(self, document):
        self._says.write(json.dumps(document).encode() + b"\n")

    def typed(self):
        return system.typed(self._typed.fileno())[0].decode().splitlines()

    def wait(self):
        return 7

    def end(self):
        self._says.close()

    def close(self):
        for stream in (self.stdout, self.stdin, self._typed, self._says):
            stream.close()


def test_keys_of_the_screen_are_lines():
    from textual import events

    from canprobe.cli.console_screen import ConsoleScreen

    typist, cell = Typist(), Cell()
    typist.run(typist.enabled())
    state, screen = typist.states[-1] | {"asks": None}, ConsoleScreen(cell)

    async def use():
        async with screen.run_test(size=(120, 40)) as pilot:

            async def shown(**changes):
                cell.says(state | changes)
                while any(screen.state.get(key) != value for key, value in changes.items()):
                    await pilot.pause()

            async def typed(keys, count=1):
                await pilot.press(*keys.split())
                lines = []
                while len(lines) < count:
                    await pilot.pause()
                    lines += cell.typed()
                return lines

            await shown(state="holds")
            for keys, lines in (
                ("right", ["jog 1 +"]),
                ("3 left minus", ["jog 3 -", "jog 3 -"]),
                ("down plus up up right", ["jog 4 +", "jog 2 +"]),
                ("z right Z left", ["jog z +", "jog rz -"]),
                ("s s", ["step 10", "step 0.1"]),
                ("comma full_stop", ["speed 5%", "speed 10%"]),
                ("f f", ["frame probe", "frame base"]),
                ("2 h T e d r enter", ["home 2", "tare", "enable", "disable", "reset", ""]),
                ("m a enter", ["move a"]),
                ("t space b enter", ["teach  b"]),
                ("colon s t e p space 1 enter", ["step 1"]),
                ("colon up up enter", ["teach  b"]),
                ("colon escape space", ["stop"]),
            ):
                assert await typed(keys, len(lines)) == lines, keys
            screen.post_message(events.CursorPosition(1, 1))
            assert await typed("") == ["renew"], "the answer of the terminal, and nothing else, renews a motion"
            await shown(asks="move?")
            assert screen.focused is not None, "an answer is typed"
            assert await typed("y space enter") == ["y "]
            await shown(state="moves", asks="again?")
            assert await typed("space") == ["stop"], "a space stops what moves, wherever the cursor is"
            cell.end()
            while screen.return_value is None:
                await pilot.pause()

    asyncio.run(use())
    assert screen.return_value == 7
    cell.close()


@pytest.mark.parametrize("renewed", [True, False])
def test_homing_goes_on_while_it_is_renewed(renewed):
    joint = {"joints.joint_3.zero": "homing", "joints.joint_3.homing_method": 33, "joints.joint_3.home_deg": 15.0}
    typist = Typist(**joint)

    def script():
        yield "home 1"
        yield "home 3"
        assert typist.heard('joint 1 of puma260 has zero = "homing"') and typist.heard("home it by method 33")
        yield "yes"
        while not typist.heard("is homed") and not typist.heard("stopped: "):
            yield "renew" if renewed else None
        yield "quit"

    typist.run(script())
    assert typist.heard("joint 3 is homed" if renewed else "stopped: homing was not renewed for 150 ms")
    assert not powered(typist.cell)
