"""From a fit to what is announced: the ends of the test, drawn, and the curve with its band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.live_data import TOUCH_N, Evidence
from rig.live_fit import PRESSURE_NOISE_PA, Doubt, Fit
from rig.live_prediction import NINETY, Estimate, LivePrediction

Array = NDArray[np.float64]

POINTS = 64
"""Of the curve shown."""
DRAWS = 256
"""Of the test's end."""
PASSED = 0.99
"""F_p has been reached once the tension is down to this part of its peak: the model's curves have a single one."""
LEAST_WAY = 0.03
"""Of D_p: pull-off is never announced nearer than this, the model's own end may be behind."""


@dataclass(frozen=True)
class Draws:
    """Standard normal draws, always the same, so that equal evidence gives an equal prediction.

    Attributes
    ----------
    values
        (DRAWS, 5), of the unknowns.
    shape
        (DRAWS, POINTS), of the curve's shape.
    way
        (DRAWS,), of the way still to go.
    """

    values: Array
    shape: Array
    way: Array

    @classmethod
    def standard(cls) -> Draws:
        """Return the draws every predictor uses."""
        random = np.random.default_rng(20)
        values, shape = random.standard_normal((DRAWS, 5)), random.standard_normal((DRAWS, POINTS))
        return cls(values, shape, random.standard_normal(DRAWS))


class Announcement:
    """One prediction from one fit.

    Parameters
    ----------
    fit, evidence
        What was found, from what.
    doubt
        What is not known beforehand.
    mended
        Whether the exact membrane has mended the model's end.
    nominal_work
        The scene's work of adhesion, J/m^2.
    draws
        For the test's end.
    """

    def __init__(
        self, fit: Fit, evidence: Evidence, doubt: Doubt, *, mended: bool, nominal_work: float, draws: Draws
    ) -> None:
        self._fit, self._evidence, self._doubt, self._nominal_work = fit, evidence, doubt, nominal_work
        self._way_doubt = doubt.distance if mended else doubt.unmended_distance
        self._curves = fit.curves
        self._zero = fit.values["force_zero"]
        self._tension = self._zero - evidence.force
        self._now = float(evidence.height[-1]) if evidence.height.size else evidence.start
        self._zero_height = self._find_zero_height()
        self._shape, self._way = draws.shape, draws.way
        self._names = list(fit.values)
        self._moves: Array = draws.values[:, : len(self._names)] @ np.linalg.cholesky(fit.covariance).T

    def _find_zero_height(self) -> float:
        """Where the force crossed zero, or will by the model; the start where it was tensile from the first."""
        height, tension = self._evidence.height, self._tension
        if tension.size and tension[0] > 0:
            return self._evidence.start
        crossed = np.flatnonzero(tension > 0)
        if crossed.size:
            after = int(crossed[0])
            share = -tension[after - 1] / (tension[after] - tension[after - 1])
            return float(height[after - 1] + share * (height[after] - height[after - 1]))
        return max(self._curves.zero_height, self._evidence.start)

    def prediction(self) -> LivePrediction:
        """Return what is announced; whether the data have kept to earlier announcements is not known here."""
        ends = self._ends()
        middle = self._middle_end()
        retraction, place = self._grid(middle, float(np.quantile(ends, 0.95)))
        force, spread = self._force_at(place)
        force_low, force_high = force - NINETY * spread, force + NINETY * spread
        beyond, maybe = retraction > middle - self._zero_height, self._zero_height + retraction
        force_high = np.where(maybe > np.quantile(ends, 0.05), np.maximum(force_high, 0.0), force_high)
        distance = self._interval(middle - self._zero_height, ends - self._zero_height)
        pressure = self._pressure_at(place)
        curves = self._curves.prediction
        return LivePrediction(
            frame=self._evidence.frame,
            sample=self._evidence.sample,
            model=curves.model,
            retraction=_round(retraction),
            force=_round(np.where(beyond, 0.0, force)),
            force_low=_round(force_low),
            force_high=_round(force_high),
            pressure=pressure[0],
            pressure_low=pressure[1],
            pressure_high=pressure[2],
            pull_off_force=self._pull_off_force(),
            pull_off_distance=distance,
            work_of_adhesion=self._work(),
            force_zero=self._normal("force_zero"),
            zero_height=self._zero_height,
            inside=True,
            note="",
            progress=(self._now - self._zero_height) / distance.value,
            numerical_error=dict(curves.numerical_error),
            runtime_s=0.0,
        )

    # -- where it ends

    def _least_way(self) -> float:
        return LEAST_WAY * max(self._curves.end - self._zero_height, 1e-4)

    def _middle_end(self) -> float:
        return self._now + max(self._curves.end - self._now, self._least_way())

    def _ends(self) -> Array:
        """(draws,), heights at detachment: the model's end, moved by the values, the rest of the way in doubt."""
        moved = [self._fit.slopes[name] for name in self._names]
        slope = np.array([(curves.end - self._curves.end) / step for step, curves in moved])
        ends = self._curves.end + self._moves @ slope
        way = np.maximum(ends - self._now, self._least_way()) * np.exp(self._way_doubt * self._way)
        shifted = way + self._doubt.end * (self._curves.end - self._zero_height) * self._shape[:, 0]
        ends_drawn: Array = self._now + np.maximum(shifted, self._least_way() / 3)
        return ends_drawn

    @staticmethod
    def _interval(middle: float, drawn: Array) -> Estimate:
        low, high = np.quantile(drawn, [0.05, 0.95])
        return Estimate(middle, float(min(low, middle)), float(max(high, middle)))

    # -- the curve

    def _grid(self, middle: float, last: float) -> tuple[Array, Array]:
        """Return z_r of the curve's points and the model's heights they show: what is to come is stretched to D_p."""
        data = self._fit.height
        first = float(data[0]) if data.size else max(float(self._curves.height[0]), self._evidence.start)
        shown = np.linspace(first, middle, POINTS - 3)
        shown = np.append(shown, [middle + 1e-9, last, last + 1e-9])
        way = max(middle - self._now, 1e-9)
        ahead = np.clip((shown - self._now) / way, 0.0, 1.0)
        model_way = max(self._curves.end - self._now, 0.0)
        place = np.where(shown <= self._now, shown, self._now + ahead * model_way)
        return shown - self._zero_height, place

    def _sensitivity(self, place: Array, quantity: str) -> Array:
        """(points, unknowns), slopes of the curve; ahead of the stage at equal parts of the way to the end.

        At equal heights they would diverge: the curve ends in a fold. How far the end moves is ``_ends``' business.
        """
        base = getattr(self._curves, quantity)
        way = max(self._curves.end - self._now, 1e-9)
        columns = []
        for name in self._names:
            step, moved = self._fit.slopes[name]
            stretched = place + np.maximum(place - self._now, 0.0) * (moved.end - self._curves.end) / way
            there = np.interp(stretched, moved.height, getattr(moved, quantity))
            columns.append((there - np.interp(place, self._curves.height, base)) / step)
        return np.column_stack(columns)

    def _conditioned(
        self, place: Array, quantity: str, residual: Array, kernel_matrix: Array, width: float
    ) -> tuple[Array, Array, Array]:
        """Return correction, its covariance given the data, and the weights of the data."""
        data = self._fit.height
        across = width**2 * self._fit.kernel(place, data)
        weights = np.linalg.solve(kernel_matrix, across.T).T if data.size else np.zeros((place.size, 0))
        own = width**2 * self._fit.kernel(place, place)
        slopes = self._sensitivity(place, quantity)
        if quantity == "force":
            zero = np.array([[1.0 if name == "force_zero" else 0.0 for name in self._names]])
            at_data = self._sensitivity(data, quantity) + zero if data.size else np.zeros((0, len(self._names)))
        else:
            at_data = self._sensitivity(data, quantity) if data.size else np.zeros((0, len(self._names)))
        left = slopes - weights @ at_data
        covariance = own - weights @ across.T + left @ self._fit.covariance @ left.T
        return weights @ residual, covariance, left

    def _force_at(self, place: Array) -> tuple[Array, Array]:
        fit = self._fit
        shift, covariance, _ = self._conditioned(place, "force", fit.force_residual, fit.force_kernel, fit.force_shape)
        force = np.interp(place, self._curves.height, self._curves.force) + shift
        return force, np.sqrt(np.maximum(np.diag(covariance), 0.0) + self._evidence.force_noise**2)

    def _pressure_at(self, place: Array) -> tuple[Array | None, Array | None, Array | None]:
        fit = self._fit
        if fit.pressure_residual is None or fit.pressure_kernel is None:
            return None, None, None
        width = self._doubt.pressure_shape
        shift, covariance, _ = self._conditioned(place, "pressure", fit.pressure_residual, fit.pressure_kernel, width)
        pressure = np.interp(place, self._curves.height, self._curves.pressure) + shift
        spread = NINETY * np.sqrt(np.maximum(np.diag(covariance), 0.0) + PRESSURE_NOISE_PA**2)
        return _round(pressure), _round(pressure - spread), _round(pressure + spread)

    def _pull_off_force(self) -> Estimate:
        """The peak: what has been reached, or what is still to come."""
        reached = max(float(self._tension.max()), 0.0) if self._tension.size else 0.0
        sigma = self._sigma("force_zero")
        least = PASSED * reached - 5 * self._evidence.force_noise
        passed = reached > 20 * TOUCH_N and self._tension[-1] < least
        if passed or self._curves.end <= self._now:
            return Estimate(reached, reached - NINETY * sigma, reached + NINETY * sigma)
        place = np.linspace(self._now, self._curves.end, POINTS)
        fit = self._fit
        shift, covariance, _ = self._conditioned(place, "force", fit.force_residual, fit.force_kernel, fit.force_shape)
        middle = np.interp(place, self._curves.height, self._curves.force) + shift
        root = np.linalg.cholesky(covariance + 1e-9 * np.eye(place.size))
        drawn = middle + self._shape @ root.T
        peaks = np.maximum(-drawn.min(axis=1), reached) + sigma * self._way[::-1]
        return self._interval(max(reached, float(-middle.min())), peaks)

    # -- what was learnt

    def _sigma(self, name: str) -> float:
        place = self._names.index(name)
        return float(np.sqrt(self._fit.covariance[place, place]))

    def _normal(self, name: str) -> Estimate:
        value, half = self._fit.values[name], NINETY * self._sigma(name)
        return Estimate(value, value - half, value + half)

    def _work(self) -> Estimate:
        nominal, logarithm = self._nominal_work, self._normal("work")
        return Estimate(*(float(nominal * np.exp(x)) for x in (logarithm.value, logarithm.low, logarithm.high)))


def _round(values: Array) -> Array:
    """Six digits: what is shown live is what the recording keeps."""
    return np.array([float(f"{value:.6g}") for value in values])
