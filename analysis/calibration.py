"""Fits behind the calibration records: dead weights on the load cell, a rigid stop for compliance, pressure zero."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.errors import AnalysisError
from analysis.numerics import Array, Noise

STANDARD_GRAVITY = 9.80665
"""m/s^2; use the local value where it is known, it differs by up to 0.3 %."""


@dataclass(frozen=True, slots=True)
class LineFit:
    """A straight line y = slope x + intercept.

    Attributes
    ----------
    slope, slope_uncertainty, intercept
        The uncertainty is a standard one.
    scatter
        Standard deviation of the residuals (n - 2): with their size, the linearity.
    """

    slope: float
    slope_uncertainty: float
    intercept: float
    scatter: float


def fit_line(x: Array, y: Array) -> LineFit:
    """Fit y = slope x + intercept by least squares.

    Raises
    ------
    AnalysisError
        Fewer than three points, or all at the same x.
    """
    if x.size < 3 or float(np.ptp(x)) == 0:
        raise AnalysisError(f"{x.size} points over a range of {float(np.ptp(x)) if x.size else 0:g}: no line to fit")
    design = np.stack([x, np.ones_like(x)], axis=1)
    solution, _, _, _ = np.linalg.lstsq(design, y, rcond=None)
    residual = y - design @ solution
    variance = float(residual @ residual) / (x.size - 2)
    spread = float(np.linalg.inv(design.T @ design)[0, 0]) * variance
    return LineFit(float(solution[0]), float(np.sqrt(spread)), float(solution[1]), float(np.sqrt(variance)))


@dataclass(frozen=True, slots=True)
class LoadCellCalibration:
    """What a calibration record of the load cell needs.

    Attributes
    ----------
    slope
        N per V (or per mV/V).
    relative_uncertainty
        Of the slope, from the fit and the masses.
    residual
        Linearity: root mean square distance from the line, N.
    intercept
        Reading-side zero expressed in N.
    """

    slope: float
    relative_uncertainty: float
    residual: float
    intercept: float


def calibrate_load_cell(
    masses: Array, readings: Array, *, mass_uncertainty: float = 0.0, gravity: float = STANDARD_GRAVITY
) -> LoadCellCalibration:
    """Calibrate a load cell against dead weights.

    Parameters
    ----------
    masses
        (n,), kg; hung weights pull and count negative, weights put on top positive (compression is positive).
    readings
        (n,), V or mV/V.
    mass_uncertainty
        Relative standard uncertainty common to the masses.

    Returns
    -------
    LoadCellCalibration
        F = slope * reading + intercept.
    """
    fit = fit_line(np.asarray(readings, dtype=np.float64), np.asarray(masses, dtype=np.float64) * gravity)
    relative = float(np.hypot(fit.slope_uncertainty / abs(fit.slope), mass_uncertainty))
    return LoadCellCalibration(fit.slope, relative, fit.scatter, fit.intercept)


@dataclass(frozen=True, slots=True)
class ComplianceCalibration:
    """C of load cell, fixture and frame, m/N, and how far the F-delta curve bends from the line (m, rms)."""

    compliance: float
    uncertainty: float
    nonlinearity: float


def calibrate_compliance(force: Array, height: Array, noise: Noise | None = None) -> ComplianceCalibration:
    """Fit the compliance from pressing on a rigid stop: all the travel is the load train's.

    Parameters
    ----------
    force
        (n,), N, compression positive, tared, in contact only.
    height
        (n,), m, stage height, rising away from the stop.
    noise
        Of the force; widens the uncertainty for correlated noise.
    """
    fit = fit_line(force, -height)
    inflation = 1.0 if noise is None else noise.inflation
    return ComplianceCalibration(fit.slope, fit.slope_uncertainty * inflation, fit.scatter)


def pressure_zero(pressure: Array, rate: float) -> tuple[float, float]:
    """Return the mean of a vented record and its standard uncertainty, Pa; the noise's colour is measured.

    Parameters
    ----------
    pressure
        (n,), Pa, with the chamber open to the room.
    rate
        Hz.
    """
    noise = Noise.measure(np.asarray(pressure - pressure.mean(), dtype=np.float64), max(1, round(0.1 * rate)))
    return float(pressure.mean()), noise.of_mean(pressure.size)
