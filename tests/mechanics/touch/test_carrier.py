"""The frame of a carrier, against scipy's rotations, and its place between and after reported positions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from canprobe.mechanics.touch.carrier import CarrierMotion, CarrierTrack

AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
TURNTABLE = CarrierMotion(AXIS, np.array([0.1, -0.2, 0.3]))
CONVEYOR = CarrierMotion(AXIS, None)


def test_a_turntable_turns_about_its_axis_and_a_conveyor_moves_along_it():
    T = TURNTABLE.T_base_carrier(0.7)
    assert np.allclose(T[:3, :3], Rotation.from_rotvec(0.7 * AXIS).as_matrix(), atol=1e-15)
    on_axis = np.append(TURNTABLE.point + 0.05 * AXIS, 1.0)
    assert np.allclose(T @ on_axis, on_axis, atol=1e-15)
    moved = CONVEYOR.T_base_carrier(0.7)
    assert np.allclose(moved[:3, 3], 0.7 * AXIS) and np.allclose(moved[:3, :3], np.eye(3))


@pytest.mark.parametrize("motion", [TURNTABLE, CONVEYOR])
def test_the_twist_is_the_velocity_of_what_stands_on_it(motion):
    place, speed, dt = np.array([0.3, 0.1, -0.2, 1.0]), 0.4, 1e-6
    ahead, behind = (motion.T_base_carrier(0.9 + sign * speed * dt) @ place for sign in (1, -1))
    here = motion.T_base_carrier(0.9) @ place
    turn, velocity = np.split(motion.twist(speed), 2)
    assert np.allclose(velocity + np.cross(turn, here[:3]), (ahead - behind)[:3] / (2 * dt), atol=1e-9)


def test_a_track_is_linear_between_reports_and_goes_on_at_the_last_speed():
    track = CarrierTrack(CONVEYOR)

    def at(t_ns):
        return float(track.T_base_carrier(t_ns)[:3, 3] @ AXIS)

    track.add(1_000_000, 0.1)
    assert at(9_000_000) == pytest.approx(0.1)  # of one report no speed is known
    track.add(3_000_000, 0.3)
    track.add(5_000_000, 0.5)
    assert [at(t) for t in (2_000_000, 5_000_000, 8_000_000)] == pytest.approx([0.2, 0.5, 0.8])
