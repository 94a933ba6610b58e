"""An arm that MuJoCo simulates, for `canprobe.run(scene, arm=arm)`: any MJCF with a position actuator for each joint.

    arm = MujocoArm(mujoco.MjModel.from_xml_path("panda.xml"), "flange", time.monotonic_ns, q_start)
    canprobe.run("my_scene.toml", arm=arm)

Its controller does what a maker's does: it smooths its targets, compensates gravity, feeds speed and acceleration
forward, and an integral part takes out what a load at the flange bends away.
"""

import mujoco
import numpy as np


class MujocoArm:
    """One arm.

    Args:
        model: the MJCF, compiled; every actuator is a position actuator of a joint.
        flange: name of the site at its flange.
        clock: time now, ns: simulated time is moved on to it, in whole steps of the model.
        q_start: joint positions to start from (n,), rad.
        lag_s: lag behind a steady motion of the targets, s, by smoothing them; `servo.drive_lag_ms` of the scene.
        integral_s: time constant of the integral part, s.
        stop_after_s: it stops so long after the last command, s; `arm.stop_after_ms` of the cell.
    """

    def __init__(self, model, flange, clock, q_start, *, lag_s=0.015, integral_s=0.05, stop_after_s=0.1):
        self.model, self.data, self._ghost = model, mujoco.MjData(model), mujoco.MjData(model)
        self._site, self._clock = model.site(flange).id, clock
        joints = model.actuator_trnid[:, 0]
        self._q, self._dof, self._range = model.jnt_qposadr[joints], model.jnt_dofadr[joints], model.jnt_range[joints]
        self._lead_s = (model.dof_damping[self._dof] - model.actuator_biasprm[:, 2]) / model.actuator_gainprm[:, 0]
        self._step_ns, self._patience_ns = round(1e9 * model.opt.timestep), round(1e9 * stop_after_s)
        self._w, self._gain = 2.0 / lag_s, model.opt.timestep / integral_s
        self.t_ns = self._last_ns = self._clock()
        self._hold(np.array(q_start, dtype=float))

    def _hold(self, q):
        """Be at rest at joint positions."""
        self.data.qpos[self._q], self.data.qvel[:] = q, 0.0
        self._target, self._reference, self._speed, self._left = q, q, 0.0 * q, 0.0 * q
        mujoco.mj_forward(self.model, self.data)

    def place(self, T_base_flange):
        """Put the flange at a pose at once, at rest: where it begins."""
        self._hold(self._inverse(T_base_flange))

    def advance(self, t_ns):
        """Move simulated time on, by whole steps."""
        data, model, dt = self.data, self.model, self.model.opt.timestep
        acceleration, inertial = np.zeros(model.nv), np.zeros(model.nv)
        while self.t_ns + self._step_ns <= t_ns:
            self.t_ns += self._step_ns
            if self.t_ns - self._last_ns > self._patience_ns:
                self._target = self._reference
            acceleration[self._dof] = self._w * (self._w * (self._target - self._reference) - 2.0 * self._speed)
            self._speed = self._speed + dt * acceleration[self._dof]
            self._reference = self._reference + dt * self._speed
            mujoco.mj_step1(model, data)
            mujoco.mj_mulM(model, data, inertial, acceleration)
            self._left += self._gain * (self._reference - data.qpos[self._q])
            data.ctrl[:] = self._reference + self._left + self._lead_s * self._speed
            data.qfrc_applied[self._dof] = (data.qfrc_bias + inertial)[self._dof]
            mujoco.mj_step2(model, data)

    def read(self):
        """Pose of the flange in base, (4, 4), m, and its time, ns."""
        self.advance(self._clock())
        mujoco.mj_kinematics(self.model, self.data)
        return self._pose(self.data), self.t_ns

    def command(self, T_base_flange):
        """Let the flange follow."""
        self.advance(self._clock())
        self._target, self._last_ns = self._inverse(T_base_flange), self.t_ns

    def stop(self):
        """Stay here."""
        self._target = self._reference

    def _pose(self, data):
        T_base_flange = np.eye(4)
        T_base_flange[:3, 3] = data.site_xpos[self._site]
        T_base_flange[:3, :3] = data.site_xmat[self._site].reshape(3, 3)
        return T_base_flange

    def _inverse(self, T_base_flange):
        """Joint positions (n,) of a pose, by Newton steps from the last target; more than six joints move least."""
        model, ghost, q = self.model, self._ghost, self._target.copy()
        J = np.zeros((6, model.nv))
        for _ in range(30):
            ghost.qpos[self._q] = q
            mujoco.mj_kinematics(model, ghost)
            mujoco.mj_comPos(model, ghost)
            here = self._pose(ghost)
            turn = T_base_flange[:3, :3] @ here[:3, :3].T
            axis = 0.5 * np.array((turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]))
            left = np.concatenate((T_base_flange[:3, 3] - here[:3, 3], axis))
            if np.abs(left).max() < 1e-10:
                break
            mujoco.mj_jacSite(model, ghost, J[:3], J[3:], self._site)
            q += np.linalg.lstsq(J[:, self._dof], left, rcond=1e-6)[0]
        else:
            raise ValueError(f"the arm does not reach the pose {T_base_flange.tolist()}")
        if np.any(q < self._range[:, 0]) or np.any(q > self._range[:, 1]):
            raise ValueError(f"the pose {T_base_flange.tolist()} is beyond a joint's stop")
        return q
