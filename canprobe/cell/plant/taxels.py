"""The tactile array: from pressure on the pad to the counts that the sensor node sends.

Pipeline of one image (after ``PressureField``): gain per taxel, soft saturation, hysteresis, creep, crosstalk, noise,
ADC, threshold, dead taxels. Every effect has a number in ``TaxelConfig``; 0 switches it off.

Source: figures after FSR data sheets and Sensors 2014, 14, 12816; the forms are stated at each step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from math import ceil, exp
from typing import Any

import numpy as np
import numpy.typing as npt

from canprobe.cell.plant.pressure import Directions, PressureField
from canprobe.mechanics.touch.pad import COUNTS_MAX, Pad
from canprobe.mechanics.types import Floats

Image = npt.NDArray[np.uint8] | Floats

_CREEP_TIMES_S = (0.3, 3.0, 30.0, 300.0)
_SATURATION_KNEE = 1.25
MAX_SAMPLE_DISTANCE_M = 1e-3
"""Distance of the samples of a pressure field: a first touch of 0.1 N on a probe of 10 mm is 3 mm wide, and of a mat
with taxels 30 mm apart three samples a taxel would miss it."""
_NOISE_IMAGES = 8
"""Number of images whose noise is drawn at once."""
_ONE = np.array(1.0)  # a number that is an array already costs a ufunc less


@dataclass(frozen=True, slots=True)
class TaxelConfig:
    """The imperfections of one array.

    Args:
        full_scale_pa: pressure of the largest count.
        blur_pitch: standard deviation of the cover's blur in taxel pitches.
        gain_error: half-width of the uniform spread of taxel gains, fixed for the life of the array.
        saturation: whether the response bends off: ``x (1 + (x / 1.25)^4)^(-1/4)``, x in full scales.
        hysteresis: width of the loop relative to the signal.
        creep_per_decade: growth of the reading under constant load per decade of time, from 0.1 s to 180 s.
        crosstalk: share of a taxel's signal that spreads evenly over its row, and again over its column.
        noise: standard deviation per sample, in full scales.
        threshold: readings below this share of full scale become 0.
        dead: (row, column) of taxels that read 0.
        adc_bits: bits of the ADC; 8 gives whole counts, more give parts of counts.
        samples: samples of the pressure field per taxel and axis; more where they would lie more than
            `MAX_SAMPLE_DISTANCE_M` apart.
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
        """Reading of the ADC at full scale."""
        return (1 << self.adc_bits) - 1

    def without(self, *effects: str) -> TaxelConfig:
        """The same array with some effects switched off.

        Args:
            *effects: of "noise", "gain_error", "blur", "hysteresis", "creep", "crosstalk", "saturation", "threshold".

        Raises:
            ValueError: there is no such effect.
        """
        fields = {"blur": "blur_pitch", "creep": "creep_per_decade"}
        known = ("noise", "gain_error", "blur", "hysteresis", "creep", "crosstalk", "saturation", "threshold")
        unknown = [e for e in effects if e not in known]
        if unknown:
            raise ValueError(f"unknown effects {', '.join(unknown)}; one of {', '.join(known)}")
        off: dict[str, float] = {fields.get(e, e): False if e == "saturation" else 0.0 for e in effects}
        return replace(self, **off)  # type: ignore[arg-type]


IDEAL_TAXELS = TaxelConfig().without("noise", "gain_error", "blur", "hysteresis", "creep", "crosstalk", "saturation")
"""An array without imperfections: averaging, ADC and threshold only."""


class TaxelArray:
    """One array with its memory (hysteresis, creep) and its fixed gains.

    Args:
        config: the imperfections.
        rng: source of gains and noise.
        radius_m: radius of the sphere it is wrapped on.
        stiffness_n_m3: stiffness of the elastic layer.
        pad: its taxels; None: 16×16 over one inch.
    """

    def __init__(
        self,
        config: TaxelConfig,
        rng: np.random.Generator,
        *,
        radius_m: float = 0.040,
        stiffness_n_m3: float = 1.27e8,
        pad: Pad | None = None,
    ) -> None:
        self.config = config
        self.pad = pad = pad or Pad()
        self._rng = rng
        samples = max(config.samples, ceil(pad.pitch_m / MAX_SAMPLE_DISTANCE_M))
        self.field = PressureField(radius_m, pad, blur_pitch=config.blur_pitch, samples=samples)
        self.gains = 1.0 + config.gain_error * rng.uniform(-1.0, 1.0, pad.shape)
        self._scale = self.gains * (stiffness_n_m3 / config.full_scale_pa)
        half = 0.5 * config.hysteresis
        self._edges = np.array([[[1.0 + half]], [[1.0 - half]]])
        self._loop = np.zeros(pad.shape)
        # Rows: the relaxations, and the image that drives them; and where the next ones are put.
        self._creep, self._next = np.zeros((2, len(_CREEP_TIMES_S) + 1, pad.taxels))
        self._relaxed = lru_cache(maxsize=64)(partial(_relaxations, config.creep_per_decade))
        self._t_s: float | None = None
        self._columns = _leaks(pad.columns, config.crosstalk)
        self._rows = _leaks(pad.rows, config.crosstalk) * float(config.adc_max)
        self._noise: list[Floats] = []
        self._readings = _readings(config)
        self._has_dead = bool(config.dead)
        self._dead = tuple(np.array(config.dead, dtype=np.intp).reshape(-1, 2).T)

    def take_gains(self, other: TaxelArray) -> None:
        """Be the same array as another one of this configuration, with memories of its own."""
        self.gains, self._scale = other.gains, other._scale

    def image(
        self,
        uv: tuple[float, float],
        depth: float,
        kappa: tuple[float, float],
        directions_pad: Directions,
        t_s: float,
        *,
        pressure_factor: float = 1.0,
    ) -> Image:
        """Sample the array once; memory and noise move on with every call.

        Args:
            uv: contact point on the pad, m.
            depth: indentation, m; <= 0 is no contact.
            kappa: principal curvatures of the object, 1/m, larger first.
            directions_pad: directions of the contact on the pad.
            t_s: time of the sample, s, not before the previous one.
            pressure_factor: factor of the pressure by the layer's damping.

        Returns:
            (rows, columns) counts of 255 at full scale; whole numbers (uint8) of an ADC of 8 bits, else float.
        """
        return self.image_of(self.field.mean_pressure(uv, depth, kappa, directions_pad), t_s, pressure_factor)

    def image_of(self, compression: Floats, t_s: float, pressure_factor: float = 1.0) -> Image:
        """The rest of the pipeline: sample the array once under a known compression of the layer.

        Args:
            compression: (rows, columns) taxel means as ``PressureField`` gives them, m; used up.
            t_s: time of the sample, s, not before the previous one.
            pressure_factor: factor of the pressure by the layer's damping.

        Returns:
            (rows, columns) counts.
        """
        y = compression
        y *= self._scale
        if pressure_factor != 1.0:
            y *= pressure_factor
        y = self._remember(_saturate(y) if self.config.saturation else y, t_s)
        if self.config.crosstalk > 0.0:
            return self._convert(self._rows.dot(y).dot(self._columns))
        return self._convert(y * float(self.config.adc_max))

    def _remember(self, y: Floats, t_s: float) -> Floats:
        """Hysteresis, then creep."""
        if self.config.hysteresis > 0.0:
            # Play with proportional edges (generalised Prandtl-Ishlinskii): the output rests until the input has
            # crossed the loop; loading reads x (1 - h/2), unloading x (1 + h/2), whatever the rate.
            high, low = self._edges * y
            y = self._loop = np.maximum(np.minimum(self._loop, high, out=high), low, out=low)
        dt = 0.0 if self._t_s is None else t_s - self._t_s
        self._t_s = t_s
        if self.config.creep_per_decade > 0.0:
            self._creep[-1] = y.reshape(-1)
            self._creep, self._next = np.dot(self._relaxed(round(1e9 * dt)), self._creep, out=self._next), self._creep
            crept: Floats = self._creep[-1].reshape(self.pad.shape)
            return crept
        return y

    def _convert(self, counts: Floats) -> Image:
        """Apply noise, ADC, threshold and dead taxels."""
        if self.config.noise > 0.0:
            counts += self._drawn()
        else:
            counts += 0.5
        read = self._readings.take(counts.astype(np.intp), mode="clip")
        if self._has_dead:
            read[self._dead] = 0
        return read

    def _drawn(self) -> Floats:
        """(rows, columns) noise of one image in counts, and the half count that makes cutting off rounding."""
        if not self._noise:
            noise = self._rng.standard_normal((_NOISE_IMAGES, *self.pad.shape))
            noise *= self.config.noise * self.config.adc_max
            noise += 0.5
            self._noise = [*noise[::-1]]
        return self._noise.pop()


def _leaks(taxels: int, crosstalk: float) -> Floats:
    """(n, n) what becomes of the signals along a row or column: a share of each spreads over the others."""
    if taxels == 1:
        return np.ones((1, 1))
    others = (np.ones((taxels, taxels)) - np.eye(taxels)) / (taxels - 1)
    return (1.0 - crosstalk) * np.eye(taxels) + crosstalk * others


def _relaxations(growth: float, dt_ns: int) -> Floats:
    """(5, 5) what becomes of relaxations and image in a time: the relaxations then, and the crept image.

    Sum of relaxations a decade apart: a growth per decade for a step, linear, superposes under moving loads.
    """
    matrix = np.zeros((len(_CREEP_TIMES_S) + 1,) * 2)
    for i, tau in enumerate(_CREEP_TIMES_S):
        matrix[i, i] = exp(-1e-9 * dt_ns / tau)
        matrix[i, -1] = 1.0 - matrix[i, i]
    matrix[-1] = growth * matrix[:-1].sum(axis=0)
    matrix[-1, -1] += 1.0
    return matrix


def _readings(config: TaxelConfig) -> npt.NDArray[Any]:
    """Reading at each count of the ADC, in counts of 255 at full scale; 0 below the threshold."""
    counts = np.arange(config.adc_max + 1)
    counts[counts < np.ceil(config.threshold * config.adc_max)] = 0
    return counts.astype(np.uint8) if config.adc_max == COUNTS_MAX else counts * float(COUNTS_MAX) / config.adc_max


def _saturate(x: Floats) -> Floats:
    """Power-law knee, exponent 4: 0.2 % low at half of full scale, 8 % at full scale, then flat; in place."""
    fourth = x * (1.0 / _SATURATION_KNEE)
    np.square(fourth, out=fourth)
    np.square(fourth, out=fourth)
    fourth += _ONE
    np.sqrt(fourth, out=fourth)
    x /= np.sqrt(fourth, out=fourth)
    return x
