"""An arm of Universal Robots for `canprobe.run(scene, arm=arm)`, by ur_rtde (`pip install ur-rtde`).

    with UrArm("192.168.0.10", silence_s=0.1) as arm:
        canprobe.run("my_scene.toml", arm=arm)

Set payload and safety limits at the controller, and put it under remote control.
"""

import numpy as np
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
from scipy.spatial.transform import Rotation


class UrArm:
    """One arm.

    Args:
        host: address of its controller.
        silence_s: from the first command on, the controller ends its program and stops the arm after so long without a
            sign of life, by its own watchdog; `arm.stop_after_ms` of the cell.
        rate_hz: rate of its poses: up to 500 Hz, on the CB3 series 125 Hz.
        lookahead_s, gain: of `servoj`; more lookahead is smoother, and later by as much.
    """

    def __init__(self, host, *, silence_s, rate_hz=500.0, lookahead_s=0.03, gain=500):
        self._servo = 0.0, 0.0, 1.0 / rate_hz, lookahead_s, gain  # the controller does not use the first two
        self._state = RTDEReceiveInterface(host, rate_hz, ["timestamp", "actual_TCP_pose"])
        self._control = RTDEControlInterface(host, rate_hz)
        self._control.setTcp([0.0] * 6)  # the poses of its program are then those of the flange
        self._silence_s, self._watched, self._servos = silence_s, False, False

    def read(self):
        """Pose of the flange in base, (4, 4), m, and its time on the controller's clock, ns."""
        if not self._state.isConnected():
            raise ConnectionError("the controller's poses have ended")
        if self._watched and not self._servos:  # else it would take the place of a command that is on its way
            self._control.kickWatchdog()
        while True:  # pose and time of one package: each call takes them from the newest
            t_s, values = self._state.getTimestamp(), self._state.getActualTCPPose()
            if t_s == self._state.getTimestamp():
                break
        T_base_flange = np.eye(4)
        T_base_flange[:3, 3] = values[:3]
        T_base_flange[:3, :3] = Rotation.from_rotvec(values[3:]).as_matrix()
        return T_base_flange, round(1e9 * t_s)

    def command(self, T_base_flange):
        """Let the flange follow."""
        if not self._watched:
            self._watched = self._control.setWatchdog(1.0 / self._silence_s)
        self._servos = True
        turn = Rotation.from_matrix(T_base_flange[:3, :3]).as_rotvec()
        if not self._control.servoL([*T_base_flange[:3, 3], *turn], *self._servo):
            raise ConnectionError("the controller's program has ended: see its log for a protective stop")

    def stop(self):
        """Brake, whatever the arm does."""
        self._servos = False
        if self._control.isProgramRunning():  # else it stands already
            self._control.servoStop()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        try:
            self.stop()
            self._control.stopScript()
        finally:
            self._control.disconnect()
            self._state.disconnect()
