"""Calibration files of tactile arrays: TOML ↔ `ArrayCalibration`, with units in the names of the keys.

`canprobe calibrate array` writes them; the key `sensor.calibration` names one. As in `canprobe.cell.scene.model`, a
field says everything about its key.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from canprobe.cell.scene.checks import OneOf, Range, annotations_of, values_of
from canprobe.cell.scene.load import find_file
from canprobe.cell.scene.reader import Reader
from canprobe.cell.scene.toml_files import read_toml, toml_value, with_writer, written_by_line
from canprobe.cell.scene.units import in_si, in_units
from canprobe.mechanics.touch import ArrayCalibration
from canprobe.mechanics.touch.image.calibration import (
    CentroidDelays,
    ContactNoise,
    ForceReference,
    ImageParameters,
    Lag,
    MomentErrors,
    Residuals,
    StiffnessSources,
)
from canprobe.mechanics.touch.image.force_errors import UNSTATED, ForceErrors

SCHEMA = 1
Share = Annotated[float, Range(0, 1)]
Percent = Annotated[float, Range(0, 1000)]
Stiffness = Annotated[float, Range(1e5, 1e12)]
ASSUMED_NOISE = (25e-6, 0.8e-3, 12e-6)
"""`slow`, `slow_way` and `height` of `ContactNoise`, m, where an earlier form of the file does not state them."""
MAX_LATENCY_SIGMA_S = 1e3
"""Largest standard deviation of the latency that a file states, s: a calibration may know nothing of it."""


@dataclass(frozen=True, slots=True)
class About:
    """`[calibration]`: about the file."""

    schema: Annotated[int, OneOf((SCHEMA,))]
    """Version of the file's form."""
    array: str
    """Name of the array, or of its make."""
    date: str
    """Date of the touches."""
    made_on: str
    """Cell and objects of the touches."""
    force_reference: ForceReference
    """What newtons rest on: `scale`, `weights`, `unit` (the stated full scale), or `none`: nominal newtons."""
    full_scale_kpa: Annotated[float, Range(10, 1000)]
    """`sensor.full_scale_kpa` of the touches."""
    force_sigma_percent: Percent | None = None
    """Standard deviation of the reference. Left out with `none`."""
    serial_number: Annotated[int, Range(1, 0xFFFFFFFF)] | str | None = None
    """Serial number (1018h:04) of the array, or its name. Left out: the file is for a make, or nobody named it."""
    verified: str | None = None
    """Date of the last `canprobe calibrate array --verify` for which it held."""


@dataclass(frozen=True, slots=True)
class ImageKeys:
    """`[image]`: the parameters of the image model."""

    stiffness_n_m3: Stiffness
    """K/h of the layer, from the moments of the images."""
    scale: Annotated[float, Range(0.01, 100)]
    """Pressure that is shown over the true one."""
    blur_mm: Annotated[float, Range(0.01, 50)]
    """Standard deviation of the blur by cover and taxel."""
    crosstalk: Annotated[float, Range(-0.5, 0.5)]
    """Share of a signal that spreads over its row, and again over its column."""
    memory: Annotated[float, Range(-1, 1)]
    """Share of the pad's memory of earlier places in the moments."""


@dataclass(frozen=True, slots=True)
class MomentKeys:
    """`[moments]`: errors of second moments, relative."""

    sigma_percent: Percent
    """Error along an axis of the patch that no averaging removes."""
    both: Annotated[float, Range(-1, 1)]
    """Correlation of the errors along the two axes."""
    shear_percent: Percent
    """Error of the mixed moment."""
    frame_percent: Percent
    """Error that changes from one image to the next."""


@dataclass(frozen=True, slots=True)
class CentroidKeys:
    """`[centroid]`: errors of the place of a contact, and the delays of the centroid."""

    sigma_um: Annotated[float, Range(0, 100_000)]
    """Error of the centroid from image to image: `sigma_um · t^power`, t the level over the peak pressure."""
    power: Annotated[float, Range(-10, 10)]
    """Exponent of t."""
    correlation_mm: Annotated[float, Range(0, 1000, open_low=True)]
    """Way over the pad along which the slow error of the centroid is alike."""
    latency_ms: Annotated[float, Range(-1000, 1000)]
    """Time by which images are older than their time stamps."""
    latency_sigma_ms: Annotated[float, Range(0, 1e6)]
    """Standard deviation of `latency_ms`."""
    lag_um: Annotated[float, Range(0, 100_000)]
    """Largest distance by which the centroid trails the contact."""
    lag_way_um: Annotated[float, Range(0, 1e9, open_low=True)]
    """Way after which the centroid trails by half of that."""
    slow_um: Annotated[float, Range(0, 100_000)] | None = None
    """Error of the centroid that changes only as the contact moves over the pad."""
    height_um: Annotated[float, Range(0, 100_000, open_low=True)] | None = None
    """Error of the place of a contact along the normal."""
    correlated: Share | None = None
    """Of files without `slow_um`; not used."""


@dataclass(frozen=True, slots=True)
class StiffnessKeys:
    """`[stiffness]`: K/h of the layer from both sources. Their difference is the compliance of the arm."""

    moments_sigma_percent: Percent
    """Standard deviation of `image.stiffness_n_m3`."""
    depth_n_m3: Stiffness | None = None
    """Stiffness from the way of the arm into the object."""
    depth_sigma_percent: Percent | None = None
    """Its standard deviation."""
    arm_compliance_um_n: float | None = None
    """Compliance of what carries the probe."""
    arm_compliance_sigma_um_n: float | None = None
    """Its standard deviation."""


@dataclass(frozen=True, slots=True)
class ResidualKeys:
    """`[residuals]`: RMS errors of touches that the fit has not seen; of curvatures relative to (K + 1/R)."""

    touches: Annotated[int, Range(0, 1000)]
    """Number of touches of plane and ball."""
    moments_percent: Percent
    """Error of second moments."""
    curvature_percent: Percent
    """Error of curvatures from one touch."""
    force_percent: Percent | None = None
    """Error of reference forces."""
    rod_curvature_percent: Percent | None = None
    """Error of the curvature of the rod, which no fit has used."""


@dataclass(frozen=True, slots=True)
class ForceKeys:
    """`[force]`: errors of the force, relative. A file without this section gets stated ones, with a warning."""

    array_percent: Percent
    """Error by gains, hysteresis and threshold, from touches that the fit has not seen."""
    creep_percent: Percent
    """Growth of the reading under a constant load per decade of time, which is corrected."""
    creep_sigma_percent: Percent
    """Standard deviation of `creep_percent`."""
    creep_decades: Annotated[float, Range(0, 10)]
    """Decades of creep in the touches that newtons rest on."""
    spread_percent: Percent = 0.0
    """Error from one array of a make to the next. 0 in the file of a single array."""
    highest_n: Annotated[float, Range(0.01, 1000)] | None = None
    """Largest force of the touches. Left out: it is not known, and errors do not grow beyond it."""


@dataclass(frozen=True, slots=True)
class TaxelKeys:
    """`[taxels]`: taxels of a single array. The file of a make has no such section."""

    dead: tuple[tuple[int, int], ...] = ()
    """Row and column of taxels that read nothing."""
    gains: tuple[tuple[float, ...], ...] = ()
    """Gain of each taxel over the mean, row by row."""


@dataclass(frozen=True, slots=True)
class CalibrationFile:
    """The sections of a calibration file."""

    calibration: About
    image: ImageKeys
    moments: MomentKeys
    centroid: CentroidKeys
    stiffness: StiffnessKeys
    residuals: ResidualKeys
    taxels: TaxelKeys
    force: ForceKeys | None = None


def load_calibration(name_or_path: str | Path) -> ArrayCalibration:
    """Read a calibration.

    Args:
        name_or_path: a packaged calibration's name, such as `inch16`, or the path of a TOML file.

    Raises:
        SceneError: the file has problems; the error has all of them.
    """
    path, file = find_file(str(name_or_path), "calibration")
    document, file = with_writer(read_toml(path, file), file)
    reader = Reader(path.parent)
    needed = [field.name for field in dataclasses.fields(CalibrationFile) if field.default is dataclasses.MISSING]
    found = CalibrationFile(**reader.read(CalibrationFile, document, needed))
    if not reader.problems:
        rows = found.taxels.gains
        if rows and (len({len(row) for row in rows}) > 1 or min(map(min, rows)) <= 0.0):
            reader.complain("taxels.gains", "expected rows of one length with gains above 0")
        if (found.calibration.force_reference == "none") != (found.calibration.force_sigma_percent is None):
            reader.complain("calibration.force_sigma_percent", 'expected with any force_reference but "none"')
    reader.refuse(file)
    return _calibration(found)


def _calibration(file: CalibrationFile) -> ArrayCalibration:
    """The calibration of a file in SI units."""
    about, image, residuals = in_si(file.calibration), in_si(file.image), in_si(file.residuals)
    moments, centroid, stiffness = in_si(file.moments), in_si(file.centroid), in_si(file.stiffness)
    variance, k = moments["sigma"] ** 2, image["stiffness"]
    assumed = not {"slow", "height"} <= set(centroid)
    slow_way_height: tuple[float, float, float] = (
        ASSUMED_NOISE if assumed else (centroid["slow"], centroid["correlation"], centroid["height"])
    )
    del about["schema"]
    return ArrayCalibration(
        **{"force_sigma": math.nan, **about, **in_si(file.taxels)},
        image=ImageParameters(**image),
        moments=MomentErrors(variance, moments["both"] * variance, moments["shear"] ** 2, moments["frame"]),
        noise=ContactNoise(centroid["sigma"], centroid["power"], *slow_way_height, assumed=assumed),
        centroid=CentroidDelays(
            centroid["latency"], centroid["latency_sigma"], Lag(centroid["lag"], centroid["lag_way"])
        ),
        stiffness=StiffnessSources(
            k,
            k * stiffness["moments_sigma"],
            depth := stiffness.get("depth", math.nan),
            depth * stiffness.get("depth_sigma", math.nan),
            stiffness.get("arm_compliance", math.nan),
            stiffness.get("arm_compliance_sigma", math.nan),
        ),
        residuals=Residuals(**{"force": math.nan, "rod_curvature": math.nan, **residuals}),
        force=UNSTATED if file.force is None else ForceErrors(**in_si(file.force)),
    )


def dump_calibration(calibration: ArrayCalibration) -> str:
    """The calibration as a TOML document; `load_calibration` reads it back, to the digits that it shows."""
    c, whole = calibration, dataclasses.asdict(calibration)
    moments, centroid, stiffness = c.moments, c.centroid, c.stiffness
    quantities: dict[str, Mapping[str, Any]] = {
        **whole,
        "calibration": {"schema": SCHEMA, **whole},
        "moments": {
            "sigma": math.sqrt(moments.moment),
            "both": moments.both / moments.moment,
            "shear": math.sqrt(moments.shear),
            "frame": moments.frame_sigma,
        },
        "centroid": {
            "sigma": c.noise.scale,
            "power": c.noise.power,
            "correlation": c.noise.slow_way,
            "latency": centroid.latency_s,
            "latency_sigma": min(centroid.latency_sigma_s, MAX_LATENCY_SIGMA_S),
            "lag": centroid.lag.most,
            "lag_way": centroid.lag.reach,
            "slow": c.noise.slow,
            "height": c.noise.height,
        },
        "stiffness": {
            **whole["stiffness"],
            "moments_sigma": stiffness.moments_sigma / stiffness.moments,
            "depth_sigma": stiffness.depth_sigma / stiffness.depth,
        },
        "taxels": whole,
    }
    sections = []
    for name, hint in annotations_of(CalibrationFile).items():
        section = in_units(next(iter(typing.get_args(hint)), hint), quantities[name])
        lines = [f"{key} = {_value(value)}" for key, value in values_of(section).items() if value != ()]
        if lines:
            sections.append("\n".join([f"[{name}]", *lines]) + "\n")
    newtons = "# Forces and stiffness are in nominal newtons: there was no force reference.\n" if c.nominal else ""
    head = written_by_line()
    return f"# Made by `canprobe calibrate array`; see docs/calibration.md.\n{newtons}{head}\n" + "\n".join(sections)


def _value(value: object) -> str:
    if isinstance(value, tuple) and len(value) > 4 and isinstance(value[0], tuple):
        return "[\n" + "".join(f"    {toml_value(row)},\n" for row in value) + "]"
    return toml_value(value)
