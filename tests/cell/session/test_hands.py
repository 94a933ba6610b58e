"""Motions by hand in an open cell: where they end, what they keep, and what ends them."""

import random
import signal

import numpy as np
import pytest
from makes import write_eds

import canprobe
from canprobe.cell.planning import make
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.sync import CYCLES_TO_EFFECT
from canprobe.cell.planning.units import PROFILE_CYCLES, PROFILE_STOP_S, stated_lag_s
from canprobe.cell.scene.load import packaged
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.tasks.hand_way import joint_way
from canprobe.errors import BusError, NodeError, SafetyStop, UsageError
from canprobe.fieldbus.bus.real.interrupts import Terminated
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of

READY = [80.0, 70.0, 10.0, 5.0, 90.0, 20.0]


def cell(scene="puma260", out=None, **changes):
    keys = {"bus.timed": False, "outputs.figures": False, "cycle.rate_hz": 200.0} | (
        {"postures.ready": READY} if scene == "puma260" else {}
    )
    return canprobe.open_cell(
        scene, {**keys, **{key.replace("__", "."): value for key, value in changes.items()}}, bus="lockstep", out=out
    )


def log_of(opened):
    return opened.session.cell.log.arrays()


def counts(opened):
    return np.abs(opened.plan.setup.arm.model.q_per_unit).sum(axis=1)


def test_a_move_ends_within_a_count_of_its_posture_and_shows_the_way_before():
    with cell() as opened:
        way = opened.way_to("ready", 0.2)
        assert opened.move(way) is None
        off = np.abs(opened.read().q - np.radians(READY)) / counts(opened)
        assert off.max() < 1.0
        log = log_of(opened)
        moving = log["t_s"][np.abs(np.diff(log["q_target_rad"], axis=0, append=np.nan)).max(axis=1) > 0]
        assert moving[-1] - moving[0] == pytest.approx(way.profile().duration_s, abs=0.01)
        assert opened.move("start", 0.5) is None and opened.move(np.radians(READY), 0.5) is None


@pytest.mark.parametrize(("rate_hz", "quick"), [(400.0, True), (100.0, False)])
def test_profile_position_ends_within_a_count_near_the_way_and_within_the_limits(rate_hz, quick, tmp_path):
    """With an acceleration that lets it, at the limits of speed; else no faster than it stops in 20 ms."""
    keys = {f"joints__joint_{i}__acceleration_deg_s2": 1e5 for i in range(1, 7)} if quick else {}
    keys |= {"arm__eds": str(write_eds("no_cyclic_mode", tmp_path)), "sensor__rate_hz": 50.0}
    with cell(cycle__rate_hz=rate_hz, **keys) as opened:
        way = opened.way_to("ready", 1.0)
        assert opened.move(way) is None
        assert (np.abs(opened.read().q - np.radians(READY)) / counts(opened)).max() < 1.0
        log, model = log_of(opened), opened.plan.setup.arm.model
        nodes = opened.session.buses.world.nodes
    assert (way.slowed_by is None) is quick and (quick or "way to stop (profile position)" in way.slowed_by)
    ramps = [(node.application.parts.parameters, np.abs(model.units_per_q[i])) for i, node in enumerate(nodes[:6])]
    for parameters, per_q in ramps:  # which no set-point exceeds, see test_profile_position
        assert parameters.acceleration <= per_q @ model.qdd_max
    rates = np.abs(np.diff(log["q_rad"], axis=0)) * rate_hz  # of axes that overshoot a sharp turn by a little
    assert (rates <= 1.02 * model.qd_max).all() and (not quick or (rates / model.qd_max).max() > 0.9)
    off = np.abs(log["q_target_rad"] - log["q_rad"])[np.isfinite(log["q_target_rad"]).all(axis=1)].max(axis=0)
    lag = 0.5 * PROFILE_STOP_S + stated_lag_s(opened.plan.setup) + (CYCLES_TO_EFFECT + PROFILE_CYCLES + 1) / rate_hz
    assert (off <= lag * way.speed * np.abs(way.q[1] - way.q[0]) + 1e-3).all()


@pytest.mark.parametrize("name", [name for name, _ in packaged("cell")])
def test_no_joint_is_faster_than_its_limits_on_any_way(name):
    plan = make_plan(resolve(canprobe.load_scene(name)))
    model, rng = plan.setup.arm.model, random.Random(name)
    low, high = model.q_min + 0.05, model.q_max - 0.05
    for _ in range(10):
        start, goal = (low + rng.random() * (high - low) for _ in range(2))
        share = rng.choice((0.05, 0.3, 1.0))
        way = joint_way(plan, start, goal, share).whole()
        motion = way.profile()
        t = np.linspace(0.0, motion.duration_s, 1500)
        q = np.array([way.at(motion.at(one)[0]) for one in t])
        qd = np.abs(np.diff(q, axis=0) / np.diff(t)[:, None])
        assert (qd <= share * model.qd_max * (1 + 1e-6)).all()
        qdd = np.abs(np.diff(np.diff(q, axis=0), axis=0)) / (t[1] - t[0]) ** 2
        assert (qdd <= model.qdd_max * 1.02).all()
        used = max((qd / (share * model.qd_max)).max(), (qdd / model.qdd_max).max())
        short = motion.duration_s < 0.5  # where neither is reached, the jerk bounds it
        assert short or used > 0.95, "no slower than needed"
        np.testing.assert_allclose(q[-1], goal, atol=1e-9)


def test_a_way_through_a_limit_or_a_keep_out_is_refused_with_joint_place_and_time():
    with cell(keep_out__floor_mm=250.0) as opened:
        for goal, said in (
            (
                [0, 0, 0, 0, 0, 300],
                r"joint 6 would come to 29\d\.\d deg; it may go from -214.0 to 294.0 deg, .* s after",
            ),
            (
                [90, -60, 15, 0, 100, 0],
                r"the (link of joint \d|probe) comes to -?\d+ mm, the floor is at 250 mm, .* % of the way",
            ),
        ):
            with pytest.raises(UsageError, match=said):
                opened.move(np.radians(goal))
        with pytest.raises(UsageError, match="did you mean ready"):
            opened.move("redy")
        assert not len(log_of(opened)["t_s"]), "nothing was enabled"


def test_a_jog_of_a_joint_and_of_the_probe_goes_its_way():
    with cell() as opened:
        q0 = opened.read().q
        opened.jog(3, velocity=np.radians(-20.0), for_s=0.25)
        q1 = opened.read().q
        np.testing.assert_allclose(np.degrees(q1 - q0), [0, 0, -5, 0, 0, 0], atol=0.02)
        T0 = opened.probe(q1)[0]
        opened.jog(along=np.array([0, 0, 1]), velocity=0.04, for_s=0.25)
        T1 = opened.probe(opened.read().q)[0]
        np.testing.assert_allclose(T1[:3, 3] - T0[:3, 3], [0, 0, 0.01], atol=5e-5)
        opened.jog(about=(0, 0, 1), velocity=0.4, for_s=0.25, in_probe_frame=True)
        T2 = opened.probe(opened.read().q)[0]
        np.testing.assert_allclose(T1[:3, :3].T @ T2[:3, :3], turn_z(0.1), atol=1e-3)
        for wrong in ({}, {"joint": 9}, {"joint": 1, "along": (0, 0, 1)}, {"along": (0, 0, 0)}):
            with pytest.raises(UsageError, match="jog: expected"):
                opened.jog(velocity=0.1, for_s=1.0, **wrong)


def turn_z(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    ("way", "fidelity", "eds"),
    [
        ({"along": (0, 0, 1), "in_probe_frame": True, "velocity": 0.1, "for_s": 1.0}, "dynamic", None),
        ({"joint": 3, "velocity": 0.5, "for_s": 1}, "ideal", "no_cyclic_mode"),
    ],
    ids=["probe", "profile position"],
)
def test_a_jog_goes_back_from_what_it_touches_at_half_of_the_limit(way, fidelity, eds, tmp_path, monkeypatch):
    monkeypatch.setattr(make, "operation_problems", lambda *_: [])  # the emulated array has its object in a press alone
    keys = {} if eds is None else {"arm__eds": str(write_eds(eds, tmp_path))}
    opened = cell("press", out=tmp_path / "run", plant__fidelity=fidelity, **keys)
    with opened:
        with pytest.raises(SafetyStop, match=r"showed 1\.\d\d N \(limits.jog_force_n = 1\) .* went back"):
            opened.jog(**way)
        with pytest.raises(UsageError, match="call resume"):
            opened.jog(**way)
        opened.resume()
        opened.jog(3, velocity=-0.05, for_s=0.2)
    force = opened.session.buses.truth["force_n"]
    assert 1.0 < force.max() < 3.0 and force[-1] == 0.0


def test_a_motion_that_is_no_longer_wanted_ends_in_a_tenth_of_a_second():
    with cell() as opened:
        cycles = iter(range(10_000))
        ended = opened.move("ready", wanted=lambda: next(cycles) < 100)
        log = log_of(opened)
    moves = np.abs(np.diff(log["q_target_rad"], axis=0)).max(axis=1) > 0
    assert ended == "no longer asked for"
    first = np.flatnonzero(moves)[0]
    assert (np.flatnonzero(moves)[-1] - first - 100) / 400.0 < 0.15


@pytest.mark.parametrize(("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)])
def test_an_interrupt_from_inside_or_outside_brakes_and_then_ends(number, kind):
    with cell() as opened, pytest.raises(kind):
        opened.move("ready", 0.3, progress=lambda m: m.cycle == 80 and signal.raise_signal(number))
    q = log_of(opened)["q_target_rad"]
    q = q[np.isfinite(q).all(axis=1)]
    speed = np.abs(np.diff(q, axis=0)).max(axis=1) * 200
    last = np.flatnonzero(speed > 0)[-1]
    assert speed[last] < 0.01 * speed.max(), "it came to rest before the end"
    assert np.abs(np.diff(speed[: last + 2])).max() * 200 < 1.05 * opened.plan.setup.arm.model.qdd_max.max()


@pytest.mark.parametrize(("kind", "eds"), [("brake-stuck", None), ("mute", None), ("brake-stuck", "no_cyclic_mode")])
def test_a_fault_of_a_drive_ends_a_motion(kind, eds, tmp_path):
    """The joint does not follow, or its drive is lost: the cell stops, and stays so until a person's word."""
    opened = cell(**({} if eds is None else {"arm__eds": str(write_eds(eds, tmp_path))}))
    faulty = opened.session.buses.world.make_faulty()

    def throw(measurement):
        if measurement.cycle == 80:
            faulty.inject(f"node 2: {kind}", opened.session.buses.lockstep.clock.now_ns())

    with opened:
        with pytest.raises((NodeError, BusError, SafetyStop), match="node 2"):
            opened.move("ready", 0.3, progress=throw)
        with pytest.raises(UsageError, match="call resume"):
            opened.move("start")
    words = {node.node_id: node.node.dictionary.number(0x6041) for node in faulty.nodes if node.node_id not in (2, 16)}
    assert not [number for number, word in words.items() if state_of(word) in POWERED_STATES]


def test_a_tare_needs_an_array():
    with canprobe.open_cell("free", bus="lockstep") as opened, pytest.raises(UsageError, match="cell with an array"):
        opened.tare()


def test_homing_in_an_open_cell():
    joint = {"joints.joint_3.zero": "homing", "joints.joint_3.homing_method": 37, "joints.joint_3.home_deg": 15.0}
    with canprobe.open_cell("puma260", joint, bus="lockstep", to_home=True) as opened:
        with pytest.raises(UsageError, match="home: joint 1 of puma260"):
            opened.home([1])
        opened.home([3])
        opened.move("start")
