"""Emulated arrays that are drawn at random, and the touches that calibrate one, directly and without a bus.

An array is touched as `canprobe calibrate array` touches it, but for the touches with the probe turned. The images come
from `cell.plant.taxels`, whose pressure is that of the exact sphere, sampled nine times a taxel, with hysteresis, creep
and noise; a calibration knows none of its formulas.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from canprobe.cell.emulated.array import follow
from canprobe.cell.plant.elastic_contact import depth_for_force
from canprobe.cell.plant.taxels import TaxelArray, TaxelConfig
from canprobe.cell.session.array_calibration import visits
from canprobe.cell.tasks.calibrate import Press
from canprobe.mechanics.touch.array_calibration.calibrate import ArrayFit, calibrate_array
from canprobe.mechanics.touch.array_calibration.touches import Dwell
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.types import Floats

RADIUS_M = 0.040
BALL_PER_M = 40.0
WINDOW = 8
FRAME_S, LOADING_S, APART_S = 0.02, 0.5, 2.5
HOLD_S = (8.0, 20.0, 60.0)
"""Durations of a hold, s."""
REFERENCE_SIGMA = 0.005
FORCE_RELATIVE_SIGMA, FORCE_CORRELATION_S = 0.03, 0.1
"""The force wanders under a servo: relative standard deviation, and correlation time."""
ENCODER_M = 3e-6


def pad_of(config: TaxelConfig) -> Pad:
    """The pad of an array."""
    return Pad(full_scale_pa=config.full_scale_pa, mount_radius_m=RADIUS_M)


def calibrated(presses: Presses, name: str, *, own_gains: bool = True) -> ArrayFit:
    """The fit that the touches of an array give.

    Args:
        presses: presses on the array.
        name: name of the array.
        own_gains: whether the calibration has gains of its taxels, or is one of a make.
    """
    return calibrate_array(
        list(presses.protocol()), pad=pad_of(presses.config), reference="scale", reference_sigma=REFERENCE_SIGMA,
        array=name, date="", made_on="study calibration", own_gains=own_gains,
    )  # fmt: skip


def random_array(seed: int) -> tuple[TaxelConfig, float, np.random.Generator]:
    """A random array, the stiffness of its layer (N/m³), and the generator of its gains and noise."""
    rng = np.random.default_rng(seed)
    stiffness = 1.27e8 * math.exp(rng.uniform(-0.5, 0.5))
    config = TaxelConfig(
        full_scale_pa=math.exp(rng.uniform(math.log(90e3), math.log(300e3))),
        blur_pitch=rng.uniform(0.45, 0.85),
        crosstalk=rng.uniform(0.0, 0.05),
        hysteresis=rng.uniform(0.05, 0.15),
        creep_per_decade=rng.uniform(0.02, 0.08),
    )
    return config, stiffness, rng


class Presses:
    """Presses known shapes on one array, one after the other: it remembers, until it is left to `rest`.

    Args:
        config, stiffness: the array, and the stiffness of its layer, N/m³.
        rng: generator of gains and noise.

    Attributes:
        config, stiffness: the array, and the stiffness of its layer, N/m³.
        forces: (n,) true force at each image of the last touch, N.
    """

    def __init__(self, config: TaxelConfig, stiffness: float, rng: np.random.Generator) -> None:
        self.config, self.stiffness, self._rng = config, stiffness, rng
        self.forces: Floats = np.empty(0)
        self._array, self._t = self._new_array(), 0.0

    def _new_array(self) -> TaxelArray:
        return TaxelArray(self.config, self._rng, radius_m=RADIUS_M, stiffness_n_m3=self.stiffness)

    def dwell(
        self,
        name: str,
        kappa: tuple[float, float],
        press: Press,
        place: int = 0,
        angle: float = 0.0,
        *,
        measured: bool = False,
    ) -> Dwell:
        """One touch, pressed for half a second and rolled over the pad.

        Args:
            name: name of the object.
            kappa: principal curvatures, larger first, 1/m.
            press: force, place on the pad, and roll.
            place: number of the place.
            angle: angle of the first principal direction on the pad, rad.
            measured: whether the true force is given, with the error of a scale.
        """
        array, began = self._array, self._t
        rng, force = self._rng, press.force
        depth = depth_for_force(force, kappa, RADIUS_M, self.stiffness)
        c, s = math.cos(angle), math.sin(angle)
        axes, origin = np.array([[c, s], [-s, c]]), (4, 4)
        unrest = 0.0
        kept = math.exp(-FRAME_S / FORCE_CORRELATION_S)
        rows = []
        for t in np.arange(0.0, LOADING_S + press.seconds, FRAME_S).tolist():
            unrest = kept * unrest + FORCE_RELATIVE_SIGMA * math.sqrt(1.0 - kept**2) * float(rng.standard_normal())
            u, v = press.way(max(0.0, t - LOADING_S))
            uv = (press.at[0] + u, press.at[1] + v)
            now = force * min(1.0, t / LOADING_S) * max(1.0 + unrest, 0.0)
            sunk = depth * math.sqrt(now / force)
            image = array.image(uv, sunk, kappa, axes, began + t)
            origin = follow(image, origin)
            seen = np.zeros_like(image)
            part = np.s_[origin[0] : origin[0] + WINDOW, origin[1] : origin[1] + WINDOW]
            seen[part] = image[part]
            rows.append((t, seen, (*origin, WINDOW, WINDOW), uv, sunk + rng.normal(0.0, ENCODER_M), now))
        t_s, images, windows, places, push, forces = zip(*rows, strict=True)
        self._t = began + t_s[-1]
        for _ in range(round(APART_S / FRAME_S)):
            self._t += FRAME_S
            array.image((0.0, 0.0), 0.0, kappa, axes, self._t)
        mean, self.forces = float(np.mean(forces[len(forces) // 3 :])), np.array(forces)
        return Dwell(
            name=name,
            kappa=kappa,
            angle=angle,
            place=place,
            t_s=np.array(t_s),
            images=images,
            windows=windows,
            expected=np.array(places),
            push=np.array(push),
            force=mean * (1.0 + float(rng.normal(0.0, REFERENCE_SIGMA))) if measured else None,
            to_and_fro=len(press.hz) > 1,
        )

    def rest(self) -> None:
        """Wait until the array has recovered from the presses before."""
        array = self._new_array()
        array.take_gains(self._array)
        self._array, self._t = array, 0.0

    def protocol(self) -> Iterator[Dwell]:
        """The touches of `canprobe calibrate array`, with a rest where it changes the object."""
        places: dict[object, int] = {}
        for visit in visits(1.0 / BALL_PER_M, 1.0 / BALL_PER_M, loads=True, one_by_one=False):
            if visit.turned:
                continue
            if places:
                self.rest()
            known = visit.known
            kappa = (1.0 / known.radius, 0.0 if known.name == "rod" else 1.0 / known.radius)
            for press in visit.presses:
                heading = known.angle + 0.5 * math.pi if math.isnan(press.heading) else press.heading
                place = (known.name, visit.first, press.at, heading if press.hz[1:] else None)
                number = places.setdefault(place, len(places))
                rolled = replace(press, heading=heading)
                yield self.dwell(known.name, kappa, rolled, number, known.angle, measured=visit.load)

    def by_chance(self) -> Dwell:
        """A random quadric, force, place and time; the true force is given exactly."""
        self.rest()
        rng = self._rng
        k1, k2 = sorted(rng.uniform(-12.0, 60.0, 2).tolist(), reverse=True)
        x, y = rng.uniform(-2e-3, 2e-3, 2).tolist()
        angle, heading = rng.uniform(0.0, math.pi), rng.uniform(0.0, 2.0 * math.pi)
        hz, seconds = (float(rng.choice((0.35, 1.0))),), float(rng.uniform(3.0, 8.0))
        press = Press(float(rng.uniform(0.7, 3.0)), (x, y), heading=heading, hz=hz, seconds=seconds)
        return replace(self.dwell("quadric", (k1, k2), press, angle=angle), force=press.force)

    def held(self) -> tuple[Dwell, Floats]:
        """A random quadric, held for some time, and its true forces (n,), N."""
        self.rest()
        rng = self._rng
        k1, k2 = sorted(rng.uniform(-12.0, 60.0, 2).tolist(), reverse=True)
        x, y = rng.uniform(-1.5e-3, 1.5e-3, 2).tolist()
        half, force, angle = rng.uniform((0.0, 0.5, 0.0), (1.5e-3, 3.0, math.pi)).tolist()
        seconds, heading = float(rng.choice(HOLD_S)), float(rng.uniform(0.0, 2.0 * math.pi))
        press = Press(force, (x, y), (half, 0.4 * half), heading, (float(rng.uniform(0.05, 0.5)),), seconds)
        return self.dwell("quadric", (k1, k2), press, angle=angle), self.forces
