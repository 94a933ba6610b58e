"""The probe's ball in space: carried by the arm, or pressed on the object without one; and directions on its pad."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin

import numpy as np

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.elastic_contact import depth_for_force
from canprobe.cell.plant.pressure import Directions, Vec, pad_basis
from canprobe.mechanics.touch.shapes import Nearest

Axes = tuple[Vec, Vec, Vec]


@dataclass(slots=True, eq=False)
class ProbeState:
    """Probe sphere now: centre, axes (columns x, y, z = pole) and velocity of the centre, base frame."""

    centre: Vec
    axes: Axes
    velocity: Vec


PRESS_GAP = 1e-3
"""Distance of the probe from the object before the press begins, m."""


class PressedProbe:
    """Probe without an arm, pole against the object's normal at its origin.

    Args:
        config: configuration of a plant with an object.
    """

    def __init__(self, config: PlantConfig) -> None:
        assert config.object is not None
        pose = config.object.T_base_object
        x, n = pose[:3, 0], pose[:3, 2]
        self._origin, self._normal = pose[:3, 3], n
        self._axes = (tuple(x.tolist()), tuple(np.cross(-n, x).tolist()), tuple((-n).tolist()))
        c = config.object.closest(self._origin)
        self._mean = depth_for_force(
            config.press.force_n, (float(c.kappa[0]), float(c.kappa[1])), config.radius_m, config.stiffness_n_m3
        )
        self._radius, self._press = config.radius_m, config.press

    def at(self, t_s: float, first_s: float | None) -> ProbeState:
        """State of the probe at a time.

        Args:
            t_s: time, s.
            first_s: time of the first image, s; None before it.
        """
        waits = self._press.after_s
        if waits and (first_s is None or t_s < first_s + waits):
            centre = self._origin + (self._radius + PRESS_GAP) * self._normal
            return ProbeState(tuple(centre.tolist()), self._axes, (0.0, 0.0, 0.0))
        rate = 2 * pi * self._press.frequency_hz
        depth = self._mean * (1.0 + self._press.swing * sin(rate * t_s))
        speed = -self._mean * self._press.swing * rate * cos(rate * t_s)
        centre, velocity = self._origin + (self._radius - depth) * self._normal, speed * self._normal
        return ProbeState(tuple(centre.tolist()), self._axes, tuple(velocity.tolist()))


def in_pad(foot: Nearest, probe: ProbeState, d: Vec) -> Directions:
    """Principal directions in the transported pad basis at the contact direction.

    Args:
        foot: nearest point of the object to the probe's centre.
        probe: probe that carries the pad.
        d: direction of the contact from the probe's centre, pad frame.
    """
    u, v = (_along(probe.axes, e) for e in pad_basis(d))
    first, second = foot.directions
    return (_dot(first, u), _dot(first, v)), (_dot(second, u), _dot(second, v))


def _along(axes: Axes, e: Vec) -> Vec:
    """A vector of the probe's frame in the base frame."""
    (x0, x1, x2), (y0, y1, y2), (z0, z1, z2) = axes
    a, b, c = e
    return a * x0 + b * y0 + c * z0, a * x1 + b * y1 + c * z1, a * x2 + b * y2 + c * z2


def _dot(a: Vec, b: Vec) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
