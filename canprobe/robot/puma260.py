"""The PUMA 260 as numbers: link geometry, joint ranges, speeds, motor counts and wrist coupling.

Two published geometries are shipped. They disagree by millimetres, which makes their difference a realistic
calibration error. Joint zero positions and ranges follow the UPenn convention in both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_INCH = 0.0254
_ALPHA = (math.pi / 2, 0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, 0.0)

GEAR_RATIOS = (46.72, 69.9733, 42.9867, 43.5111, 39.3846, 31.7692)
ENCODER_COUNTS_PER_TURN = (1000, 1000, 1000, 800, 800, 800)
COUPLING_J4_J5 = -9.8462
COUPLING_J4_J6 = 1.0
COUPLING_J5_J6 = -5.6


@dataclass(frozen=True, slots=True, eq=False)
class PumaModel:
    """Geometry and drive numbers of one arm; compared by identity.

    Args:
        name: key in ``MODELS``.
        dh: (6, 3) standard Denavit-Hartenberg rows: a in m, alpha in rad, d in m. Closed forms need the PUMA
            pattern: alpha (+90, 0, -90, +90, -90, 0) degrees, a non-zero in rows 2 and 3 only, d5 = 0.
        q_min: (6,) lower joint limits, rad.
        q_max: (6,) upper joint limits, rad.
        qd_max: (6,) joint speed limits, rad/s.
        counts: (6, 6) motor encoder counts per radian of each joint; wrist motors are coupled.

    Raises:
        ValueError: for a geometry outside the PUMA pattern.
    """

    name: str
    dh: Array
    q_min: Array
    q_max: Array
    qd_max: Array
    counts: Array
    joints_per_count: Array = field(init=False)
    links: tuple[float, float, float, float, float, float] = field(init=False)
    """d1, a2, d2 + d3, a3, d4, d6 in m: all that the closed forms need (d2 and d3 lie on parallel axes)."""

    def __post_init__(self) -> None:
        a, alpha, d = np.asarray(self.dh, dtype=float).T
        if np.any(np.abs(alpha - _ALPHA) > 1e-12) or np.any(a[[0, 3, 4, 5]] != 0.0) or d[4] != 0.0:
            raise ValueError(f"model {self.name!r}: DH rows do not follow the PUMA pattern: {self.dh!r}")
        links = (float(d[0]), float(a[1]), float(d[1] + d[2]), float(a[2]), float(d[3]), float(d[5]))
        object.__setattr__(self, "links", links)
        object.__setattr__(self, "joints_per_count", np.linalg.inv(self.counts))
        for name in ("dh", "q_min", "q_max", "qd_max", "counts", "joints_per_count"):
            array = np.array(getattr(self, name), dtype=float)
            array.setflags(write=False)
            object.__setattr__(self, name, array)


def joints_to_counts(model: PumaModel, q: npt.ArrayLike) -> Array:
    """Motor positions of joint angles.

    Args:
        model: the arm.
        q: (6,) joint angles, rad (or rates, rad/s).

    Returns:
        (6,) motor positions in encoder counts, not rounded (or counts/s).
    """
    counts: Array = model.counts @ np.asarray(q, dtype=float)
    return counts


def counts_to_joints(model: PumaModel, counts: npt.ArrayLike) -> Array:
    """Joint angles of motor positions, the inverse of ``joints_to_counts``.

    Args:
        model: the arm.
        counts: (6,) motor positions in encoder counts.

    Returns:
        (6,) joint angles, rad.
    """
    q: Array = model.joints_per_count.dot(np.asarray(counts, dtype=float))
    return q


def coupling_matrix() -> Array:
    """Motor turns per joint turn, (6, 6).

    Turning joint 4 drags the motors of joints 5 and 6 along, joint 5 that of joint 6.

    Source: gear ratios and wrist coupling of the PUMA 200 series as used by YARP's Babybot driver.
    """
    turns = np.diag(GEAR_RATIOS)
    turns[4, 3], turns[5, 3], turns[5, 4] = COUPLING_J4_J5, COUPLING_J4_J6, COUPLING_J5_J6
    return turns


def _model(name: str, *, a2: float, a3: float, d2: float, d3: float, d6: float) -> PumaModel:
    d1, d4 = 13 * _INCH, 8 * _INCH
    a, d = (0.0, a2, a3, 0.0, 0.0, 0.0), (d1, d2, d3, d4, 0.0, d6)
    return PumaModel(
        name=name,
        dh=np.column_stack((a, _ALPHA, d)),
        q_min=np.radians((-180.0, -75.0, -235.0, -580.0, -30.0, -215.0)),
        q_max=np.radians((110.0, 240.0, 60.0, 40.0, 200.0, 295.0)),
        qd_max=np.radians((210.0, 210.0, 210.0, 675.0, 675.0, 1350.0)),
        counts=np.diag(ENCODER_COUNTS_PER_TURN) @ coupling_matrix() / (2 * math.pi),
    )


UPENN = _model("upenn", a2=8 * _INCH, a3=0.0, d2=-2.5 * _INCH, d3=-2.5 * _INCH, d6=2.5 * _INCH)
"""UPenn MEAM 520: upper arm 203.2 mm, no elbow offset, shoulder offset 127.0 mm, flange 63.5 mm."""

UNIMATE = _model("unimate", a2=7.8 * _INCH, a3=-0.75 * _INCH, d2=-4.9 * _INCH, d3=0.0, d6=2.2 * _INCH)
"""After the Unimate manual (RPI 260B, YARP Babybot): 198.1 mm, -19.05 mm elbow, 124.5 mm shoulder, 55.9 mm flange.

The elbow offset is taken as the DH length a3, at right angles to the forearm.
"""

MODELS: Mapping[str, PumaModel] = MappingProxyType({"upenn": UPENN, "unimate": UNIMATE})

ELBOW_FORM = np.radians((90.0, 65.0, 15.0, 0.0, 100.0, 0.0))
"""Well-conditioned pose with the flange pointing down at the scan region; the usual ``q_near``, rad."""
ELBOW_FORM.setflags(write=False)
