"""The tactile array: from pressure on the pad to the counts that the sensor node sends.

Pipeline of one image (after ``field``): gain per taxel, soft saturation, hysteresis, creep, crosstalk, noise, ADC,
threshold, dead taxels. Every effect has a number in ``TaxelConfig``; 0 switches it off.

Source: figures after FSR data sheets and Sensors 2014, 14, 12816; the forms are stated at each step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import exp
from typing import Any

import numpy as np
import numpy.typing as npt

from canprobe.emulator.plant.field import SIDE, PressureField

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8] | npt.NDArray[np.float64]

_CREEP_TIMES_S = (0.3, 3.0, 30.0, 300.0)
_SATURATION_KNEE = 1.25
_FULL_SCALE = 255
"""Counts of full scale, whatever the ADC resolves."""


@dataclass(frozen=True, slots=True)
class TaxelConfig:
    """The imperfections of one array.

    Args:
        full_scale_pa: pressure of the largest count.
        blur_pitch: standard deviation of the cover's blur in taxel pitches.
        gain_error: half-width of the uniform spread of taxel gains, fixed for the life of the array.
        saturation: whether the response bends off: ``x (1 + (x / 1.25)^4)^(-1/4)``, x in full scales.
        hysteresis: width of the loop relative to the signal.
        creep_per_decade: growth of the reading under constant load per decade of time, from 0.1 s to 1000 s.
        crosstalk: share of a taxel's signal that spreads evenly over its row, and again over its column.
        noise: standard deviation per sample, in full scales.
        threshold: readings below this share of full scale become 0.
        dead: (row, column) of taxels that read 0.
        adc_bits: of the ADC; 8 gives whole counts, more give parts of counts.
        samples: samples per taxel and axis of the pressure field.
    """

    full_scale_pa: float = 100e3
    blur_pitch: float = 0.65
    gain_error: float = 0.05
    saturation: bool = True
    hysteresis: float = 0.10
    creep_per_decade: float = 0.05
    crosstalk: float = 0.02
    noise: float = 0.005
    threshold: float = 0.02
    dead: tuple[tuple[int, int], ...] = ()
    adc_bits: int = 8
    samples: int = 3

    @property
    def adc_max(self) -> int:
        """What the ADC says at full scale."""
        return (1 << self.adc_bits) - 1

    @property
    def adc_threshold(self) -> int:
        """Least that the ADC says above the threshold."""
        return int(np.ceil(self.threshold * self.adc_max))

    def without(self, *effects: str) -> TaxelConfig:
        """The same array with some effects switched off.

        Args:
            *effects: of "noise", "gain_error", "blur", "hysteresis", "creep", "crosstalk", "saturation", "threshold".

        Raises:
            ValueError: for an effect that does not exist.
        """
        fields = {"blur": "blur_pitch", "creep": "creep_per_decade"}
        known = ("noise", "gain_error", "blur", "hysteresis", "creep", "crosstalk", "saturation", "threshold")
        unknown = [e for e in effects if e not in known]
        if unknown:
            raise ValueError(f"unknown effects {', '.join(unknown)}; one of {', '.join(known)}")
        off: dict[str, float] = {fields.get(e, e): False if e == "saturation" else 0.0 for e in effects}
        return replace(self, **off)  # type: ignore[arg-type]


IDEAL_TAXELS = TaxelConfig().without("noise", "gain_error", "blur", "hysteresis", "creep", "crosstalk", "saturation")
"""Only averaging, ADC and threshold."""


class TaxelArray:
    """One array with its memory (hysteresis, creep) and its fixed gains.

    Args:
        config: the imperfections.
        rng: source of gains and noise.
        radius_m: radius of the sphere it is wrapped on.
        stiffness_n_m3: of the elastic layer.
    """

    def __init__(
        self,
        config: TaxelConfig,
        rng: np.random.Generator,
        *,
        radius_m: float = 0.040,
        stiffness_n_m3: float = 1.27e8,
    ) -> None:
        self.config = config
        self._rng = rng
        self.field = PressureField(radius_m, blur_pitch=config.blur_pitch, samples=config.samples)
        self.gains = 1.0 + config.gain_error * rng.uniform(-1.0, 1.0, (SIDE, SIDE))
        self._scale = self.gains * (stiffness_n_m3 / config.full_scale_pa)
        self._loop = np.zeros((SIDE, SIDE))
        self._creep = np.zeros((len(_CREEP_TIMES_S), SIDE * SIDE))
        self._decay: dict[int, Array] = {}
        self._t_s: float | None = None
        others = (np.ones((SIDE, SIDE)) - np.eye(SIDE)) / (SIDE - 1)
        self._mix = (1.0 - config.crosstalk) * np.eye(SIDE) + config.crosstalk * others
        self._has_dead = bool(config.dead)
        self._dead = tuple(np.array(config.dead, dtype=np.intp).reshape(-1, 2).T)

    def image(
        self,
        uv: tuple[float, float],
        depth: float,
        kappa: tuple[float, float],
        directions_pad: Array,
        t_s: float,
        *,
        pressure_factor: float = 1.0,
    ) -> Image:
        """Sample the array once; memory and noise move on with every call.

        Args:
            uv: contact point on the pad, m.
            depth: indentation, m; <= 0 is no contact.
            kappa: principal curvatures of the object, 1/m, larger first.
            directions_pad: (2, 2) rows: principal directions in the basis ``pad_basis`` of the contact direction.
            t_s: time of the sample, s, not before the previous one.
            pressure_factor: of the layer's damping.

        Returns:
            (16, 16) counts of 255 at full scale, row i at v = (i - 7.5) pitch, column j at u = (j - 7.5) pitch; whole
            numbers (uint8) of an ADC of 8 bits, else float.
        """
        return self.image_of(self.field.mean_pressure(uv, depth, kappa, directions_pad), t_s, pressure_factor)

    def image_of(self, compression: Array, t_s: float, pressure_factor: float = 1.0) -> Image:
        """The rest of the pipeline: sample the array once under a known compression of the layer.

        Args:
            compression: (16, 16) taxel means as ``PressureField`` gives them, m; used up.
            t_s: time of the sample, s, not before the previous one.
            pressure_factor: of the layer's damping.

        Returns:
            (16, 16) counts.
        """
        y = compression
        y *= self._scale
        if pressure_factor != 1.0:
            y *= pressure_factor
        y = self._remember(_saturate(y) if self.config.saturation else y, t_s)
        if self.config.crosstalk > 0.0:
            y = self._mix.dot(y).dot(self._mix)
        return self._convert(y)

    def _remember(self, y: Array, t_s: float) -> Array:
        """Hysteresis, then creep."""
        half = 0.5 * self.config.hysteresis
        if half > 0.0:
            # Play with proportional edges (generalised Prandtl-Ishlinskii): the output rests until the input has
            # crossed the loop; loading reads x (1 - h/2), unloading x (1 + h/2), whatever the rate.
            loop = np.minimum(self._loop, (1.0 + half) * y)
            y = np.maximum(loop, (1.0 - half) * y)
            self._loop = y
        dt = 0.0 if self._t_s is None else t_s - self._t_s
        self._t_s = t_s
        if self.config.creep_per_decade > 0.0:
            # Sum of relaxations a decade apart: c per decade for a step, linear, superposes under moving loads.
            creep, flat = self._creep, y.reshape(-1)
            creep -= flat
            creep *= self._decay_of(dt)
            creep += flat
            crept: Array = np.add.reduce(creep).reshape(SIDE, SIDE)
            crept *= self.config.creep_per_decade
            crept += y
            return crept
        return y

    def _decay_of(self, dt: float) -> Array:
        dt_ns = round(1e9 * dt)
        decay = self._decay.get(dt_ns)
        if decay is None:
            if len(self._decay) > 64:
                self._decay.clear()
            decay = self._decay[dt_ns] = np.array([[exp(-1e-9 * dt_ns / tau)] for tau in _CREEP_TIMES_S])
        return decay

    def _convert(self, y: Array) -> Image:
        """Noise, ADC, threshold, dead taxels."""
        top = self.config.adc_max
        counts = y * top
        if self.config.noise > 0.0:
            noise = self._rng.standard_normal((SIDE, SIDE))
            noise *= self.config.noise * top
            counts += noise
        counts += 0.5  # the conversion below cuts off
        np.maximum(counts, 0.0, out=counts)
        np.minimum(counts, top + 0.5, out=counts)
        read: npt.NDArray[Any] = counts.astype(np.uint8 if top == _FULL_SCALE else np.uint16)
        read *= read >= self.config.adc_threshold
        if self._has_dead:
            read[self._dead] = 0
        return read if top == _FULL_SCALE else read * float(_FULL_SCALE) / top


def _saturate(x: Array) -> Array:
    """Power-law knee, exponent 4: 0.2 % low at half of full scale, 8 % at full scale, then flat; in place."""
    fourth = x * (1.0 / _SATURATION_KNEE)
    fourth *= fourth
    fourth *= fourth
    fourth += 1.0
    np.sqrt(fourth, out=fourth)
    x /= np.sqrt(fourth, out=fourth)
    return x
