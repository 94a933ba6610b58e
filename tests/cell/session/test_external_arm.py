"""A cell with an external arm: touches without a bus, what ends them, and the socket with its programs."""

import csv
import json
import select
import shutil
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from network_buses import group  # noqa: F401

import canprobe
from canprobe.cell.emulated import flange_arm
from canprobe.cell.scene.load import packaged_files
from canprobe.cell.scene.setup import External
from canprobe.cell.session.arm_socket import SocketArm
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cli import main
from canprobe.errors import ArmError, PlanError, SafetyStop, SceneError

EXAMPLE = Path(__file__).parents[3] / "docs" / "example" / "arm"
SHORT = {"cell": "external", "task.duration_s": 0.3, "task.clearance_mm": 0.5}


def scene_of(name="press", **keys):
    return canprobe.load_scene(name, SHORT | {"bus.interface": "direct"} | keys)


def run(scene, controller=make_task):
    session = Session(scene)
    with session:
        session.run(controller(session.plan))
    return session


@pytest.mark.parametrize(("rate", "delay_ms"), [(500.0, 4.0), (125.0, 40.0)])
def test_a_touch_keeps_its_force_and_ends(rate, delay_ms):
    keys = {"cycle.rate_hz": rate, "sensor.rate_hz": 125.0, "arm.delay_ms": delay_ms, "task.approach_mm_s": 1.0}
    scene = scene_of(**keys, **{"servo.surface_height_hz": 3.0})
    session = run(scene)
    force = session.buses.truth["force_n"]
    assert session.cell.notes.lines() == []
    assert force.max() < 3.0 and np.isclose(force[force > 1.5].mean(), 2.0, rtol=0.1)


class Watched(flange_arm.EmulatedArm):
    """An emulated arm with a fault from a time on, whose clock has another zero; it notes how it was stopped."""

    fault, after_s = "none", 1.0
    stops = 0

    def read(self):
        T, t_ns = super().read()
        self._begun = getattr(self, "_begun", t_ns)
        if self._last is None or t_ns - self._begun < self.after_s * 1e9:
            self._kept = T, t_ns + 10**15
        elif self.fault == "raises":
            raise OSError("the cable was pulled")
        elif self.fault == "silent":
            return self._kept
        elif self.fault == "still":
            return self._kept[0], t_ns + 10**15
        elif self.fault == "jump":
            T[0, 3] += 0.02
        elif self.fault == "sheared":
            T[0, 1] += 0.1
        return T, t_ns + 10**15

    def stop(self):
        type(self).stops += 1
        super().stop()


@pytest.fixture
def watched(monkeypatch):
    Watched.stops, Watched.fault, Watched.after_s = 0, "none", 0.6
    monkeypatch.setattr(flange_arm, "EmulatedArm", Watched)
    return Watched


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("raises", "external arm: read: OSError: the cable was pulled"),
        ("silent", "external arm: lost: no usable pose for .* ms more"),
        ("still", "does not follow its targets"),
        ("jump", "external arm: lost: no usable pose for .* ms more"),
        ("sheared", "expected a pose"),
    ],
)
def test_an_arm_that_fails_ends_the_run_and_is_stopped(watched, fault, words):
    watched.fault = fault
    session = Session(scene_of(**{"task.duration_s": 5.0}))
    with pytest.raises(ArmError, match=words), session:
        session.run(make_task(session.plan))
    assert watched.stops >= 1
    assert session.cell.cycle.t_ns * 1e-9 < 0.6 + 1.5


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, SafetyStop])
def test_it_is_stopped_whatever_the_controller_raises(watched, error):
    def step(measurement):
        if measurement.t_ns > 0.5e9:
            raise error("enough")
        return canprobe.Command()

    session = Session(scene_of())
    with pytest.raises(error), session:
        session.run(step)
    assert watched.stops >= 1


def test_its_clock_may_have_any_zero_and_run_fast_or_slow(watched):
    assert run(scene_of()).cell.drives.figures()["clock_offset_ms"] == pytest.approx(-1e9)


@pytest.mark.parametrize("key", ["delay_ms", "stop_after_ms"])
def test_what_it_does_without_commands_and_how_late_has_to_be_stated(tmp_path, key):
    lines = packaged_files("cells")["external"].read_text().splitlines()
    (tmp_path / "mine.toml").write_text("\n".join(line for line in lines if not line.startswith(key)))
    with pytest.raises(SceneError, match=rf"arm\.{key}: missing"):
        scene_of(cell=str(tmp_path / "mine.toml"))


@pytest.mark.parametrize(
    ("keys", "error", "words"),
    [
        ({"joints.x.kind": "prismatic"}, SceneError, "joints"),
        ({"arm.eds": "puma260_joint.eds"}, SceneError, "arm.eds"),
        ({"bus.interface": "socketcan"}, PlanError, "arm.emulated: expected false"),
        ({"arm.emulated": False, "arm.address": "127.0.0.1:5810"}, PlanError, "moves in real time"),
        ({"plant.fidelity": "dynamic"}, PlanError, "fidelity"),
    ],
)
def test_a_cell_that_cannot_be_brought_up_is_refused(keys, error, words):
    with pytest.raises(error, match=words):
        canprobe.plan(scene_of(**keys))


def test_the_plan_refuses_a_servo_that_the_dead_time_would_let_hunt():
    slow = {"arm.delay_ms": 40.0, "task.approach_mm_s": 0.5}
    with pytest.raises(PlanError, match=r"servo.surface_height_hz = 8: .* lower it to ([\d.]+)") as refused:
        canprobe.plan(scene_of(**slow))
    lower = float(str(refused.value).partition("lower it to ")[2].partition(",")[0])
    assert canprobe.plan(scene_of(**slow, **{"servo.surface_height_hz": lower})).setup.arm.drives == ()


# the socket


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    binary = tmp_path_factory.mktemp("arm") / "arm"
    compiler = shutil.which("g++")
    if compiler is not None:
        subprocess.run([compiler, "-std=c++17", "-O1", "-Wall", "-o", binary, EXAMPLE / "arm.cpp"], check=True)
    return {"python": [sys.executable, str(EXAMPLE / "arm.py")], "C++": [str(binary)] if compiler else None}


@pytest.mark.parametrize("language", ["python", "C++"])
def test_the_programs_of_the_example_follow_and_stop_by_themselves(program, language):
    if program[language] is None:
        pytest.skip("no g++: the C++ program of docs/example/arm is NOT tested here")
    with subprocess.Popen([*program[language], "0"], stdout=subprocess.PIPE, text=True) as process:
        try:
            address = process.stdout.readline().split()[-1]
            external = External(address, emulated=False, delay_s=0.0, stop_after_s=0.1)
            with pytest.raises(ArmError, match="stop_after_ms"):
                SocketArm(replace(external, stop_after_s=0.05))
            with closing(SocketArm(external)) as arm:
                T, t_ns = arm.read()
                np.testing.assert_allclose(T[:3, 3], (-0.12, -0.1225, 0.504))
                T = T.copy()
                T[:3, 3] += (0.01, -0.02, 0.003)
                arm.command(T)
                assert follows(arm, T) > t_ns
                arm.stop()
                process.kill()
                with pytest.raises(ArmError, match=address):
                    follows(arm, np.eye(4))
        finally:
            process.kill()


def follows(arm, T, longest_s=20.0):
    """Time of the first pose that is T."""
    end_s = time.monotonic() + longest_s
    while time.monotonic() < end_s:
        pose, t_ns = arm.read()
        if np.allclose(pose, T, atol=1e-8):
            return t_ns
        time.sleep(0.001)
    raise AssertionError("the pose was not reached")


MM_S = 10.0


@pytest.fixture
def led_by_hand():
    """Address of an arm that somebody leads along x, and what it has got."""
    pose, got = [1, 0, 0, 0, 0, -1, 0, -0.1225, 0, 0, -1, 0.504, 0, 0, 0, 1], []

    def serve(server):
        with suppress(OSError), server.accept()[0] as canprobe:
            canprobe.sendall(b'{"canprobe_arm": 1, "stop_after_ms": 100}\n')
            begun_ns = time.monotonic_ns()
            while True:
                t_ns = time.monotonic_ns()
                pose[3] = -0.12 + 1e-12 * MM_S * (t_ns - begun_ns)
                canprobe.sendall(json.dumps({"t_ns": t_ns, "T": pose}).encode() + b"\n")
                if select.select([canprobe], [], [], 0.002)[0]:
                    got.append(canprobe.recv(4096))

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=serve, args=(server,), daemon=True).start()
        yield f"127.0.0.1:{server.getsockname()[1]}", got


@pytest.mark.realtime
@pytest.mark.slow(reason="an array in real time, with a process of its own")
def test_listen_records_the_pose_of_the_probe_and_commands_nothing(led_by_hand, group, tmp_path):
    address, got = led_by_hand
    text = packaged_files("cells")["external"].read_text(encoding="utf-8")
    cell, path = tmp_path / "cell.toml", tmp_path / "touch.csv"
    named = f'kind = "external"\nemulated = false\naddress = "{address}"'
    cell.write_text(text.replace('kind = "external"', named), encoding="utf-8")
    bus = ["--bus", "udp_multicast", "--channel", group]
    assert main(["listen", str(cell), *bus, "--duration", "1.5", "--record", str(path), "-q"]) == 0
    with path.open(encoding="ascii") as file:
        rows = list(csv.DictReader(file))
    t_s, x = (np.array([float(row[name]) for row in rows]) for name in ("t_s", "T03"))
    slope, at = np.polyfit(t_s, 1e3 * x, 1)
    assert len(rows) > 50
    assert slope == pytest.approx(MM_S, rel=0.1), "poses are those of the instants of the images"
    assert np.median(np.abs(1e3 * x - slope * t_s - at)) < 0.3
    assert b'"T"' not in b"".join(got), "it was commanded"
