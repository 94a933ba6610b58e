"""Observations → neutral samples, in the bridge's process: patch, contact, frames and the state of the nodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from canprobe.cell.master.array import make_patch_reader
from canprobe.cell.master.controller import Measurement
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.setup import Setup, Touch
from canprobe.cell.tasks.from_plan import make_sensing
from canprobe.cell.tasks.probing import Phase
from canprobe.cell.tasks.sensing import ContactSensing
from canprobe.lab.bridge.codec import Received
from canprobe.lab.bridge.node_states import Health
from canprobe.lab.bridge.sample import ContactFrame, Sample, SurfacePatch, TouchFrame
from canprobe.mechanics.touch.contact import pad_to_direction
from canprobe.mechanics.touch.stops import TOUCH_FORCE
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation

_PHASES = {float(phase): phase.name.lower() for phase in Phase}


class SampleSource:
    """Makes the samples of one run, with the scene's own calibration and geometry.

    Args:
        plan: plan of the run.
    """

    def __init__(self, plan: Plan) -> None:
        arm, probe = plan.setup.arm, plan.setup.probe
        self._health = Health(plan)
        self._sensing = _sensing(plan.setup)
        self._has_arm = arm is not None
        self._radius = probe.radius
        # one reader: that of the contacts, or that of an array without them
        self._reader = self._sensing.reader if self._sensing is not None else make_patch_reader(plan.setup)

    def sample(self, received: Received) -> Sample:
        """The sample of one observation."""
        measurement, t_ns = received.measurement, received.t_ns
        diagnostics = self._health.step(t_ns, received)
        sample = Sample(t_ns, frames=received.frames, diagnostics=diagnostics, dropped=received.dropped)
        if measurement is None:
            return sample
        self._place_on(received.patch)  # before the contact, as the task does
        if received.depth is not None and self._sensing is not None:
            self._sensing.set_depth_at_1_n(received.depth * 1e-3)
        return replace(
            sample,
            cycle=measurement.cycle,
            phase=_PHASES.get(received.phase) if received.phase is not None else None,
            q=measurement.q if self._has_arm else None,
            touch=self._touch(measurement, t_ns - measurement.t_ns),
            patch=received.patch,
            ahead=None if received.ahead is None else 1e-3 * received.ahead,
        )

    def _touch(self, m: Measurement, shift_ns: int) -> TouchFrame | None:
        """The array's frame; ``shift_ns`` converts the cycle's clock to that of the samples."""
        sensing, sample = self._sensing, m.tactile
        patch = sensing.step(m) if sensing is not None else None
        if sample is None or self._reader is None:
            return None
        if patch is None:
            patch = self._reader.read(sample)
        contact = sensing.contact(sample, patch) if sensing is not None and patch.force > TOUCH_FORCE / 2 else None
        placed = None
        if contact is not None:
            placed = ContactFrame(homogeneous(tangent_rotation(-contact.n_base), contact.p_base))
        force = np.zeros(3)
        if patch.force > 0.0:  # the object pushes the probe back along the direction of the contact
            force = -patch.force * pad_to_direction(patch.u, patch.v, self._radius)
        return TouchFrame(
            t_ns=sample.t_sample_ns + shift_ns,
            counts=sample.frame.taxels if sample.frame.features is None else None,
            force=force,
            contact=placed,
        )

    def _place_on(self, patch: SurfacePatch | None) -> None:
        """Place contacts on the estimated curvature from now on."""
        if patch is not None and self._sensing is not None and all(patch.observed):
            low, high = np.linalg.eigvalsh(patch.K).tolist()
            self._sensing.set_kappa(np.array([high, low]))


def _sensing(setup: Setup) -> ContactSensing | None:
    """Sensing that places contacts, where there is an arm; it needs no second moments."""
    touch = setup.touch
    if touch is None:
        return None
    return make_sensing(replace(touch, shape=None) if isinstance(touch, Touch) else touch)
