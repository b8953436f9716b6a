"""Uncertainty from calibration, noise, drift, contact point and sampling, carried to every number.

The whole extraction is repeated on perturbed copies of the run: once per systematic source (its effect is taken as
linear), and on ``DRAWS`` copies with fresh noise resampled from the force-free part of the record. Seeds are fixed:
re-running gives the same digits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from analysis.extraction import Extraction, extract
from analysis.numerics import RECTANGULAR, Array, Noise
from analysis.preparation import fit_baseline
from analysis.run import Run

DRAWS = 16
"""Copies with fresh noise."""

SEED = 20170516


WITHOUT_LOAD = frozenset({"force_noise_N", "force_drift_N_s", "baseline_residual_N"})
"""Features of the force at no load, where a calibration line is not out."""

MEASURED_SETTINGS = {
    "contact_area_mm2": ("contact area", 0.05),
    "projected_area_um2": ("contact area", 0.05),
    "real_area_um2": ("contact area", 0.05),
    "indenter_radius_mm": ("indenter radius", 0.0),
}
"""Settings that were measured: source in the budget, and relative standard uncertainty where none is stated beside
them. An area of 0.5 mm radius changes by 10 % where its edge moves by a quarter of the fibres' spacing of 100 um."""


def budget(work: Extraction) -> dict[str, dict[str, float]]:
    """Return, for each feature, its standard uncertainty by source."""
    parts: dict[str, dict[str, float]] = {name: {} for name in work.values}
    for source, changed in _systematic(work):
        for name, value in extract(changed, before=work).values.items():
            if name in parts and not (source == "force linearity" and name in WITHOUT_LOAD):
                _add(parts[name], source, value - work.values[name])
    for name, spread in _noise(work).items():
        if not name.endswith("_count"):
            _add(parts[name], "noise", spread)
    for name, sources in _sampling(work).items():
        _add(parts[name], "sampling", sources)
    for name, uncertainty in work.stated.items():
        _add(parts[name], "fit", uncertainty)
    if "contact_height_m" in parts:
        cell = float(np.ptp(np.asarray(work.details["contact"]["separation"])[:2]))
        _add(parts["contact_height_m"], "contact point", work.values["contact_spread_m"])
        _add(parts["contact_height_m"], "contact point", cell / (2 * RECTANGULAR))
    return parts


def _add(parts: dict[str, float], source: str, contribution: float) -> None:
    if np.isfinite(contribution) and contribution != 0:
        parts[source] = float(np.hypot(parts.get(source, 0.0), contribution))


def _systematic(work: Extraction) -> Iterator[tuple[str, Run]]:
    """Yield the run with each systematic source changed by one standard uncertainty."""
    run, sensors = work.run, work.run.sensors
    changes: list[tuple[str, float, Callable[[float], Run]]] = [
        ("force calibration", sensors.force_gain, lambda u: replace(run, force=run.force * (1 + u))),
        ("force linearity", sensors.force_linearity, lambda u: replace(run, force=_bent(work, u, np.minimum))),
        ("force linearity", sensors.force_linearity, lambda u: replace(run, force=_bent(work, u, np.maximum))),
        ("position", sensors.position, lambda u: replace(run, height=run.height * (1 + u))),
        (
            "compliance",
            sensors.compliance_uncertainty,
            lambda u: replace(run, sensors=replace(sensors, compliance=sensors.compliance + u)),
        ),
        ("drift", _drift_excess(work), lambda u: replace(run, force=run.force + _bump(work, u))),
        ("creep", 0.0 if work.creep is None else work.creep.uncertainty, lambda u: _crept(work, u)),
    ]
    pressure = run.pressure
    if pressure is not None:
        changes += [
            ("pressure calibration", sensors.pressure_gain, lambda u: replace(run, pressure=pressure * (1 + u))),
            ("pressure zero", sensors.pressure_offset, lambda u: replace(run, pressure=pressure + u)),
        ]
    pumped = run.pump_volume
    if pumped is not None:
        changes.append(("pump volume", sensors.pump_volume, lambda u: replace(run, pump_volume=pumped * (1 + u))))
    changes += _sample_changes(run)
    for source, uncertainty, change in changes:
        if uncertainty > 0:
            yield source, change(uncertainty)


def _sample_changes(run: Run) -> Iterator[tuple[str, float, Callable[[float], Run]]]:
    """What is known of the sample only to an uncertainty: areas, the radius of the indenter, that of the contact."""
    for key, (source, share) in MEASURED_SETTINGS.items():
        value = run.settings.get(key)
        if isinstance(value, int | float):
            name, _, unit = key.rpartition("_")
            stated = run.settings.get(f"{name}_uncertainty_{unit}", share * value)
            yield source, float(stated), partial(_with_setting, run, key, float(value))
    parameters = run.parameters
    stated = run.settings.get("effective_radius_uncertainty_mm", 0.0)
    if parameters is not None and run.protocol in ("pull_off", "punch"):
        gripper = parameters.gripper

        def smaller(uncertainty: float) -> Run:
            less = replace(gripper, effective_radius=gripper.effective_radius - uncertainty)
            return replace(run, parameters=replace(parameters, gripper=less))

        yield "effective radius", float(stated) * 1e-3, smaller


def _with_setting(run: Run, key: str, value: float, change: float) -> Run:
    return replace(run, settings={**run.settings, key: value + change})


def _bent(work: Extraction, uncertainty: float, side: Callable[[Array, float], Array]) -> Array:
    """A calibration out by ``uncertainty`` under tension (``np.minimum``) or compression (``np.maximum``).

    Weights hang on one side: what the line is out by there says nothing of the other. It is right at zero, and out by
    nine tenths at one per cent of the cell's capacity: the smallest weight of its calibration. Where no capacity is
    known the largest force stands for it.
    """
    scale = 0.007 * (work.run.sensors.force_capacity or max(float(np.abs(work.force).max()), 1e-12))
    return np.asarray(work.run.force + uncertainty * np.tanh(side(work.force, 0.0) / scale), dtype=np.float64)


def _drift_excess(work: Extraction) -> float:
    """How far the zero may have wandered from the fitted line while in contact, N.

    Waves about as long as the gap between the force-free parts are hidden best. Those that pass through the parts with
    the slopes v (rms, against the line) that a cubic finds there are as high as v / omega = v gap / 2 pi times the
    square root of two, and that is their rms departure from the line. The slopes' own noise, which every copy with
    noise of its own already shows, is taken off. A quarter of the drift from the first part to the last is added for
    what bends without showing at the ends.
    """
    windows = work.details["tare"]["windows"]
    assert isinstance(windows, list)
    if len(windows) < 2:
        return abs(float(work.baseline.deriv()(0.0))) * (work.windows.end - work.contact_start) / 2
    (first, left), (right, last) = windows
    slope = fit_baseline(work.force, windows, degree=3).deriv()
    slopes = slope(np.array([first + left, right + last]) / 2)
    noise = [_slope_noise(work.noise, length) for length in (left - first, last - right)]
    seen = np.sqrt(max(0.0, float(np.mean(slopes**2) - np.mean(np.square(noise)))))
    drift = float(work.baseline(right) - work.baseline(left))
    return float(np.hypot(seen * (right - left) / (np.sqrt(2) * np.pi), 0.25 * drift))


def _slope_noise(noise: Noise, length: int) -> float:
    """Standard deviation of the slope of a line fitted to so many samples, N per sample.

    The difference of the means of both halves has the variance 16 s^2 / n^3 for white noise s, the fit three quarters.
    """
    half = max(1, length // 2)
    return float(np.sqrt(0.75 * 2) * noise.of_mean(half) / half)


def _bump(work: Extraction, height: float) -> Array:
    """A wander of the zero between the force-free parts, none within them."""
    start = work.contact_start
    stop = work.detached if work.detached is not None else work.windows.end
    bump = np.zeros(work.run.force.size)
    bump[start:stop] = height
    return bump


def _crept(work: Extraction, share: float) -> Run:
    """Return the run with another share of creep, calibrated or put back while in contact."""
    run, sensors = work.run, work.run.sensors
    if sensors.creep_time > 0:
        return replace(run, sensors=replace(sensors, creep=sensors.creep + share))
    assert work.creep is not None
    return replace(run, force=run.force + _bump(work, share) * work.creep.response)


def _noise(work: Extraction) -> Mapping[str, float]:
    generator = np.random.default_rng(SEED)
    run = work.run
    pressure_noise = _pressure_noise(work)
    samples: dict[str, list[float]] = {name: [] for name in work.values}
    for _ in range(DRAWS):
        changed = replace(run, force=run.force + work.noise.draw(run.force.size, generator))
        if run.pressure is not None and pressure_noise is not None:
            changed = replace(changed, pressure=run.pressure + pressure_noise.draw(run.pressure.size, generator))
        for name, value in extract(changed, before=work).values.items():
            if name in samples:
                samples[name].append(value - work.values[name])
    return {name: _spread(np.array(values)) for name, values in samples.items() if len(values) >= DRAWS // 2}


def _spread(differences: Array) -> float:
    """Standard deviation among the copies; one wild copy in sixteen does not count (scaled quantile range)."""
    ordinary = float(differences.std(ddof=1))
    lower, upper = np.quantile(differences, [0.16, 0.84])
    robust = float(upper - lower) / 1.9
    return robust if ordinary > 3 * robust > 0 else ordinary


def _pressure_noise(work: Extraction) -> Noise | None:
    if work.run.pressure is None:
        return None
    start, stop = work.windows.free
    part = work.run.pressure[start:stop]
    places = np.arange(part.size, dtype=np.float64)
    residual = np.asarray(part - np.polynomial.Polynomial.fit(places, part, 1)(places), dtype=np.float64)
    return Noise.measure(residual, work.samples(0.1, least=1))


def _sampling(work: Extraction) -> dict[str, float]:
    """Return what the finite sample rate adds: a jump to within its samples, a peak to within its bias."""
    found: dict[str, float] = {}
    values = work.values
    if "pull_off_distance_m" in values:
        travel = _speed(work, work.release) / np.sqrt(12.0)
        stage = np.hypot(_stage_noise(work, work.release), _stage_noise(work, work.zero))
        found["pull_off_distance_m"] = float(np.sqrt(travel**2 + work.release_uncertainty**2 + stage**2))
    if "pull_off_force_N" in values:
        found["pull_off_force_N"] = values["sampling_bias_N"]
        found["retraction_at_pull_off_m"] = _speed(work, work.peak) * float(np.hypot(work.peak_shift, 12.0**-0.5))
    if "snap_duration_s" in values:
        found["snap_duration_s"] = np.sqrt(2 / 12.0) / work.run.rate
    return found


def _stage_noise(work: Extraction, index: float) -> float:
    """How far the stage's position scatters about a steady motion within half a second of the retraction, m."""
    length = work.samples(0.5, least=16)
    start, stop = work.retraction()
    first = max(start, min(int(index) - length // 2, stop - length))
    part = work.run.height[first : first + length]
    places = np.arange(part.size, dtype=np.float64)
    return float(np.std(part - np.polynomial.Polynomial.fit(places, part, 1)(places)))


def _speed(work: Extraction, index: float) -> float:
    """Travel per sample around an index, m."""
    reach = work.samples(0.05, least=4)
    left, right = max(0, int(index) - reach), min(work.run.height.size - 1, int(index) + reach)
    return abs(float(work.run.height[right] - work.run.height[left])) / (right - left)
