"""Costs of the plant's inner calls. Run with --benchmark-only; skipped by default.

Goals on an idle machine: forward 10 us, Jacobian 25, advance 15, truth 40, image 150, a dynamic cycle 1000.
"""

import numpy as np
import pytest
from puma_arm import BODIES, ELBOW_FORM, UPENN

from canprobe.emulator.plant.config import PlantConfig
from canprobe.emulator.plant.plant import Plant
from canprobe.emulator.plant.probe import depth_for_force
from canprobe.emulator.plant.taxels import TaxelArray, TaxelConfig
from canprobe.robot.chain import forward, forward_jacobian, tool_z_offset
from canprobe.robot.dynamics import RigidBody
from canprobe.robot.inverse import damped_step, inverse_near, start_posture
from canprobe.touch.objects import make_object

POINT, TOOL = np.array((-0.120, -0.1225, 0.374)), tool_z_offset(80.0)
POSE = np.eye(4)
POSE[:3, 3] = POINT
SHAPES = {"cylinder": {"radius": 0.036}, "saddle": {"radius_x": 0.06, "radius_y": -0.08}}


def plant_of(fidelity):
    q0 = start_posture(UPENN, POINT, (0, 0, 1), ELBOW_FORM, radius_m=0.04, T_flange_probe=TOOL, clearance_m=-0.43e-3)
    shape = make_object("cylinder", T_base_object=POSE, radius=0.036)
    return Plant(PlantConfig(UPENN, q0, object=shape, fidelity=fidelity, bodies=BODIES["puma260"]))


@pytest.fixture
def plant():
    return plant_of("ideal")


def test_bench_forward(benchmark):
    benchmark(forward, UPENN.chain, ELBOW_FORM)


def test_bench_forward_jacobian(benchmark):
    benchmark(forward_jacobian, UPENN.chain, ELBOW_FORM, TOOL)


def test_bench_inverse_near(benchmark):
    benchmark(inverse_near, UPENN, forward(UPENN.chain, ELBOW_FORM), np.eye(4), ELBOW_FORM)


def test_bench_damped_step(benchmark):
    benchmark(damped_step, forward_jacobian(UPENN.chain, ELBOW_FORM, TOOL)[1], np.ones(6))


@pytest.mark.parametrize("kind", SHAPES)
def test_bench_closest(benchmark, kind):
    shape = make_object(kind, T_base_object=POSE, **SHAPES[kind])
    benchmark(shape.closest, POINT + np.array((0.003, 0.004, 0.04)))


def test_bench_advance_one_cycle(benchmark, plant):
    def cycle():
        plant.advance(plant.t_ns + 2_500_000)
        return plant.motor_counts(0)

    benchmark(cycle)


def test_bench_rigid_body(benchmark):
    benchmark(RigidBody(UPENN.chain, BODIES["puma260"]).terms, ELBOW_FORM, np.ones(6))


def test_bench_dynamic_cycle_in_contact(benchmark):
    """One 2.5 ms step of the dynamic plant: six new ramps, the arm, and what the drives report."""
    plant = plant_of("dynamic")

    def cycle():
        t = plant.t_ns
        for axis in range(6):
            here = plant.motor_counts(axis)
            plant.set_ramp(axis, here, here + 2.0, t, t + 2_500_000)
        plant.advance(t + 2_500_000)
        return plant.motor_counts(0)

    benchmark(cycle)


def test_bench_truth_one_cycle(benchmark, plant):
    def cycle():
        plant.advance(plant.t_ns + 2_500_000)
        return plant.truth()

    benchmark(cycle)


def test_bench_sample_image(benchmark, plant):
    benchmark(lambda: plant.sample_image(plant.t_ns + 5_000_000))


@pytest.mark.parametrize("kind", SHAPES)
def test_bench_taxel_image(benchmark, kind):
    kappa = tuple(make_object(kind, T_base_object=POSE, **SHAPES[kind]).closest(POINT).kappa.tolist())
    array = TaxelArray(TaxelConfig(), np.random.default_rng(0))
    depth = depth_for_force(2.0, kappa, 0.04, 1.27e8)
    benchmark(array.image, (1e-3, 0.5e-3), depth, kappa, np.eye(2), 0.0)
