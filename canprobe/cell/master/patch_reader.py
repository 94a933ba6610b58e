"""The patch that each image of the array shows, in every mode of it, with its columns of the log."""

from __future__ import annotations

import numpy as np

from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.mechanics.touch import ForceReading, Patch, PatchCalibration, compute_patch
from canprobe.mechanics.touch.image.patch import patch_from_features
from canprobe.mechanics.touch.image.silent_taxels import SilentTaxels
from canprobe.mechanics.types import Floats


def sample_columns(sample: TactileSample, patch: Patch) -> dict[str, float | Floats]:
    """Columns of the log with an image's force, standard deviation and the parts of that by their causes, and place."""
    return {
        "sample_cycle": float(sample.cycle),
        "force_n": patch.force,
        "force_sigma_n": patch.sigma.total,
        "force_sigma_parts_n": np.array(patch.sigma),
        "pad_u_mm": patch.u * 1e3,
        "pad_v_mm": patch.v * 1e3,
    }


class PatchReader:
    """The patch of each tactile sample, in every mode of the array, with a force and its standard deviation.

    Taxels that do not measure are bridged, and creep is corrected.

    Args:
        calibration: calibration of the array.

    Attributes:
        taxels: finds the taxels that do not measure; None for a list of taxels, which have no neighbours.
        image: (rows, columns) counts that the last patch was taken of.
    """

    def __init__(self, calibration: PatchCalibration) -> None:
        pad = calibration.pad
        self._calibration = calibration
        self._force = ForceReading(calibration)
        self.image = np.zeros(pad.shape, np.uint8)
        self._last: tuple[TactileSample, Patch] | None = None
        self.taxels: SilentTaxels | None = None
        if pad.is_grid:
            self.taxels = SilentTaxels(pad.shape, calibration.dead, blur_pitch=calibration.blur_m / pad.pitch_m)

    def read(self, sample: TactileSample) -> Patch:
        """The patch of a sample, computed once; samples come in the order of their times."""
        if self._last is None or self._last[0] is not sample:
            self._last = sample, self._read(sample)
        return self._last[1]

    def _read(self, sample: TactileSample) -> Patch:
        frame, t_s = sample.frame, sample.t_sample_ns * 1e-9
        if frame.features is not None:  # moments do not show which taxels they are made of
            return self._force.step(t_s, patch_from_features(frame.features, self._calibration))
        self.image, bridged, share = frame.taxels, 0, 0.0
        if self.taxels is not None:
            self.taxels.look(frame.taxels, frame.window, sample.t_sample_ns)
            self.image, bridged, share = self.taxels.bridged(frame.taxels, frame.window)
        patch = compute_patch(self.image, self._calibration, window=frame.window)
        if bridged:
            patch = patch._replace(dead=patch.dead + bridged, bridged=share)
        return self._force.step(t_s, patch)

    def widen(self, spread: float) -> None:
        """State forces with this relative standard deviation from now on: the calibration is another array's."""
        self._force.widen(spread)

    @property
    def found(self) -> int:
        """Number of taxels that were found not to measure."""
        return self.taxels.found if self.taxels is not None else 0

    @property
    def faults(self) -> str:
        """Taxels that do not measure, in words; empty where none was found."""
        return self.taxels.words if self.taxels is not None else ""
