"""Live prediction: before pull-off, where the model says it will be, and how sure that is.

From the moment P_0 is reached the curve for the measured P_0 is known; from then on every stretch of the retraction
tells more of the specimen, and the band narrows. Each prediction names the last frame it used. How predictions are made
beside a run is in ``rig.live_run``.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rig.live_data import TOUCH_N, Evidence

if TYPE_CHECKING:
    from model import Parameters
    from rig.live_fit import Doubt, Estimator, Fit

Array = NDArray[np.float64]

POINTS = 64
"""Of the curve shown."""
DRAWS = 256
"""Of the test's end; always the same, so that equal evidence gives an equal prediction."""
UPDATES = 40
"""A new prediction is due when the stage has gone this part of the predicted D_p."""
NINETY = 1.6449
"""Half the width of a normal 90 % interval, in standard deviations."""
SURPRISE = 4.0
"""Data have left the band when they lie so many standard deviations from the announced curve."""
STAYS = 4
"""Predictions for which that is said: the fit soon follows the data, the operator should still see it."""
PASSED = 0.99
"""F_p has been reached once the tension is down to this part of its peak: the model's curves have a single one."""
LEAST_WAY = 0.03
"""Of D_p: pull-off is never announced nearer than this, the model's own end may be behind."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value and the ends of its 90 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class LivePrediction:
    """What the model says of the rest of a test, from the frames so far. SI units, compression positive.

    Attributes
    ----------
    frame, sample
        Number of the last frame it used, and the index one past that frame's last sample.
    model
        Name of the model.
    retraction, force, force_low, force_high
        (m,), the curve against z_r (m) with its 90 % band, N, tared.
    pressure, pressure_low, pressure_high
        (m,), Pa gauge, with its 90 % band, or ``None`` where the scene has no pressure.
    pull_off_force, pull_off_distance
        F_p (N, a magnitude) and D_p (m).
    work_of_adhesion
        The effective one, J/m^2.
    force_zero
        What the load cell reads at no force, N.
    zero_height
        Stage position at z_r = 0, m.
    inside
        Whether the measured force has stayed inside the band announced before it came.
    note
        In words, when it has not.
    progress
        z_r at the last frame over the predicted D_p.
    numerical_error
        Of the model, by feature.
    runtime_s
        Wall time of the prediction, s.
    """

    frame: int
    sample: int
    model: str
    retraction: Array
    force: Array
    force_low: Array
    force_high: Array
    pressure: Array | None
    pressure_low: Array | None
    pressure_high: Array | None
    pull_off_force: Estimate
    pull_off_distance: Estimate
    work_of_adhesion: Estimate
    force_zero: Estimate
    zero_height: float
    inside: bool
    note: str
    progress: float
    numerical_error: Mapping[str, float]
    runtime_s: float

    def to_json(self) -> str:
        """Return the form a recording keeps: one line, six digits of every curve."""
        held = {
            name: [float(f"{number:.6g}") for number in value] if isinstance(value, np.ndarray) else value
            for name, value in asdict(self).items()
        }
        return json.dumps(held, separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> LivePrediction:
        """Read what ``to_json`` wrote.

        Raises
        ------
        ValueError, KeyError, TypeError
            The text is something else.
        """
        held: dict[str, Any] = json.loads(text)
        for field in fields(cls):
            if isinstance(held[field.name], list):
                held[field.name] = np.array(held[field.name], dtype=np.float64)
        for name in ("pull_off_force", "pull_off_distance", "work_of_adhesion", "force_zero"):
            held[name] = Estimate(**held[name])
        return cls(**held)


class LivePredictor:
    """Turns evidence into predictions. Equal evidence in equal order gives equal predictions.

    Parameters
    ----------
    parameters
        The scene's, SI units.
    compliance
        Of the load train, m/N.
    doubt
        What is not known beforehand; the default is calibrated, see ``docs/console.md``.
    model
        Name of the model; the cone is mended by one solution of the exact membrane.
    """

    def __init__(
        self, parameters: Parameters, *, compliance: float = 0.0, doubt: Doubt | None = None, model: str = "cone"
    ) -> None:
        from rig.live_fit import Doubt, Estimator

        self._doubt = doubt or Doubt()
        self._estimator: Estimator = Estimator(parameters, self._doubt, compliance, model)
        self._model = model
        self._nominal_work = parameters.membrane.work_of_adhesion
        self._values: Mapping[str, float] | None = None
        self._last: LivePrediction | None = None
        self._surprised = 0
        self._note = ""
        random = np.random.default_rng(20)
        self._values_drawn = random.standard_normal((DRAWS, 5))
        self._shape_drawn = random.standard_normal((DRAWS, POINTS))
        self._way_drawn = random.standard_normal(DRAWS)

    def predict(self, evidence: Evidence) -> LivePrediction | None:
        """Return the prediction from this evidence, or ``None`` where the model has no pull-off to offer."""
        from model import ModelError
        from rig.live_fit import mend

        began = time.perf_counter()
        try:
            if self._last is None and self._model == "cone":
                middle = {name: value for name, (value, _) in self._estimator.prior(evidence).items()}
                self._estimator.mend = mend(self._estimator.changed(middle))
            fit = self._estimator.fit(evidence, self._values)
        except (ModelError, ArithmeticError, np.linalg.LinAlgError):
            return None  # the scene has no such model, or not yet: the run goes on without
        self._values = fit.values
        self._compare(evidence)
        prediction = _Announcement(self, fit, evidence).prediction()
        self._last = replace(prediction, runtime_s=time.perf_counter() - began)
        return self._last

    @property
    def way_doubt(self) -> float:
        """Standard deviation of the logarithm of the way still to go."""
        return self._doubt.distance if self._estimator.mend.known else self._doubt.unmended_distance

    @property
    def end_doubt(self) -> float:
        """Standard deviation of the end, relative to D_p."""
        return self._doubt.end

    @property
    def drawn(self) -> tuple[Array, Array, Array]:
        """The standard normal draws for values, shape and way."""
        return self._values_drawn, self._shape_drawn, self._way_drawn

    @property
    def nominal_work(self) -> float:
        """The scene's work of adhesion, J/m^2."""
        return self._nominal_work

    @property
    def verdict(self) -> tuple[bool, str]:
        """Whether the data are inside the band, and what to say if not."""
        return self._surprised == 0, self._note if self._surprised else ""

    def _compare(self, evidence: Evidence) -> None:
        """Hold what has come since the last announcement against it."""
        last = self._last
        if last is None:
            return
        new = np.flatnonzero(evidence.height - last.zero_height > last.progress * last.pull_off_distance.value)
        if new.size < 2:
            return
        new = new[-max(2, new.size // 3) :]
        place = evidence.height[new] - last.zero_height
        force = float((evidence.force[new] - last.force_zero.value).mean())
        if place.mean() > last.pull_off_distance.low:
            return
        low = float(np.interp(place, last.retraction, last.force_low).mean())
        high = float(np.interp(place, last.retraction, last.force_high).mean())
        sigma = (high - low) / 2 / NINETY + evidence.force_noise
        if abs(force - (low + high) / 2) <= SURPRISE * sigma:
            self._surprised = max(0, self._surprised - 1)
            return
        self._surprised = STAYS
        self._note = (
            f"F_r left the band at z_r = {place.mean() * 1e3:.3f} mm: "
            f"{force:.3f} N measured, {low:.3f} to {high:.3f} N announced"
        )


class _Announcement:
    """One prediction from one fit."""

    def __init__(self, predictor: LivePredictor, fit: Fit, evidence: Evidence) -> None:
        self._predictor, self._fit, self._evidence = predictor, fit, evidence
        self._curves = fit.curves
        self._zero = fit.values["force_zero"]
        self._tension = self._zero - evidence.force
        self._now = float(evidence.height[-1]) if evidence.height.size else evidence.start
        self._zero_height = self._find_zero_height()
        values, self._shape, self._way = predictor.drawn
        names = list(fit.values)
        self._moves: Array = values[:, : len(names)] @ np.linalg.cholesky(fit.covariance).T
        self._names = names

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
        ends = self._ends()
        middle = self._middle_end()
        retraction, place = self._grid(middle, float(np.quantile(ends, 0.95)))
        force, spread = self._force_at(place)
        force_low, force_high = force - NINETY * spread, force + NINETY * spread
        beyond, maybe = retraction > middle - self._zero_height, self._zero_height + retraction
        force_high = np.where(maybe > np.quantile(ends, 0.05), np.maximum(force_high, 0.0), force_high)
        inside, note = self._predictor.verdict
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
            inside=inside,
            note=note,
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
        way = np.maximum(ends - self._now, self._least_way()) * np.exp(self._predictor.way_doubt * self._way)
        shifted = way + self._predictor.end_doubt * (self._curves.end - self._zero_height) * self._shape[:, 0]
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
        width = self._predictor._doubt.pressure_shape
        shift, covariance, _ = self._conditioned(place, "pressure", fit.pressure_residual, fit.pressure_kernel, width)
        pressure = np.interp(place, self._curves.height, self._curves.pressure) + shift
        spread = NINETY * np.sqrt(np.maximum(np.diag(covariance), 0.0) + 25.0)
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
        nominal, logarithm = self._predictor.nominal_work, self._normal("work")
        return Estimate(*(float(nominal * np.exp(x)) for x in (logarithm.value, logarithm.low, logarithm.high)))


def _round(values: Array) -> Array:
    """Six digits: what is shown live is what the recording keeps."""
    return np.array([float(f"{value:.6g}") for value in values])
