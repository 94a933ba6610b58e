"""Pure mathematics of touch: from a tactile image to the local shape of the object, and the servo that follows it.

    image ─► Patch, moments ─► ContactSample ─┬► motion ─► stages ─► SurfaceEstimate ─► curvature ─► servo
       image/                   contact       │  estimate/  online/   estimate/answer
                                              └► SurfaceMap ─► Mesh
                                                  map/         meshing

Reading a touch:

    pad                  where the taxels are, and what their counts mean
    image/               images: force, centroid, moments, and the model of an array
    array_calibration/   the calibration of an array by touches of known objects, and its check
    contact              from the centroid on the wrapped pad to the object's point and normal in base
    layer_stiffness      the stiffness of the layer: from a push, and as a state of a scan
    stops                the limits at which a touch is stopped, and why a touch at rest must not go on

Shape:

    surface           second-order surfaces in one gauge: XᵀSX = 0 with S symmetric (4, 4), f < 0 inside
    estimate/         local shape from contacts, one by one and in batches, with what was not observed
    online/           the estimator in the loop: the stages that refine an answer, and what widens its region
    map/              one surface from all contacts of a scan, with its uncertainty
    meshing           triangles of any surface that gives the closest point to a place
    linear_algebra, checks, tangent_frames   small matrices, input checks, frames on a tangent plane

Motion:

    servo             a local surface that the samples correct, and the next pose of the probe
    strategies        where the contact goes next
    probe_motion      ways between poses, and the joint steps that follow them
    explore/          where to go next, so that the map of a rectangle is sure enough everywhere

True objects, which no estimator sees: `shapes` (a shape at a pose; bowl, wave, fillet, torus), `objects` (all shapes by
name, and the quadrics), `heights` (a spline over a grid), `mesh_fit` (such a spline from a mesh).

Invariants: SI units, base frame unless a name says otherwise. z of a contact frame is the inward normal; in its own
contact frame a surface has c14 = c24 = c44 = 0 and c34 = −½, so that K = 2 [[c11, c12], [c12, c22]] is the curvature;
κ > 0 is convex. Source: Chen, Rink, Zhang, "Local Object Shape From Tactile Sensing", with the corrections that the
docstrings name. The names in `__all__` are for a stranger, from an image to a contact to a shape and to the next pose;
docs/mechanics.md shows the way. Start reading at `contact`, then `estimate/` and `online/`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from canprobe.errors import door

if TYPE_CHECKING:
    from canprobe.mechanics.touch.array_calibration.calibrate import calibrate_array
    from canprobe.mechanics.touch.array_calibration.calibration_check import CalibrationCheck
    from canprobe.mechanics.touch.contact import ContactSample, Doubt, Slope, contact_sample, indentation_from_force
    from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
    from canprobe.mechanics.touch.estimate.estimator import Estimator
    from canprobe.mechanics.touch.estimate.fit import fit_surface, make_estimator
    from canprobe.mechanics.touch.estimate.likelihood import cramer_rao
    from canprobe.mechanics.touch.estimate.matrix import UncertainMatrix
    from canprobe.mechanics.touch.estimate.noise import Correlation
    from canprobe.mechanics.touch.estimate.prior import Prior
    from canprobe.mechanics.touch.image.calibration import ArrayCalibration
    from canprobe.mechanics.touch.image.force_reading import ForceReading
    from canprobe.mechanics.touch.image.image_model import ImageModel, make_image_model, make_patch_calibration
    from canprobe.mechanics.touch.image.moments import MomentImage
    from canprobe.mechanics.touch.image.patch import Patch, PatchCalibration, compute_patch
    from canprobe.mechanics.touch.map.fit import fit_map
    from canprobe.mechanics.touch.map.local_fits import PadLayer
    from canprobe.mechanics.touch.map.noise import PAD_NOISE, MapNoise
    from canprobe.mechanics.touch.map.surface_map import SurfaceMap
    from canprobe.mechanics.touch.meshing import Mesh
    from canprobe.mechanics.touch.objects import make_object
    from canprobe.mechanics.touch.online.estimator import OnlineEstimator
    from canprobe.mechanics.touch.online.map_fusion import MapFusion
    from canprobe.mechanics.touch.online.noise_level import NoiseLevel
    from canprobe.mechanics.touch.online.patch_curvature import PatchCurvature
    from canprobe.mechanics.touch.online.patch_fusion import PatchFusion
    from canprobe.mechanics.touch.online.systematic_errors import SystematicErrors
    from canprobe.mechanics.touch.pad import Pad
    from canprobe.mechanics.touch.servo import TactileServo
    from canprobe.mechanics.touch.strategies import Circle, Straight, Strategy, Weave
    from canprobe.mechanics.touch.surface import SurfaceMatrix

__getattr__, __dir__, _ = door(
    __name__,
    {
        "touch.array_calibration.calibrate": ("calibrate_array",),
        "touch.array_calibration.calibration_check": ("CalibrationCheck",),
        "touch.contact": ("ContactSample", "Doubt", "Slope", "contact_sample", "indentation_from_force"),
        "touch.estimate.answer": ("SurfaceEstimate",),
        "touch.estimate.fit": ("fit_surface", "make_estimator"),
        "touch.estimate.estimator": ("Estimator",),
        "touch.estimate.likelihood": ("cramer_rao",),
        "touch.estimate.matrix": ("UncertainMatrix",),
        "touch.estimate.noise": ("Correlation",),
        "touch.estimate.prior": ("Prior",),
        "touch.image.calibration": ("ArrayCalibration",),
        "touch.image.force_reading": ("ForceReading",),
        "touch.image.image_model": ("ImageModel", "make_image_model", "make_patch_calibration"),
        "touch.image.moments": ("MomentImage",),
        "touch.image.patch": ("Patch", "PatchCalibration", "compute_patch"),
        "touch.map.fit": ("fit_map",),
        "touch.map.local_fits": ("PadLayer",),
        "touch.map.noise": ("MapNoise", "PAD_NOISE"),
        "touch.map.surface_map": ("SurfaceMap",),
        "touch.meshing": ("Mesh",),
        "touch.objects": ("make_object",),
        "touch.online.estimator": ("OnlineEstimator",),
        "touch.online.map_fusion": ("MapFusion",),
        "touch.online.noise_level": ("NoiseLevel",),
        "touch.online.patch_curvature": ("PatchCurvature",),
        "touch.online.patch_fusion": ("PatchFusion",),
        "touch.online.systematic_errors": ("SystematicErrors",),
        "touch.pad": ("Pad",),
        "touch.servo": ("TactileServo",),
        "touch.strategies": ("Circle", "Straight", "Strategy", "Weave"),
        "touch.surface": ("SurfaceMatrix",),
    },
)
__all__ = ["ContactSample", "Doubt", "Pad", "Slope", "contact_sample", "indentation_from_force"]
__all__ += ["Circle", "Straight", "Strategy", "TactileServo", "UncertainMatrix", "Weave"]
__all__ += ["ForceReading", "ImageModel", "MomentImage", "Patch", "PatchCalibration", "compute_patch"]
__all__ += ["ArrayCalibration", "CalibrationCheck", "calibrate_array", "make_image_model", "make_patch_calibration"]
__all__ += ["Correlation", "Estimator", "Prior", "SurfaceEstimate", "cramer_rao", "fit_surface", "make_estimator"]
__all__ += ["MapFusion", "NoiseLevel", "OnlineEstimator", "PatchCurvature", "PatchFusion", "SystematicErrors"]
__all__ += ["PAD_NOISE", "MapNoise", "Mesh", "PadLayer", "SurfaceMap", "SurfaceMatrix", "fit_map", "make_object"]
