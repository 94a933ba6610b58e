"""An observation survives the way into a bridge's process."""

import math

import numpy as np
import pytest

import canprobe
from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.master.observers import Observation
from canprobe.cell.master.tactile_frame import TactileFrame, TactileSample
from canprobe.fieldbus.protocol.tactile import Features, TactileHeader, TactileMode
from canprobe.lab.bridge.pipe import pack_observation, unpack_observation
from canprobe.lab.bridge.sampling import SampleSource

FREE = canprobe.plan("free")
WINDOW = TactileFrame(
    TactileHeader(7, 200, 3, 4, TactileMode.WINDOW, True, 5000, 0xBEEF),
    np.arange(256, dtype=np.uint8).reshape(16, 16),
    (3, 4, 8, 8),
    None,
    123,
)
FEATURES = TactileFrame(
    TactileHeader(8, 1, 1, 2, TactileMode.FEATURES, False, 100, 1),
    np.zeros((16, 16), np.uint8),
    (0, 0, 0, 0),
    Features(1.5, 7.5, 8.25, 1.5, -0.25, 2.0, 18),
    456,
)


@pytest.mark.parametrize("frame", [WINDOW, FEATURES], ids=["window", "features"])
def test_a_measurement_comes_out_as_it_went_in(frame):
    q = np.array([1e-9, -2.0, math.pi, 0.0, -0.0, 5.5])
    words, sample = (0x1237,) * 6, TactileSample(frame, 97_500_000, 39)
    sent = Measurement(41, 102_500_000, q, (0, 1, 2, 0, 0, 0), (-5, 4, 3, 2, 1, 0), words, True, sample, 2)
    frames = [(0x80, b"\x01", 5), (0x80000123, b"12345678", 6), (0x40000181, b"", 7)]
    got = unpack_observation(pack_observation(Observation(99, sent, None, frames), 3))
    assert (got.t_ns, got.frames, got.dropped, got.phase, got.patch) == (99, frames, 3, None, None)
    m = got.measurement
    np.testing.assert_array_equal(m.q, q)
    for name in ("cycle", "t_ns", "q_age", "torque_permille", "statuswords", "enabled", "tactile_age"):
        assert getattr(m, name) == getattr(sent, name)
    assert (m.tactile.t_sample_ns, m.tactile.cycle) == (97_500_000, 39)
    assert (m.tactile.frame.header, m.tactile.frame.window, m.tactile.frame.features, m.tactile.frame.t_ns) == (
        *(frame.header, frame.window, frame.features, frame.t_ns),
    )
    np.testing.assert_array_equal(m.tactile.frame.taxels, frame.taxels)


def test_frames_alone_and_a_command_without_an_arm():
    got = unpack_observation(pack_observation(Observation(5, None, None, []), 17))
    assert got.measurement is None and got.frames == []
    assert SampleSource(FREE).sample(got).dropped == 17, "samples lost before it, which a viewer is shown"
    command = Command(columns={"phase": 3.0, "force_n": 1.0})
    got = unpack_observation(pack_observation(Observation(5, Measurement(0, 0), command, [])))
    assert got.phase == 3.0 and got.measurement.q is None
    assert got.ahead is None
    command = Command(columns={"explored_ahead_mm": np.arange(6.0).reshape(2, 3)})
    got = unpack_observation(pack_observation(Observation(5, Measurement(0, 0), command, [])))
    np.testing.assert_array_equal(got.ahead, [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]])


@pytest.mark.parametrize(("value", "phase"), [(np.float64(2.5), 2.5), (np.int64(3), 3.0), (np.zeros(3), None)])
def test_a_controller_of_ones_own_may_call_anything_a_phase(value, phase):
    """Its columns are its own business: they neither stop the bridge nor are taken for our task's phases."""
    command = Command(columns={"phase": value})
    got = unpack_observation(pack_observation(Observation(5, Measurement(0, 0), command, [])))
    assert got.phase == phase
    sample = SampleSource(FREE).sample(got)
    assert sample.phase == ("scan" if phase == 3.0 else None)


def test_an_estimate_keeps_what_was_not_observed():
    class Estimate:
        T_frame_contact = np.arange(16.0).reshape(4, 4)
        K = np.array([[1.0, 2.0], [2.0, np.nan]])
        covariance = np.diag([1.0, np.inf, 3.0])
        observed = np.array([True, False])

    got = unpack_observation(pack_observation(Observation(5, Measurement(0, 0), Command(estimate=Estimate()), [])))
    np.testing.assert_array_equal(got.patch.T_base_contact, Estimate.T_frame_contact)
    np.testing.assert_array_equal(got.patch.K, Estimate.K)
    np.testing.assert_array_equal(got.patch.covariance, Estimate.covariance)
    assert got.patch.observed == (True, False)
