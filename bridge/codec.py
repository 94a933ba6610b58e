"""One observation ↔ bytes, for the way into a bridge's process: 3 µs where pickle takes 35.

Only what a sample is made of is carried. Both ends are the same program, so that `marshal` will do.
"""

from __future__ import annotations

import marshal
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canprobe.bus.port import TimedFrame
from canprobe.cell.measurement import Measurement, TactileSample
from canprobe.cell.observe import Observation
from canprobe.protocol.tactile import Features, TactileFrame, TactileHeader

if TYPE_CHECKING:
    from canprobe.touch.estimate import SurfaceEstimate

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class EstimateParts:
    """What a bridge needs of a surface estimate; see `SurfaceEstimate`."""

    T_frame_contact: Array
    K: Array
    covariance: Array
    observed: tuple[bool, bool]


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """An observation at the other end.

    Attributes:
        t_ns, measurement, frames: as in `Observation`.
        phase: column `phase` of the command, None without one.
        depth: column `depth_at_1n_mm`: indentation at 1 N with which its contact was placed, None without one.
        estimate: of the command.
        dropped: observations that were lost before this one.
    """

    t_ns: int
    measurement: Measurement | None
    phase: float | None
    depth: float | None
    estimate: EstimateParts | None
    frames: list[TimedFrame]
    dropped: int


def pack_observation(observation: Observation, dropped: int = 0) -> bytes:
    """One observation as bytes.

    Args:
        observation: as the cell hands it out.
        dropped: how many were lost before it.
    """
    command = observation.command
    phase: float | None = None
    depth: float | None = None
    estimate = None
    if command is not None:
        phase = _number(command.columns.get("phase"))
        depth = _number(command.columns.get("depth_at_1n_mm"))
        if command.estimate is not None:
            estimate = _pack_estimate(command.estimate)
    measurement = observation.measurement
    parts: Any = _pack_measurement(measurement) if measurement is not None else None
    return marshal.dumps((observation.t_ns, parts, phase, depth, estimate, observation.frames, dropped))


def _number(value: object) -> float | None:
    """A plain float of whatever a controller has put there; None where it is no number."""
    return float(value) if isinstance(value, int | float | np.number) else None


def unpack_observation(data: bytes) -> Received:
    """The inverse of `pack_observation`."""
    t_ns, parts, phase, depth, estimate, frames, dropped = marshal.loads(data)
    return Received(
        t_ns,
        _unpack_measurement(parts) if parts is not None else None,
        phase,
        depth,
        _unpack_estimate(estimate) if estimate is not None else None,
        frames,
        dropped,
    )


def _pack_measurement(m: Measurement) -> tuple[object, ...]:
    q = m.q.tobytes() if m.q is not None else None
    tactile = _pack_tactile(m.tactile) if m.tactile is not None else None
    return m.cycle, m.t_ns, q, m.q_age, m.torque_permille, m.statuswords, m.enabled, tactile, m.tactile_age


def _unpack_measurement(parts: tuple[object, ...]) -> Measurement:
    cycle, t_ns, q, age, torque, words, enabled, tactile, tactile_age = parts
    return Measurement(
        cycle,  # type: ignore[arg-type]
        t_ns,  # type: ignore[arg-type]
        np.frombuffer(q) if q is not None else None,  # type: ignore[call-overload]
        age,  # type: ignore[arg-type]
        torque,  # type: ignore[arg-type]
        words,  # type: ignore[arg-type]
        bool(enabled),
        _unpack_tactile(tactile) if tactile is not None else None,  # type: ignore[arg-type]
        tactile_age,  # type: ignore[arg-type]
    )


def _pack_tactile(sample: TactileSample) -> tuple[object, ...]:
    frame = sample.frame
    features = frame.features
    return (
        sample.t_sample_ns,
        sample.cycle,
        frame.header.pack(),
        frame.taxels.tobytes(),
        frame.window,
        (features.pack(), features.peak) if features is not None else None,
        frame.t_ns,
    )


def _unpack_tactile(parts: tuple[int, int, bytes, bytes, tuple[int, int, int, int], tuple[bytes, int], int]) -> object:
    t_sample_ns, cycle, header, taxels, window, features, t_ns = parts
    image = np.frombuffer(taxels, np.uint8).reshape(16, 16)
    found = Features.unpack(*features) if features is not None else None
    return TactileSample(TactileFrame(TactileHeader.unpack(header), image, window, found, t_ns), t_sample_ns, cycle)


def _pack_estimate(estimate: SurfaceEstimate) -> tuple[bytes, bytes, bytes, bool, bool]:
    first, second = estimate.observed
    T, K, covariance = (
        np.ascontiguousarray(a, np.float64).tobytes()
        for a in (estimate.T_frame_contact, estimate.K, estimate.covariance)
    )
    return T, K, covariance, bool(first), bool(second)


def _unpack_estimate(parts: tuple[bytes, bytes, bytes, bool, bool]) -> EstimateParts:
    T, K, covariance, first, second = parts
    return EstimateParts(
        np.frombuffer(T).reshape(4, 4),
        np.frombuffer(K).reshape(2, 2),
        np.frombuffer(covariance).reshape(3, 3),
        (first, second),
    )
