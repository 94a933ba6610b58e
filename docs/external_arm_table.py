"""The table of docs/external-arm.md: where the servo of an external arm settles behind a dead time.

`python docs/external_arm_table.py`: for each arm the verge of the sampled loop, and how presses in direct mode end on a
contact six times as stiff as stated, at the bandwidth that the plan allows and at three times it, without learning the
stiffness.
"""

from __future__ import annotations

import math
from dataclasses import replace

from canprobe.cell.planning.external_arm import HIGHEST, STIFFER, loop_delay_s
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.plant.ideal_arm import natural_frequency
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import PlantSettings
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import CanprobeError
from canprobe.lab.studies.linear_loop import ForceLoop, spectral_radius
from canprobe.lab.studies.stability_runs import error_and_spread, stated_sensing

STATED_N_M3, FORCE_N = 2e7, 2.0
SHARES = (1.0, 3.0)
ARMS = tuple((rate_hz, delay_ms) for rate_hz in (125.0, 500.0) for delay_ms in (4.0, 8.0, 16.0, 40.0))


def verge_hz(rate_hz: float, delay_ms: float) -> float:
    """Bandwidth at which the sampled loop is on the verge of stability; half of the dead time each way."""
    omega, images = natural_frequency(PlantSettings().drive_bandwidth_hz), max(1, round(rate_hz / 250.0))
    low, high = 0.5, 100.0
    for _ in range(20):
        middle = math.sqrt(low * high)
        loop = ForceLoop(STIFFER, 1.0 / rate_hz, images, middle, 0.5e-3 * delay_ms, omega)
        low, high = (middle, high) if spectral_radius(loop) < 1.0 else (low, middle)
    return low


def plan_of(rate_hz: float, delay_ms: float, hold_s: float = 1.0) -> Plan:
    """Plan of a press with a gain that is low enough for every arm."""
    keys = {
        "cell": "external",
        "bus.interface": "direct",
        "cycle.rate_hz": rate_hz,
        "sensor.rate_hz": min(rate_hz, 250.0),
        "sensor.mode": "features",
        "sensor.full_scale_kpa": 300,
        "arm.delay_ms": delay_ms,
        "probe.stiffness_n_m3": STATED_N_M3,
        "plant.stiffness_n_m3": STIFFER**2 * STATED_N_M3,
        "object": {"kind": "plane", "position_mm": (-120, -122.5, 374)},
        "task.duration_s": hold_s,
        "task.clearance_mm": 0.2,
        "task.approach_mm_s": 0.5,
        "servo.surface_height_hz": 0.5,
        "plant.hysteresis": False,
        "plant.creep": False,
        "limits.force_max_n": 20,
    }
    return make_plan(resolve(load_scene("press", keys)))


def press(plan: Plan, height_hz: float) -> str:
    """How a press ends with a gain: the spread of the force in its second half, or why it was stopped."""
    task = plan.setup.task
    task = replace(task, gains=replace(task.gains, height_hz=height_hz))
    session = Session(replace(plan, setup=replace(plan.setup, task=task)))
    controller = make_task(session.plan)
    controller.sensing = controller.learned.sensing = stated_sensing(session.plan.scene)
    try:
        with session:
            session.run(controller)
    except CanprobeError as error:
        return f"stopped: {str(error).partition(':')[0]}"
    _, spread = error_and_spread(session, controller, FORCE_N)
    return "no hold" if spread is None else f"{spread:.0f} %"


def main() -> None:
    """Print the table."""
    print("| arm | dead time | loop | allowed | verge of the sampled loop | spread as allowed | at three times |")
    print("| --- " * 7 + "|")
    for rate_hz, delay_ms in ARMS:
        plan = plan_of(rate_hz, delay_ms)
        delay_s = loop_delay_s(plan.setup, plan.setup.task)
        highest = HIGHEST / delay_s
        numbers = f"{rate_hz:g} Hz", f"{delay_ms:g} ms", f"{1e3 * delay_s:.0f} ms", f"{highest:.1f} Hz"
        ends = [press(plan, share * highest) for share in SHARES]
        print(f"| {' | '.join([*numbers, f'{verge_hz(rate_hz, delay_ms):.1f} Hz', *ends])} |", flush=True)


if __name__ == "__main__":
    main()
