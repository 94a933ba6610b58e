"""The neutral sample of a cell in SI units, which every bridge gets, and the interface of a bridge's module.

A sample belongs to one cycle and holds what was new in it; a part without news is None. It knows neither tools nor
message types. Times are in nanoseconds. z of the contact frame is the inward normal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.model import BridgeSettings
from canprobe.fieldbus.bus.port import TimedFrame
from canprobe.mechanics.types import Floats

BASE, FLANGE, PROBE, CONTACT, CARRIER = "base_link", "flange", "probe", "contact", "carrier"
"""Names of frames. An object on a carrier has its contacts, answers and surface in the frame of the carrier, and "base"
means that of them then. Between base and flange stand link_1, link_2, …, the frame that each joint moves."""


@dataclass(frozen=True, slots=True, eq=False)
class ContactFrame:
    """The place where the probe touches.

    Attributes:
        T_base_contact: contact frame to base (4, 4), m: origin at the contact point, z along the inward normal.
    """

    T_base_contact: Floats

    @property
    def point(self) -> Floats:
        """Contact point (3,), base frame, m."""
        return self.T_base_contact[:3, 3]

    @property
    def normal(self) -> Floats:
        """Outward unit normal of the object (3,), base frame."""
        return -self.T_base_contact[:3, 2]


@dataclass(frozen=True, slots=True, eq=False)
class TouchFrame:
    """One frame of the tactile array.

    Attributes:
        t_ns: time of sampling, on the clock of the samples.
        counts: image (rows, columns), uint8, row by row; zero outside the window; None in features mode.
        force: force (3,), N, of the object on the probe, in the probe's centre frame. The array measures pressure
            only: the force runs along the contact normal, without a torque about the sphere's centre.
        contact: place of the contact; None without contact, or without an arm.
    """

    t_ns: int
    counts: NDArray[np.uint8] | None
    force: Floats
    contact: ContactFrame | None


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePatch:
    """A new answer of the estimator in the loop: the surface round the contact, z = ½ (x, y) K (x, y)ᵀ.

    Attributes:
        t_ns: time of the cycle that received it.
        T_base_contact: contact frame of the estimate to base (4, 4), m; z is the inward normal.
        K: curvature in that frame (2, 2), 1/m, positive where convex.
        covariance: covariance of (K11, K12, K22) (3, 3), 1/m²; not finite where not observed.
        observed: whether each principal curvature is observed (κ1 ≥ κ2).
    """

    t_ns: int
    T_base_contact: Floats
    K: Floats
    covariance: Floats
    observed: tuple[bool, bool]

    @property
    def kappa(self) -> tuple[float, float]:
        """Principal curvatures κ1 ≥ κ2, 1/m; NaN where not observed."""
        if not np.isfinite(self.K).all():
            return (np.nan, np.nan)
        low, high = np.linalg.eigvalsh(self.K).tolist()
        return (high if self.observed[0] else np.nan, low if self.observed[1] else np.nan)

    def heights(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """The surface over points of its tangent plane.

        Args:
            x, y: coordinates in the contact frame, any shape, m.

        Returns:
            Depth z, positive inwards, and its standard deviation, each of that shape, m. Where the curvature is not
            known the surface is taken as flat, with an infinite deviation away from the contact.
        """
        weights = np.stack([0.5 * x * x, x * y, 0.5 * y * y], axis=-1)
        K = self.K if np.isfinite(self.K).all() else np.zeros((2, 2))
        z: Floats = weights @ np.array([K[0, 0], K[0, 1], K[1, 1]])
        if np.isfinite(self.covariance).all():
            variance = np.einsum("...i,ij,...j->...", weights, self.covariance, weights)
            return z, np.sqrt(np.maximum(variance, 0.0))
        return z, np.where(weights.any(axis=-1), np.inf, 0.0)

    def grid(self, radius: float = 8e-3, n: int = 17) -> tuple[Floats, Floats]:
        """A disc of points of the patch.

        Args:
            radius: radius of the disc, m.
            n: points along a diameter.

        Returns:
            Points (m, 3) in the base frame, and the standard deviation of each along the normal (m,), m.
        """
        line = np.linspace(-radius, radius, n)
        x, y = (axis.ravel() for axis in np.meshgrid(line, line))
        inside = x * x + y * y <= radius * radius * (1 + 1e-9)
        x, y = x[inside], y[inside]
        z, sigma = self.heights(x, y)
        points = np.stack([x, y, z], axis=1) @ self.T_base_contact[:3, :3].T + self.T_base_contact[:3, 3]
        return points, sigma


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """The state of a node, or of the cell.

    Attributes:
        name: its name, such as `node 3 (joint 3)`.
        level: 0 OK, 1 warning, 2 error, 3 stale: no heartbeat.
        message: text of one line.
        values: (name, value) pairs as text, units in the name.
    """

    name: str
    level: int
    message: str
    values: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """New data of one cycle.

    Attributes:
        t_ns: time of its SYNC since the bus was opened, as in `bus.log`.
        cycle: number of the cycle; None before the first and after the last.
        phase: phase of the task in lower case (`approach`, `scan`, …); None where the controller gives none.
        q: joint positions (n,) at the SYNC, rad or m; None without an arm, or before all joints have reported.
        touch: a tactile frame that became usable in this cycle.
        patch: a new answer of the estimator.
        ahead: path ahead of an exploration (n, 3), base frame, m; None in other tasks.
        frames: frames on the bus since the sample before, with `EFF_FLAG` and `RTR_FLAG` on identifiers.
        diagnostics: states of all nodes and of the bridge, about once a second.
        dropped: number of samples that this bridge has lost so far.
        T_base_carrier: frame (4, 4) of the object's carrier in base, m; None without one or its report.
    """

    t_ns: int
    cycle: int | None = None
    phase: str | None = None
    q: Floats | None = None
    touch: TouchFrame | None = None
    patch: SurfacePatch | None = None
    ahead: Floats | None = None
    frames: Sequence[TimedFrame] = ()
    diagnostics: tuple[Diagnostic, ...] = ()
    dropped: int = 0
    T_base_carrier: Floats | None = None


@dataclass(frozen=True, slots=True)
class Context:
    """Plan and settings that a sink gets at its start.

    Attributes:
        plan: plan of the run.
        settings: settings of section `[bridge]`.
        out: folder of the run; None where no files are written.
        send: hands a request (see `canprobe.cell.tasks.requested.RequestedTask`) back to the cell.
    """

    plan: Plan
    settings: BridgeSettings
    out: Path | None
    send: Callable[[dict[str, object]], None]


class Sink(Protocol):
    """One tool at the other end. Its module has `open_sink(context) -> Sink`."""

    @property
    def where(self) -> str:
        """Place of the output, for people: a file, an address."""

    def start(self, epoch_ns: int) -> None:
        """Take the epoch: time 0 of the samples is `epoch_ns` after the Unix epoch, or 0 in virtual time."""

    def write(self, sample: Sample) -> None:
        """Take one sample."""

    def close(self, summary: str | None) -> None:
        """End the output at the end of the run.

        Args:
            summary: content of `summary.json`; None where the cell ended without one.
        """
