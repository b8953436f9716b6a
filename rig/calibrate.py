"""Calibration recordings to the lines of the bench file: load cell, compliance, zero of the pressure sensor.

The line is fitted to the raw volts, not to what the present calibration makes of them: a wrong record in the bench file
does not spoil the new one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from rig.errors import FileError
from rig.measured import began, is_emulated
from rig.recording import Recording
from rig.scene import ComplianceSection, DeadWeightsSection
from rig.validation import Section
from sequences.calibration import WEIGH, weighing_order

if TYPE_CHECKING:
    from analysis.figures.fit_picture import FitPicture
    from analysis.numerics import Array

SectionType = TypeVar("SectionType", bound=Section)


@dataclass(frozen=True)
class Calibration:
    """What a calibration recording gives.

    Attributes
    ----------
    rows
        Name and value in words.
    toml
        Lines for the bench file.
    picture
        The fit.
    numbers
        The same as ``rows`` for programs; SI units in the names.
    """

    rows: tuple[tuple[str, str], ...]
    toml: str
    picture: FitPicture
    numbers: Mapping[str, float]

    def __str__(self) -> str:
        table = "\n".join(f"{name:<34}{value}" for name, value in self.rows)
        return f"{table}\n\nfor the bench file:\n\n{self.toml}"


def calibrate(recording: Recording) -> Calibration | None:
    """Return what a calibration recording gives, or ``None`` for any other protocol.

    Raises
    ------
    FileError
        The recording does not hold enough for a fit.
    """
    function = PROTOCOLS.get(recording.scene.protocol.name)
    return None if function is None else function(recording)


def dead_weights(recording: Recording) -> Calibration:
    """Fit force against volts: F = slope * reading + intercept, a hung mass pulling with -m g."""
    from analysis.calibration import calibrate_load_cell
    from analysis.numerics import RECTANGULAR

    protocol = _section(recording, DeadWeightsSection)
    masses, readings = _weighed(recording, protocol)
    if len(np.unique(masses)) < 3:
        raise _too_short(recording, f"{len(np.unique(masses))} different masses were weighed; at least 3 are needed")
    tolerance = protocol.mass_tolerance_percent * 1e-2 / RECTANGULAR
    gravity = protocol.gravity_m_s2
    fit = calibrate_load_cell(-masses, readings, mass_uncertainty=tolerance, gravity=gravity)
    force = recording.bench.force
    unit = "mV/V" if force.readout == "bridge" else "V"
    sign = math.copysign(1.0, fit.slope)
    day = began(recording).date()
    present = force.calibration
    toml = f"""\
[force]                            # replace this key
compression_positive = {str(fit.slope > 0).lower()}

[force.calibration]                # replace the whole table; check what is marked
id = {_quoted(f"{force.cell}-{day}")}
certificate = {_quoted(recording.path.name)}
date = {day}
operator = {_quoted(present.operator)}  # check: who hung the weights
serial = {_quoted(present.serial)}  # check: on the load cell
slope = {abs(fit.slope):.8g}  # N per {unit}
intercept = {sign * fit.intercept:.6g}  # N at 0 {unit}
relative_uncertainty = {fit.relative_uncertainty:.3g}  # standard, from fit and masses
residual = {fit.residual:.3g}  # N, standard deviation about the line
temperature_C = {present.temperature_C}  # check: of the room
"""
    loads = -masses * gravity
    line = fit.slope * readings + fit.intercept
    off = abs(fit.slope) / present.slope - 1
    return Calibration(
        rows=(
            (f"slope (N per {unit})", f"{fit.slope:.6g} ± {fit.relative_uncertainty * abs(fit.slope):.2g}"),
            (f"intercept (N at 0 {unit})", f"{fit.intercept:+.5f}"),
            ("residual (mN)", f"{fit.residual * 1e3:.3f}"),
            ("against the present bench file", f"{off * 100:+.3f} % in slope"),
            ("weighings", f"{len(masses)}, {masses.min() * 1e3:g} to {masses.max() * 1e3:g} g, up and down"),
        ),
        toml=toml,
        picture=_picture(
            recording,
            f"{fit.slope:.6g} N per {unit}",
            (readings, loads, line),
            (f"Reading [{unit}]", "Force of the weights [N]", "Residual [mN]"),
            1e3,
        ),
        numbers={
            f"slope_N_per_{unit.replace('/', '_')}": fit.slope,
            "slope_relative_uncertainty": fit.relative_uncertainty,
            "intercept_N": fit.intercept,
            "residual_N": fit.residual,
            "slope_against_bench_file": off,
            "weighings": len(masses),
        },
    )


def _weighed(recording: Recording, protocol: DeadWeightsSection) -> tuple[Array, Array]:
    """Return mass (kg) and mean reading of every weighing that came to its end."""
    steps = [step for step in recording.step_table() if step.name.startswith(WEIGH) and step.outcome == "done"]
    order = weighing_order([mass * 1e-3 for mass in protocol.masses_g])
    reading = recording.volts[recording.channels.index("force")]
    means = [reading[step.start : step.stop].mean() for step in steps]
    return np.array(order[: len(means)]), np.array(means)


def compliance(recording: Recording) -> Calibration:
    """Fit travel against force while the rigid stop is loaded, and while it is unloaded."""
    from analysis.calibration import calibrate_compliance
    from analysis.numerics import Noise, block_means

    protocol = _section(recording, ComplianceSection)
    steps = {step.name: step for step in recording.step_table() if step.outcome == "done"}
    if not {"tare", "preload", "unload"} <= steps.keys():
        raise _too_short(recording, "the recording does not reach the end of the unloading")
    force = _tared(recording, steps["tare"].start, steps["tare"].stop)
    fits, parts = [], []
    for name, seconds in (("preload", 0.002), ("unload", 0.02)):
        length = max(1, round(seconds * recording.rate))
        window = slice(steps[name].start, steps[name].stop)
        load, height = block_means(force[window], length), block_means(recording.height[window], length)
        inside = (load > 0.15 * protocol.preload_N) & (load < protocol.preload_N)
        if inside.sum() < 20:
            raise _too_short(recording, f"only {inside.sum()} points of the {name} lie in contact")
        load, height = load[inside], height[inside]
        line = np.polynomial.Polynomial.fit(load, height, 1)(load)
        noise = Noise.measure(np.asarray(height - line), max(1, load.size // 12))
        fits.append(calibrate_compliance(load, height, noise))
        parts.append((load, height))
    down, up = fits
    mean = (down.compliance + up.compliance) / 2
    hysteresis = abs(down.compliance - up.compliance) / 2
    gain = recording.bench.force.calibration.relative_uncertainty * mean
    uncertainty = math.hypot(max(down.uncertainty, up.uncertainty), hysteresis, gain)
    load, height = parts[1]
    way = -(height - height.max())
    line = up.compliance * (load - load.mean()) + way.mean()
    present = recording.bench.force.compliance_um_per_N
    return Calibration(
        rows=(
            ("compliance (um/N)", f"{mean * 1e6:.3f} ± {uncertainty * 1e6:.3f}"),
            ("  while loading (um/N)", f"{down.compliance * 1e6:.3f} ± {down.uncertainty * 1e6:.3f}"),
            ("  while unloading (um/N)", f"{up.compliance * 1e6:.3f} ± {up.uncertainty * 1e6:.3f}"),
            ("departure from the line (um)", f"{max(down.nonlinearity, up.nonlinearity) * 1e6:.3f}"),
            ("in the present bench file (um/N)", f"{present:g}"),
        ),
        toml=f"""\
[force]                            # replace these two keys
compliance_um_per_N = {mean * 1e6:.4g}
compliance_uncertainty_um_per_N = {uncertainty * 1e6:.2g}
""",
        picture=_picture(
            recording,
            f"{up.compliance * 1e6:.2f} µm/N; with loading {mean * 1e6:.2f} ± {uncertainty * 1e6:.2f}",
            (load, way * 1e6, line * 1e6),
            ("Force [N]", "Travel while unloading [µm]", "Residual [µm]"),
            1.0,
        ),
        numbers={
            "compliance_m_per_N": mean,
            "compliance_uncertainty_m_per_N": uncertainty,
            "compliance_loading_m_per_N": down.compliance,
            "compliance_unloading_m_per_N": up.compliance,
            "nonlinearity_m": max(down.nonlinearity, up.nonlinearity),
        },
    )


def _tared(recording: Recording, start: int, stop: int) -> Array:
    """Return the force less a straight line from the tare to the last second, when the stop is clear again."""
    length = round(recording.rate)
    places = np.array([(start + stop) / 2, recording.force.size - length / 2])
    levels = np.array([recording.force[start:stop].mean(), recording.force[-length:].mean()])
    slope = (levels[1] - levels[0]) / (places[1] - places[0])
    return np.asarray(recording.force - levels[0] - slope * (np.arange(recording.force.size) - places[0]))


def pressure_zero(recording: Recording) -> Calibration:
    """Average the data sheet's reading with the port open: what the bench file corrects already is taken back."""
    from analysis.calibration import pressure_zero as average
    from analysis.numerics import running_mean
    from drivers.pressure import TOTAL_ERROR_BAND

    step = next((s for s in recording.step_table() if s.name == "zero" and s.outcome == "done"), None)
    if step is None or recording.pressure is None or recording.bench.pressure is None:
        raise _too_short(recording, "the recording does not hold the whole rest at zero pressure")
    zero, line = recording.bench.pressure.zero, recording.bench.pressure.calibration
    present = 0.0 if zero is None else zero.offset_Pa
    slope, intercept = (1.0, 0.0) if line is None else (line.slope, line.intercept)
    pressure = (recording.pressure[step.start : step.stop] - intercept) / slope + present
    offset, uncertainty = average(pressure, recording.rate)
    if abs(offset) > TOTAL_ERROR_BAND:
        raise FileError(
            f"{recording.path}: the sensor reads {offset:+.0f} Pa open to the room; the zero may be off by "
            f"{TOTAL_ERROR_BAND:g} Pa at most. Remedy: check that the port is open, then the sensor and its wiring."
        )
    noise, samples = float(pressure.std(ddof=1)), pressure.size
    time = np.arange(samples) / recording.rate
    shown = running_mean(pressure, max(1, round(0.02 * recording.rate)))
    return Calibration(
        rows=(
            ("reading at zero pressure (Pa)", f"{offset:+.2f} ± {uncertainty:.2f}"),
            ("noise of one sample (Pa)", f"{noise:.2f}"),
            ("against the present bench file", f"{offset - present:+.2f} Pa"),
        ),
        toml=f"""\
[pressure.zero]                    # replace the whole table
offset_Pa = {offset:.3f}
noise_Pa = {noise:.3f}
samples = {samples}
time = {began(recording).replace(microsecond=0).isoformat()}
""",
        picture=_picture(
            recording,
            f"{offset:+.2f} ± {uncertainty:.2f} Pa",
            (time, shown, np.full(samples, offset)),
            ("Time [s]", "Reading, port open [Pa]", "Residual [Pa]"),
            1.0,
            joined=True,
        ),
        numbers={
            "offset_Pa": offset,
            "offset_uncertainty_Pa": uncertainty,
            "noise_Pa": noise,
            "samples": samples,
        },
    )


PROTOCOLS: dict[str, Callable[[Recording], Calibration]] = {
    "dead_weights": dead_weights,
    "compliance": compliance,
    "pressure_zero": pressure_zero,
}


def _picture(
    recording: Recording,
    result: str,
    data: tuple[Array, Array, Array],
    labels: tuple[str, str, str],
    scale: float,
    *,
    joined: bool = False,
) -> FitPicture:
    from analysis.figures.fit_picture import FitPicture

    return FitPicture(
        recording.scene.title,
        result,
        *data,
        *labels,
        residual_scale=scale,
        joined=joined,
        emulated=is_emulated(recording),
    )


def _quoted(text: str) -> str:
    """Return a text as it is written in a TOML file."""
    import tomlkit

    return tomlkit.item(text).as_string()


def _section(recording: Recording, kind: type[SectionType]) -> SectionType:
    protocol = recording.scene.protocol
    if not isinstance(protocol, kind):
        raise TypeError(f"{recording.path} is a recording of {protocol.name}")
    return protocol


def _too_short(recording: Recording, what: str) -> FileError:
    return FileError(f"{recording.path}: {what}. Remedy: run the calibration again to its end.")
