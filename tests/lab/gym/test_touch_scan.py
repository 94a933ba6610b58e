"""The environment as an agent meets it: spaces, actions, ends of an episode, options, and the cell behind it."""

import os
import signal
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from patience import patience_s

import canprobe.lab.gym
from canprobe.cell.results.run_files import load_table
from canprobe.errors import SceneError, UsageError
from canprobe.fieldbus.protocol.cia402 import DriveState
from canprobe.lab.examples import learn_touch_scan
from canprobe.lab.gym.episode import SIGHT_RADIUS_M, TOUCH_RADIUS_M, Coverage

STILL = np.zeros(3, dtype=np.float32)


@pytest.fixture
def make():
    made = []

    def make(**arguments):
        options = {"objects": "train", "task.clearance_mm": 1.0, **arguments.pop("options", {})}
        made.append(gymnasium.make("canprobe/TouchScan-v0", options=options, **arguments).unwrapped)
        return made[-1]

    yield make
    for env in made:
        env.close()


def features_of(env, observation):
    return dict(zip(env.names, observation.tolist(), strict=True))


@pytest.mark.slow(reason="every check of gymnasium, which resets again and again")
@pytest.mark.parametrize("kind", ["tactile", "oracle"])  # the first holds the vector of `features`
def test_gymnasium_has_nothing_to_say_against_it(make, kind):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(observation=kind, estimate=kind == "oracle", options={"task.clearance_mm": 3.0}))


def test_the_same_seed_gives_the_same_trace_and_another_one_another(make):
    env = make(observation="oracle")
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 3)).astype(np.float32)

    def trace(**seed):
        first, info = env.reset(**seed)
        steps = [env.step(action)[:2] for action in actions]
        return np.array([first, *(observation for observation, _ in steps)]), [r for _, r in steps], info["overrides"]

    one, rewards, drawn = trace(seed=3)
    goes_on = trace()
    again = trace(seed=3)
    assert np.array_equal(one, again[0]) and rewards == again[1] and drawn == again[2]
    assert drawn != goes_on[2] and not np.array_equal(one, goes_on[0])
    assert np.array_equal(goes_on[0], trace()[0])


def test_an_array_that_repeats_its_image_ends_an_episode_before_it_presses(make, monkeypatch):
    env = make()
    env.reset(seed=1)
    frozen, plant = [], env.episode.session.buses.world.plant
    image_of = plant.array.image_of
    monkeypatch.setattr(
        plant.array, "image_of", lambda *a: frozen[0] if frozen else frozen.append(image_of(*a)) or frozen[0]
    )
    terminated, forces = False, []
    while not terminated:
        _, _, terminated, truncated, info = env.step(np.array([0.3, 0.0, 1.0], dtype=np.float32))
        assert not truncated
        forces.append(info["force_n"])
    assert "the array has sent the same image" in info["reason"] and max(forces) < 6.0


def test_an_action_moves_the_contact_in_its_tangent_plane(make):
    env = make(observation="oracle", estimate=False)
    env.reset(seed=1, options={"object.radius_mm": 60, "task.speed_mm_s": 40})
    for action, way in (((0.5, 0, 0), (1, 0)), ((0, -0.5, 0), (0, -1)), ((-0.3, 0.4, 0), (-0.6, 0.8))):
        seen = [features_of(env, env.step(np.array(action, dtype=np.float32))[0]) for _ in range(10)]
        path = np.array([[one["true_along_mm"], one["true_across_mm"], one["true_up_mm"]] for one in seen])
        moved = path[-1] - path[3]  # it takes the first steps to get under way
        assert np.linalg.norm(moved) == pytest.approx(6 * 0.04 * 20, rel=0.05)
        assert moved[:2] / np.linalg.norm(moved[:2]) == pytest.approx(way, abs=0.07)
        velocity = [seen[-1]["velocity_x_mm_s"], seen[-1]["velocity_y_mm_s"]]
        assert velocity == pytest.approx(20 * np.array(way), abs=1e-4)


def test_an_action_sets_the_force_about_that_of_the_scene(make):
    env = make(estimate=False)
    env.reset(seed=1, options={"objects": None, "task.force_n": 1.5})
    for press, force in ((1, 2.25), (-1, 0.75)):
        for _ in range(10):
            *_, info = env.step(np.array([0, 0, press], dtype=np.float32))
        assert info["force_n"] == pytest.approx(force, rel=0.15)  # the array's hysteresis after the heavier press
        assert info["force_error_n"] == pytest.approx(info["force_n"] - 1.5)


def test_time_truncates_and_the_supervision_terminates(make):
    env = make(estimate=False)
    env.reset(seed=1, options={"task.duration_s": 0.2})
    ends = [env.step(STILL)[2:4] for _ in range(5)]
    assert ends == [(False, False)] * 4 + [(False, True)]
    with pytest.raises(UsageError, match=r"call reset\(\)"):
        env.step(STILL)
    env.reset(options={"limits.force_max_n": 2.4})
    for _ in range(10):
        _, reward, terminated, truncated, info = env.step(np.array([0, 0, 1], dtype=np.float32))
        if terminated:
            break
    assert terminated and not truncated and reward < -10
    assert "above the limit of 2.40 N" in info["reason"]


def test_close_leaves_the_drives_disabled(make):
    env = make(estimate=False)
    env.reset(seed=1)
    drives = env.episode.session.cell.drives
    assert set(drives.states) == {DriveState.OPERATION_ENABLED}
    env.close()
    assert set(drives.states) == {DriveState.SWITCH_ON_DISABLED}
    env.close()  # twice is once
    with pytest.raises(UsageError, match=r"call reset\(\)"):
        env.step(STILL)


def test_options_have_the_keys_and_the_checks_of_a_scene(make):
    env = make(estimate=False)
    drawn = {
        "plant.drive_bandwidth_hz": canprobe.lab.gym.Uniform(20, 40),
        "task.force_n": canprobe.lab.gym.OneOf((1.5, 2.5)),
    }
    _, info = env.reset(seed=0, options={"objects": "held_out", **drawn})
    overrides = info["overrides"]
    assert overrides["object"]["kind"] in {"ellipsoid", "saddle", "torus", "fillet"}
    assert 20 <= overrides["plant.drive_bandwidth_hz"] <= 40 and overrides["task.force_n"] in (1.5, 2.5)
    with pytest.raises(SceneError, match=r"object\.radius_m: unknown key; did you mean radius_mm"):
        env.reset(options={"object.radius_m": 0.05})
    with pytest.raises(UsageError, match="objects: expected one of train, held_out"):
        env.reset(options={"objects": "test"})
    with pytest.raises(UsageError, match=r'bus\.interface: expected one of .*, got "socketcan"'):
        env.reset(options={"bus.interface": "socketcan"})


def test_every_object_that_is_held_out_can_be_touched(make):
    env = make(estimate=False, options={"objects": "held_out"})
    for number, value in enumerate(canprobe.lab.gym.OBJECTS["held_out"].values):
        _, info = env.reset(seed=number, options={"object": value})
        assert info["overrides"]["object"]["kind"] == value["kind"]
        assert info["force_n"] == pytest.approx(2.0, rel=0.1)


def test_estimate_tells_the_curvature_and_features_hold_no_truth(make):
    env = make(observation="oracle")
    env.reset(seed=1, options={"object.radius_mm": 50, "object.rotation_deg": [0, 0, 110]})  # axis along the heading
    for step in range(30):
        turn = 0.4 * step
        observation, *_ = env.step(np.array([0.6 * np.cos(turn), 0.6 * np.sin(turn), 0], dtype=np.float32))
    seen = features_of(env, observation)
    assert [seen[f"true_k_{axes}_per_m"] for axes in ("xx", "xy", "yy")] == pytest.approx([0, 0, 20], abs=0.3)
    assert seen["estimated"] == 1.0
    assert [seen[f"estimated_k_{axes}_per_m"] for axes in ("xx", "xy", "yy")] == pytest.approx([0, 0, 20], abs=2.0)
    assert not [name for name in make().names if name.startswith("true")]


def test_an_episode_can_be_recorded(make, tmp_path):
    env = make(estimate=False, record=tmp_path)
    env.reset(seed=1)
    for _ in range(5):
        env.step(np.array([0.5, 0, 0], dtype=np.float32))
    env.close()
    log = load_table(tmp_path / "episode-0001" / "log.npz")
    assert (log.phase == 3).sum() == 5 * 16 + 1
    assert (tmp_path / "episode-0001" / "summary.json").is_file()


def test_the_agent_of_the_example_scans_its_lanes():
    learn_touch_scan.open_environment()
    assert 60 < learn_touch_scan.episode_return((learn_touch_scan.fixed(0.4), 2, "train")) < 24 * 16
    learn_touch_scan.env.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"observation": "all"}, "observation: expected one of features, tactile, oracle, got 'all'"),
        ({"control_hz": 30.0}, "control_hz: expected a whole part of cycle.rate_hz = 400, got 30"),
        ({"scene": "press"}, 'expected task.kind = "scan"'),
    ],
)
def test_wrong_arguments_are_refused(arguments, message):
    with pytest.raises(UsageError, match=message):
        canprobe.lab.gym.TouchScan(**arguments)


def test_without_gymnasium_it_says_what_to_install(monkeypatch):
    monkeypatch.delitem(sys.modules, "canprobe.lab.gym")
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(UsageError, match=r"canprobe\.lab\.gym needs the package gymnasium: pip install .*\[gym\]"):
        __import__("canprobe.lab.gym")


@pytest.mark.slow(reason="the whole example in a process; tests/cli/test_interrupts.py is of commands")
def test_the_example_ends_in_one_line_at_ctrl_c():
    command = [sys.executable, "-m", "canprobe.lab.examples.learn_touch_scan", "--population", "2", "--episodes", "1"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    with subprocess.Popen(command, **pipes) as process:
        assert process.stdout.readline().startswith("seed 0, generation 0")
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=patience_s(60))
    assert (process.returncode, err) == (130, "interrupted\n")


def test_coverage_counts_each_part_once():
    coverage = Coverage(40e-3, 20e-3)
    disc = coverage.touch(np.zeros(2))
    assert disc == pytest.approx(np.pi * TOUCH_RADIUS_M**2, rel=0.1)
    assert coverage.touch(np.zeros(2)) == 0.0
    for x in np.arange(0.5e-3, 10.01e-3, 0.5e-3):
        coverage.touch(np.array((x, 0.0)))
    assert coverage.area == pytest.approx(disc + 10e-3 * 2 * TOUCH_RADIUS_M, rel=0.2)
    assert coverage.share == pytest.approx(coverage.area / (40e-3 * 20e-3))
    left = coverage.left(np.array((10e-3, 0.0)))  # it came from behind: nothing is left there, all is ahead
    assert left[0] == 1.0 and left[4] < 0.5 < left[2]
    corner = coverage.left(np.array((19.9e-3, 9.9e-3)))
    assert corner[0] == corner[1] == corner[2] == 0.0 and corner[5] == 1.0
    assert coverage.touch(np.array((20e-3 + SIGHT_RADIUS_M, 0.0))) == 0.0


def test_an_action_that_is_not_three_finite_numbers_is_refused(make):
    env = make()
    env.reset(seed=0)
    for action in ([np.inf, 0, 0], [np.nan, 0, 0], ["1", "0", "0"], [1j, 0, 0], [], [0, 0], None):
        with pytest.raises(UsageError, match=r"^action: expected"):
            env.step(action)
