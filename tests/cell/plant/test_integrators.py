"""Observed order of every step, exactness where promised, stiff stability, against closed forms and Radau."""

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from canprobe.cell.plant.integrators import STEPS, Linearised, adaptive


class Spring:
    """x'' = -k x - c x' - cubic x^3 + sin t, as a problem; the matrix given to the implicit steps may be wrong."""

    def __init__(self, k, c, cubic=0.0, wrong=1.0):
        self.k, self.c, self.cubic, self.wrong = k, c, cubic, wrong

    def rate(self, t, y):
        x, v = y
        return np.array((v, -self.k * x - self.c * v - self.cubic * x**3 + math.sin(t)))

    def drift(self, t, y):
        return np.array((0.0, math.cos(t)))

    def jacobian(self, t, y):
        return np.array(((0.0, 1.0), (-self.k - 3.0 * self.cubic * y[0] ** 2, -self.c)))

    def linearised(self, t, y, g):
        inverse = np.linalg.inv(np.eye(2) - g * self.wrong * self.jacobian(t, y))
        return Linearised(self.rate(t, y), self.drift(t, y), lambda r: inverse @ r)


START, END = np.array((1.0, 0.0)), 2.0


def run(step, problem, steps, end=END, start=START):
    y, h = start, end / steps
    for i in range(steps):
        y = step(problem, i * h, y, h)
    return y


def reference(problem, end=END, start=START):
    found = solve_ivp(problem.rate, (0.0, end), start, "Radau", rtol=1e-10, atol=1e-12, jac=problem.jacobian)
    return found.y[:, -1]


@pytest.mark.parametrize(("name", "order"), [("rk4", 4), ("rosenbrock", 2)])
def test_observed_order_of_convergence(name, order):
    problem = Spring(9.0, 0.5, cubic=3.0)
    exact = reference(problem)
    errors = [np.linalg.norm(run(STEPS[name], problem, n) - exact) for n in (80, 160, 320)]
    observed = [math.log2(a / b) for a, b in itertools.pairwise(errors)]
    assert observed == pytest.approx([order] * 2, abs=0.15)


def test_rosenbrock_keeps_its_order_with_a_wrong_matrix():
    problem = Spring(9.0, 0.5, cubic=3.0, wrong=0.6)
    exact = reference(problem)
    errors = [np.linalg.norm(run(STEPS["rosenbrock"], problem, n) - exact) for n in (160, 320)]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.15)


@pytest.mark.parametrize("name", ["rosenbrock", "adaptive"])
def test_stiff_springs_stay_bounded_and_reach_rest(name):
    problem = Spring(1e10, 1e6)
    y = run(STEPS[name], problem, 40, end=0.1)
    assert abs(y[0] - math.sin(0.1) / 1e10) < 1e-6


def test_adaptive_is_of_second_order_in_the_parts_it_takes():
    class Counted(Spring):
        parts = 0

        def linearised(self, *args):
            self.parts += 1
            return super().linearised(*args)

    problem = Counted(25.0, 1.0, cubic=5.0)
    exact = reference(problem)
    logs = []
    for rtol in np.geomspace(1e-3, 1e-6, 7):
        problem.parts = 0
        y = run(lambda *a, r=rtol: adaptive(*a, rtol=r, atol=r), problem, 4)
        logs.append((math.log(problem.parts), math.log(np.linalg.norm(y - exact))))
    parts, errors = np.array(logs).T
    assert np.polyfit(parts, errors, 1)[0] == pytest.approx(-2.0, abs=0.15)


def test_adaptive_gives_up_instead_of_hanging():
    class Broken(Spring):
        def rate(self, t, y):
            return np.array((math.nan, math.nan))

    with pytest.raises(ArithmeticError, match="needs more than 4096 parts"):
        adaptive(Broken(1.0, 0.0), 0.0, START, 1.0)
