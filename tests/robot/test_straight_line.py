"""Arithmetic on symbols gives the function that the same arithmetic on floats is."""

import math

import numpy as np
import pytest

from canprobe.robot.straight_line import call, compiled, matrix_product, where

RNG = np.random.default_rng(0)


def everything(a, b):
    """All operations, on either side, with folded and with plain constants."""
    x, y, z = a
    u, v = b
    return [
        x + y, x - y, x * y, x / y, -x, 2.0 + x, 2.0 - x, 3.0 * x, 1.0 / x, x + 0.0, 0.0 - x,
        x * 0.0, x * -1.0, 1.0 * y, x - -y, x + -y, -x * y, -x * -y, x * -z, -(-x * z), -(0.0 - x),
        (x + y) * (x + y), u * x + v * y, 0.0, 7.5,
    ]  # fmt: skip


def test_operators_are_those_of_floats():
    a, b = RNG.normal(size=3).tolist(), RNG.normal(size=2).tolist()
    assert compiled("f", everything, {}, a=3, b=2)(a, b) == pytest.approx(everything(a, b), rel=1e-15, abs=0.0)


def test_known_zeros_vanish_and_nothing_is_worked_out_twice():
    def work(a, b):
        s = a[0] * b[0] + a[1] * b[1]
        return [s * s + call("sin", s), (a[0] * b[0] + a[1] * b[1]) - 1.0]

    f = compiled("f", work, {"sin": math.sin}, a=2, b=(3.0, 0.0))
    assert f.source.count("a0 * b0") == 1
    assert "a1 *" not in f.source
    s = 0.7 * 3.0
    assert f((0.7, 9.0), (3.0, 9.0)) == pytest.approx((s * s + math.sin(s), s - 1.0), rel=1e-15)


def test_what_nobody_needs_is_not_in_the_function():
    def work(a):
        call("sqrt", a[0])
        return [a[1] + 1.0]

    f = compiled("f", work, {}, a=2)
    assert "sqrt" not in f.source
    assert f((-1.0, 2.0)) == (3.0,)


@pytest.mark.parametrize(("x", "expected"), [(-1.0, 5.0), (2.0, 0.5), (math.nan, 5.0)])
def test_where_works_out_one_side_only(x, expected):
    f = compiled("f", lambda a: [where(">", a[0], 0.0, 1.0 / call("sqrt", a[0] * 2.0), 5.0)], {"sqrt": math.sqrt}, a=1)
    assert f((x,)) == (expected,)


def test_long_expressions_are_cut_in_pieces():
    def work(a):
        total = a[0]
        for _ in range(400):
            total = 0.5 * total + a[1]
        return [total]

    assert compiled("f", work, {}, a=2)((1.0, 1.0)) == pytest.approx(work((1.0, 1.0)))


def test_a_product_with_a_matrix_leaves_zeros_out():
    A = RNG.normal(size=(3, 4)) * np.array(((1, 0, 1, 0), (0, 1, 0, 0), (1, 1, 1, 1)))
    x = RNG.normal(size=4)
    f = matrix_product(A.tolist())
    assert f(x.tolist()) == pytest.approx((A @ x).tolist(), rel=1e-14)
    assert f.source.count("*") == np.count_nonzero(A)
