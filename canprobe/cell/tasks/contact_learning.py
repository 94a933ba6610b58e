"""What a touch learns of its contact while it lasts, and how the servo's surface moves with it.

The depth that belongs to a force follows from the layer's stiffness and the surface's curvature. Where either becomes
better known, the depth changes; the surface rises as much, so that the force does not jump.
"""

from __future__ import annotations

import numpy as np

from canprobe.cell.tasks.sensing import ContactSensing
from canprobe.cell.tasks.shape import ShapeTracker
from canprobe.mechanics.touch import CalibrationCheck, ContactSample, Slope, SurfaceEstimate
from canprobe.mechanics.touch.layer_stiffness import PushFit
from canprobe.mechanics.touch.servo import LocalSurface
from canprobe.mechanics.types import Floats

MAX_SLOPE_SIGMA_SHARE = 0.12
"""Share of itself to which the slope of √F over the push must be known (1σ) before it is used."""
CALIBRATE = "type `canprobe calibrate array CELL` and name its file as sensor.calibration"


class ContactLearning:
    """Learns of a contact from the growing force, from the estimator, and from images that contradict the calibration.

    Args:
        sensing: contacts from measurements, which go by what is learned.
        shape: the estimator in the loop; None where no shape is asked for.
        check: compares the array with its calibration; None where nothing can be compared.

    Attributes:
        sensing: as above.
        remarks: that the calibration is another array's, once.
        columns: columns of the log with the newest estimate.
    """

    def __init__(self, sensing: ContactSensing, shape: ShapeTracker | None, check: CalibrationCheck | None) -> None:
        self.remarks: list[str] = []
        self.columns: dict[str, float | Floats] = {}
        self.check = check
        self.sensing, self._shape = sensing, shape
        self._push = PushFit()
        self._push_from: tuple[Floats, Floats] | None = None

    @property
    def stiffness_known(self) -> bool:
        """Whether the growing force has shown how stiff this touch is."""
        return self._push.certain(MAX_SLOPE_SIGMA_SHARE)

    def push(self, contact: ContactSample, surface: LocalSurface) -> float:
        """Learn from the growing force how stiff this touch is; the way by which the surface rises with it, m."""
        sensing = self.sensing
        centre = contact.p_base + contact.n_base * (sensing.radius - sensing.depth(contact.force_n))
        if self._push_from is None:
            self._push_from = centre, contact.n_base
            self._push = PushFit(sensing.position_sigma(contact.n_base))
        first, normal = self._push_from
        self._push.add(float(normal @ (first - centre)), contact.force_n)
        if not self.stiffness_known:
            return 0.0
        before = sensing.depth(contact.force_n)
        sensing.set_slope(Slope(self._push.slope, self._push.sigma))
        rise = sensing.depth(contact.force_n) - before
        surface.raise_by(rise)
        return rise

    def follow(self, estimate: SurfaceEstimate, contact: ContactSample, surface: LocalSurface) -> bool:
        """Use an estimate for the next targets, where it has observed all curvature; whether it has."""
        self.columns = {
            "kappa_per_m": np.where(estimate.observed, estimate.kappa, np.nan),
            "T_base_contact_m": estimate.T_frame_contact,
            "K_per_m": estimate.K,
            "K_covariance_per_m2": estimate.covariance,
        }
        if not bool(np.all(estimate.observed)):
            return False
        surface.set_curvature(estimate.curvature_tensor_base())
        before = self.sensing.depth(contact.force_n)
        self.sensing.set_kappa(np.asarray(estimate.kappa), estimate.stiffness)
        surface.raise_by(self.sensing.depth(contact.force_n) - before)
        return True

    def doubt(self) -> None:
        """Answer with less certainty where the array is not as its calibration says."""
        check = self.check
        if check is None or not check.work() or (finding := check.finding) is None:
            return
        self.sensing.reader.widen(check.force_spread)
        if self._shape is not None:
            self._shape.doubted = check.image_model_off
        if check.contradicted:
            self.sensing.leave_out_moments()
        if not self.remarks:
            wider = "forces and regions" if check.image_model_off else "forces"
            self.remarks.append(f"{finding}: {wider} are stated wider from here on; {CALIBRATE}")
