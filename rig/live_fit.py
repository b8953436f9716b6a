"""Estimate what a test is made of from its frames so far, and what that says of its end.

Unknown are the height of the apex, the zero of the force, the stiffness of the film, the effective work of adhesion
and the amount of gas. The cone model gives force and pressure at a height; Gauss-Newton steps find the most probable
values, and their curvature the covariance. The model is not the specimen: what it lacks is an unknown function of
height (a Gaussian process) beside the sensors' noise, so that no amount of data makes the band
narrower than the model deserves.

The cone's known weakness, the distance under suction (EML 2020, section 5: 1.7 times too long on average), is mended by
one solution of the exact membrane at the measured P_0: behind the onset of peeling the cone's curve is stretched to it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model import ModelError, Parameters, predict
from model.prediction import Outcome, Prediction
from rig.live_data import Evidence

Array = NDArray[np.float64]

BINS = 40
PRESSURE_NOISE_PA = 5.0
"""Of a frame's mean."""
SEAT_M = 30e-6
"""Frames this close to where the rim sits on the substrate are left out: the rim carries them, not the film."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """Standard deviations of what is not known beforehand, and of what the model lacks.

    Attributes
    ----------
    apex, touch_offset
        m: of the height of the apex about the first touch; it lies ``touch_offset`` above the touch.
    apex_unfelt
        m: the same when no touch was felt and the start of the retraction must do.
    force_zero
        N: drift of the load cell since the tare.
    stiffness, work_of_adhesion
        Relative (of the logarithm).
    gas
        Pa: of the pressure the chamber would have with the membrane flat.
    force_shape, pressure_shape
        Of the discrepancy: relative to F_p, and Pa.
    correlation
        Length over which the discrepancy changes, relative to D_p.
    rough, rough_correlation
        The same for its rough part, as a share of the smooth one: the model's onset of peeling is a kink, the
        specimen's is not, and not at the same height.
    curvature
        How much more the force is in doubt on a small sphere, times (R_0 / r_b)^2: the film is strained where it lies
        on the sphere, and how is an assumption (EML 2020, section 4).
    distance, end
        Of the logarithm of the way still to go, and of the end itself relative to D_p.
    unmended_distance
        In place of ``distance`` where the exact membrane has no solution.
    """

    apex: float = 20e-6
    touch_offset: float = 5e-6
    apex_unfelt: float = 0.3e-3
    force_zero: float = 1.5e-3
    stiffness: float = 0.10
    work_of_adhesion: float = 0.25
    gas: float = 300.0
    force_shape: float = 0.13
    pressure_shape: float = 150.0
    correlation: float = 0.4
    rough: float = 0.3
    rough_correlation: float = 0.08
    curvature: float = 2.0
    distance: float = 0.12
    end: float = 0.07
    unmended_distance: float = 0.3


@dataclass(frozen=True, slots=True)
class Mend:
    """How the exact membrane differs from the cone.

    Factors on the way from onset to detachment, on the force, and on the change of the pressure on that way.
    """

    distance: float = 1.0
    force: float = 1.0
    pressure: float = 1.0
    known: bool = False


class Kernel:
    """Covariance of the discrepancy between two heights, over its variance: a smooth part and a rough one."""

    def __init__(self, doubt: Doubt, distance: float) -> None:
        self._length = doubt.correlation * distance
        self._rough_length = doubt.rough_correlation * distance
        self._rough = doubt.rough**2

    def __call__(self, one: Array, other: Array) -> Array:
        """Return (len(one), len(other))."""
        apart = np.abs(one[:, None] - other[None, :])
        smooth: Array = np.exp(-0.5 * (apart / self._length) ** 2)
        return smooth + self._rough * np.exp(-apart / self._rough_length)


@dataclass(frozen=True)
class Curves:
    """The mended model at one set of values, against the stage's height: arrays of equal length, and its features."""

    height: Array
    force: Array
    pressure: Array
    zero_height: float
    pull_off_force: float
    prediction: Prediction

    @property
    def end(self) -> float:
        """Height at detachment, m."""
        return float(self.height[-1])


Slopes = Mapping[str, tuple[float, Curves]]
"""For every unknown a step (of either sign) and the curves one step away."""


@dataclass(frozen=True)
class Fit:
    """The most probable values, their covariance, and the discrepancy given the data."""

    values: Mapping[str, float]
    covariance: Array
    curves: Curves
    slopes: Slopes
    height: Array
    force_residual: Array
    pressure_residual: Array | None
    force_kernel: Array
    pressure_kernel: Array | None
    kernel: Kernel
    force_shape: float


class NoFit(ModelError):
    """The model has no pull-off near these values."""


def mend(parameters: Parameters) -> Mend:
    """Compare the exact membrane with the cone at the same values."""
    cone = predict(parameters)
    try:
        exact = predict(parameters, "membrane")
    except (ModelError, ArithmeticError, ValueError):  # no solution here: the cone stays as it is, with more doubt
        return Mend()
    if cone.outcome is not Outcome.PULL_OFF or exact.outcome is not Outcome.PULL_OFF:
        return Mend()
    way = cone.detachment_position - cone.onset_position
    exact_way = exact.detachment_position - cone.onset_position
    if not way > 0 or not 0.1 < exact_way / way < 3:
        return Mend()
    before = float(np.interp(cone.onset_position, cone.position, cone.pressure))
    change, exact_change = float(cone.pressure[-1]) - before, float(exact.pressure[-1]) - before
    pressure = exact_change / change if abs(change) > 10.0 else 1.0
    force = exact.pull_off_force / cone.pull_off_force
    return Mend(float(exact_way / way), float(force), min(max(pressure, 0.0), 2.0), known=True)


STEPS = {"apex": 2e-6, "force_zero": 1e-4, "stiffness": 1e-3, "work": 1e-3, "gas": 5.0}
"""Differences the slopes are taken over."""


class Estimator:
    """Fits one test again and again as its frames come.

    Parameters
    ----------
    parameters
        The scene's.
    compliance
        Of the load train, m/N.
    model
        Name of the model.
    """

    def __init__(self, parameters: Parameters, doubt: Doubt, compliance: float, model: str) -> None:
        self._parameters = parameters
        self._model = model
        self._doubt = doubt
        self._compliance = compliance
        self.mend = Mend()

    # -- the model

    def curves(self, values: Mapping[str, float]) -> Curves:
        """Return the mended model at these values.

        Raises
        ------
        NoFit
            There is no pull-off at these values.
        """
        found = predict(self.changed(values), self._model, points=80)
        if found.outcome is not Outcome.PULL_OFF:
            raise NoFit(f"live prediction: {found.outcome}")
        stretched, mended = self.mend.distance, self.mend.force
        onset = found.onset_position
        beyond = np.maximum(found.position - onset, 0.0)
        position = np.minimum(found.position, onset) + stretched * beyond
        force = found.force * (1 + (mended - 1) * np.minimum(beyond / (0.3 * max(beyond[-1], 1e-9)), 1.0))
        before = float(np.interp(onset, found.position, found.pressure))
        change = np.where(beyond > 0, found.pressure - before, 0.0)
        zero = found.zero_force_position
        zero = zero if zero <= onset else onset + stretched * (zero - onset)
        return Curves(
            height=position + values["apex"] - self._compliance * force,
            force=force,
            pressure=found.pressure + (self.mend.pressure - 1) * change,
            zero_height=zero + values["apex"],
            pull_off_force=float(-force.min()),
            prediction=found,
        )

    def changed(self, values: Mapping[str, float]) -> Parameters:
        """Return the scene with these values in it."""
        film = self._parameters.membrane
        return self._parameters.with_changes(
            thickness=film.thickness * math.exp(values["stiffness"]),
            work_of_adhesion=film.work_of_adhesion * math.exp(values["work"]),
            initial_pressure=values.get("gas"),
        )

    def prior(self, evidence: Evidence) -> dict[str, tuple[float, float]]:
        """Return the expected value of every unknown and its standard deviation."""
        doubt = self._doubt
        felt = not math.isnan(evidence.touch)
        apex = evidence.touch + doubt.touch_offset if felt else evidence.start - self._seat()
        unknown = {
            "apex": (apex, doubt.apex if felt else doubt.apex_unfelt),
            "force_zero": (evidence.force_zero, doubt.force_zero),
            "stiffness": (0.0, doubt.stiffness),
            "work": (0.0, doubt.work_of_adhesion),
        }
        if evidence.initial_pressure is not None:
            unknown["gas"] = (self._flat_pressure(evidence, apex), doubt.gas)
        return unknown

    @property
    def _bend(self) -> float:
        """R_0 / r_b: how strongly the substrate bends the film."""
        return self._parameters.gripper.radius / self._parameters.substrate.radius

    def _seat(self) -> float:
        """z_0: the rim on the substrate, m above the apex."""
        sphere, rim = self._parameters.substrate.radius, self._parameters.gripper.radius
        if math.isinf(sphere):
            return 0.0
        return -sphere if sphere <= rim else -sphere + math.sqrt(sphere**2 - rim**2)

    def _flat_pressure(self, evidence: Evidence, apex: float) -> float:
        """P_0 was measured in contact: the pressure the same gas would have with the membrane flat."""
        pressure = measured = evidence.initial_pressure or 0.0
        for _ in range(3):
            found = predict(self._parameters.with_changes(initial_pressure=pressure), points=40)
            if not found.position.size:
                return measured
            pressure += measured - float(np.interp(evidence.start - apex, found.position, found.pressure))
        return pressure

    # -- the fit

    def fit(self, evidence: Evidence, start: Mapping[str, float] | None) -> Fit:
        """Return the most probable values given the evidence; ``start`` is where to look first.

        Raises
        ------
        NoFit
            The model has no pull-off at the values looked at.
        """
        prior = self.prior(evidence)
        middle = {name: value for name, (value, _) in prior.items()}
        begin = self.curves(middle)
        problem = _Problem(self, evidence, prior, begin, self._doubt, self._seat(), self._bend)
        return problem.solve(middle if start is None else {name: start[name] for name in middle})


class _Problem:
    """Whitened residuals of one fit and their Gauss-Newton solution."""

    def __init__(
        self,
        estimator: Estimator,
        evidence: Evidence,
        prior: Mapping[str, tuple[float, float]],
        begin: Curves,
        doubt: Doubt,
        seat: float,
        bend: float,
    ) -> None:
        self._estimator = estimator
        self._prior = prior
        film = evidence.height > prior["apex"][0] + seat + SEAT_M
        columns = [evidence.height[film], evidence.force[film]]
        if evidence.pressure is not None:
            columns.append(evidence.pressure[film])
        binned = _binned(columns)
        self._height, self._force = binned[0], binned[1]
        self._pressure = binned[2] if evidence.pressure is not None else None
        self._kernel = Kernel(doubt, begin.end - begin.zero_height)
        self._force_shape = doubt.force_shape * begin.pull_off_force * (1 + doubt.curvature * bend**2)
        same = self._kernel(self._height, self._height)
        noise = max(evidence.force_noise, 2e-4) ** 2
        self._force_kernel = self._force_shape**2 * same + noise * np.eye(self._height.size)
        self._force_root = np.linalg.cholesky(self._force_kernel)
        self._pressure_kernel = None
        if self._pressure is not None:
            self._pressure_kernel = doubt.pressure_shape**2 * same + PRESSURE_NOISE_PA**2 * np.eye(self._height.size)
            self._pressure_root = np.linalg.cholesky(self._pressure_kernel)

    def solve(self, start: Mapping[str, float], most: int = 4) -> Fit:
        names = list(self._prior)
        values = dict(start)
        try:
            residual, curves = self._residual(values)
        except NoFit:
            values = {name: value for name, (value, _) in self._prior.items()}
            residual, curves = self._residual(values)
        damping = 1e-3
        for _ in range(most):
            _, jacobian = self._slopes(values, residual, names)
            normal, gradient = jacobian.T @ jacobian, jacobian.T @ residual
            gain = 0.0
            while damping < 1e6:
                move = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
                tried = {name: values[name] + float(step) for name, step in zip(names, move, strict=True)}
                try:
                    after, found = self._residual(tried)
                except NoFit:
                    damping *= 10
                    continue
                gain = float(residual @ residual - after @ after)
                if gain >= 0:
                    values, residual, curves = tried, after, found
                    damping = max(damping / 10, 1e-9)
                    break
                damping *= 10
            if gain < 0.02:
                break
        slopes, jacobian = self._slopes(values, residual, names)
        return self._fit(values, np.asarray(np.linalg.inv(jacobian.T @ jacobian), np.float64), curves, slopes)

    def _fit(self, values: dict[str, float], covariance: Array, curves: Curves, slopes: Slopes) -> Fit:
        force = self._force - values["force_zero"] - np.interp(self._height, curves.height, curves.force)
        pressure = None
        if self._pressure is not None:
            pressure = self._pressure - np.interp(self._height, curves.height, curves.pressure)
        return Fit(
            values=values,
            covariance=covariance,
            curves=curves,
            slopes=slopes,
            height=self._height,
            force_residual=force,
            pressure_residual=pressure,
            force_kernel=self._force_kernel,
            pressure_kernel=self._pressure_kernel,
            kernel=self._kernel,
            force_shape=self._force_shape,
        )

    def _residual(self, values: Mapping[str, float]) -> tuple[Array, Curves]:
        curves = self._estimator.curves(values)
        force = self._force - values["force_zero"] - np.interp(self._height, curves.height, curves.force)
        parts = [np.linalg.solve(self._force_root, force)]
        if self._pressure is not None:
            pressure = self._pressure - np.interp(self._height, curves.height, curves.pressure)
            parts.append(np.linalg.solve(self._pressure_root, pressure))
        parts.append(np.array([(values[name] - middle) / width for name, (middle, width) in self._prior.items()]))
        return np.concatenate(parts), curves

    def _slopes(
        self, values: Mapping[str, float], residual: Array, names: list[str]
    ) -> tuple[dict[str, tuple[float, Curves]], Array]:
        slopes: dict[str, tuple[float, Curves]] = {}
        columns = []
        for name in names:
            for step in (STEPS[name], -STEPS[name]):
                try:
                    moved, curves = self._residual({**values, name: values[name] + step})
                except NoFit:
                    continue
                slopes[name] = (step, curves)
                columns.append((moved - residual) / step)
                break
            else:
                raise NoFit(f"live prediction: no pull-off on either side of {name} = {values[name]:g}")
        return slopes, np.column_stack(columns)


def _binned(columns: list[Array]) -> list[Array]:
    """Average over equal stretches of height: the fit's cost must not grow with the test."""
    height = columns[0]
    if height.size <= BINS:
        return columns
    edges = np.linspace(height.min(), height.max(), BINS + 1)
    place = np.clip(np.searchsorted(edges, height, side="right") - 1, 0, BINS - 1)
    count = np.bincount(place, minlength=BINS)
    used = count > 0
    return [np.bincount(place, column, BINS)[used] / count[used] for column in columns]
