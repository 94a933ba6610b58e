"""Observations → neutral samples, in the bridge's process: patch, contact, frames and the state of the nodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from canprobe.bridge.codec import EstimateParts, Received
from canprobe.bridge.health import Health
from canprobe.bridge.sample import CanFrame, ContactFrame, Joints, Sample, SurfacePatch, TaxelImage, Wrench
from canprobe.bus.port import EFF_FLAG, RTR_FLAG, TimedFrame
from canprobe.cell.measurement import Measurement, TactileSample
from canprobe.cell.supervision import TOUCH_FORCE
from canprobe.cell.tasks.calibration import array_calibration
from canprobe.cell.tasks.probing import Phase
from canprobe.cell.tasks.sensing import ContactSensing, patch_of
from canprobe.planning.model import Plan
from canprobe.robot.kinematics import forward
from canprobe.scene_setup import Setup, Touch
from canprobe.touch.contact import ContactSample, pad_to_direction
from canprobe.touch.frames import homogeneous, tangent_rotation
from canprobe.touch.patch import Patch

Array = NDArray[np.float64]
_PHASES = {float(phase): phase.name.lower() for phase in Phase}


class SampleSource:
    """Makes the samples of one run, with the scene's own calibration and geometry.

    Args:
        plan: of the run.
    """

    def __init__(self, plan: Plan) -> None:
        arm, array, probe = plan.setup.arm, plan.setup.array, plan.setup.probe
        self._health = Health(plan)
        self._sensing = _sensing(plan.setup)
        self._model = arm.model if arm is not None else None
        self._T_flange_probe = probe.T_flange_probe if plan.setup.scene.probe is not None else None
        self._radius = probe.radius
        self._calibration = array_calibration(array.full_scale, probe.radius) if array is not None else None

    def sample(self, received: Received) -> Sample:
        """The sample of one observation."""
        measurement, t_ns = received.measurement, received.t_ns
        frames = tuple(_frame(frame) for frame in received.frames)
        diagnostics = self._health.step(t_ns, received)
        if measurement is None:
            return Sample(t_ns, frames=frames, diagnostics=diagnostics, dropped=received.dropped)
        self._feel(received.estimate)  # before the contact, as the task does
        if received.depth is not None and self._sensing is not None:
            self._sensing.set_depth_at_1_n(received.depth * 1e-3)
        taxels, wrench, contact = self._touch(measurement, t_ns - measurement.t_ns)
        return Sample(
            t_ns,
            cycle=measurement.cycle,
            phase=_PHASES.get(received.phase) if received.phase is not None else None,
            joints=self._joints(measurement),
            taxels=taxels,
            wrench=wrench,
            contact=contact,
            patch=self._patch(received),
            frames=frames,
            diagnostics=diagnostics,
            dropped=received.dropped,
        )

    def _joints(self, m: Measurement) -> Joints | None:
        if m.q is None or self._model is None:
            return None
        tool = self._T_flange_probe
        T = forward(self._model, m.q) @ tool if tool is not None else None
        return Joints(m.q, T, m.q_age, m.torque_permille, m.statuswords)

    def _patch(self, received: Received) -> SurfacePatch | None:
        estimate = received.estimate
        if estimate is None:
            return None
        return SurfacePatch(received.t_ns, estimate.T_frame_contact, estimate.K, estimate.covariance, estimate.observed)

    def _touch(self, m: Measurement, shift_ns: int) -> tuple[TaxelImage | None, Wrench | None, ContactFrame | None]:
        """What the array felt; ``shift_ns`` takes the cycle's clock to that of the samples."""
        sensing, sample = self._sensing, m.tactile
        patch = sensing.step(m) if sensing is not None else None
        if sample is None or self._calibration is None:
            return None, None, None
        if patch is None:
            patch = patch_of(sample, self._calibration)
        t_ns = sample.t_sample_ns + shift_ns
        felt = patch.force > TOUCH_FORCE / 2
        contact = sensing.contact(sample, patch) if sensing is not None and felt else None
        wrench = _wrench(t_ns, patch, self._radius)
        return _image(sample, t_ns), wrench, _contact(t_ns, contact) if contact is not None else None

    def _feel(self, estimate: EstimateParts | None) -> None:
        """Contacts are placed on the estimated curvature from now on."""
        if estimate is not None and self._sensing is not None and all(estimate.observed):
            low, high = np.linalg.eigvalsh(estimate.K).tolist()
            self._sensing.set_kappa(np.array([high, low]))


def _sensing(setup: Setup) -> ContactSensing | None:
    """Contacts, where there is an arm to place them; second moments are the estimator's business."""
    from canprobe.cell.tasks.build import make_sensing

    touch = setup.touch
    if touch is None:
        return None
    return make_sensing(replace(touch, shape=None) if isinstance(touch, Touch) else touch)


def _frame(frame: TimedFrame) -> CanFrame:
    can_id, data, t_ns = frame
    if can_id <= 0x7FF:
        return CanFrame(t_ns, can_id, data)
    extended = bool(can_id & EFF_FLAG)
    return CanFrame(t_ns, can_id & (0x1FFFFFFF if extended else 0x7FF), data, extended, bool(can_id & RTR_FLAG))


def _image(sample: TactileSample, t_ns: int) -> TaxelImage | None:
    """The taxels; None in features mode, where there are none."""
    frame = sample.frame
    if frame.features is not None:
        return None
    row, column, rows, _ = frame.window
    return TaxelImage(t_ns, frame.taxels, (row, column) if rows < 16 else None, frame.header.overload)


def _wrench(t_ns: int, patch: Patch, radius: float) -> Wrench:
    """The object pushes the probe back along the direction in which it is felt."""
    if patch.force <= 0.0:
        return Wrench(t_ns, np.zeros(3), np.zeros(3))
    return Wrench(t_ns, -patch.force * pad_to_direction(patch.u, patch.v, radius), np.zeros(3))


def _contact(t_ns: int, contact: ContactSample) -> ContactFrame:
    return ContactFrame(t_ns, homogeneous(tangent_rotation(-contact.n_base), contact.p_base), contact.force_n)
