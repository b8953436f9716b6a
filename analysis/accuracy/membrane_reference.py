"""The membrane by shooting: an independent method for the accuracy report.

Eighth-order Runge-Kutta from the contact line to the rim, with its own stretch inversion; the peel angle and the
pressure are found so that the rim is met and the gas law holds. Shares no code with the collocation solver. Projected
stick on a sphere, or a flat; lengths by R_0, tensions by mu h_0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from model.parameters import Parameters


class Shot(NamedTuple):
    """Height of the rim, pull over 2 pi and pressure of one peeling state."""

    height: float
    pull: float
    pressure: float


@dataclass(frozen=True)
class Problem:
    """One scene, gas anchored at V_0."""

    curvature: float
    pressure: float
    atmosphere: float
    volume: float
    work: float
    force_unit: float
    length: float
    calls: list[int] = field(default_factory=lambda: [0])
    """Evaluations of the right-hand side so far."""

    @classmethod
    def of(cls, parameters: Parameters) -> Problem:
        """Scale a scene."""
        gripper, membrane, gas = parameters.gripper, parameters.membrane, parameters.gas
        length, tension = gripper.radius, membrane.youngs_modulus * membrane.thickness / 3
        return cls(
            curvature=0.0 if parameters.substrate.shape == "flat" else length / parameters.substrate.radius,
            pressure=gas.initial_pressure * length / tension,
            atmosphere=gas.atmospheric_pressure * length / tension,
            volume=gripper.chamber_volume / length**3,
            work=membrane.work_of_adhesion / tension,
            force_unit=2 * math.pi * tension * length,
            length=length,
        )


def stretch(tension: float, hoop: float) -> float:
    """Solve lambda^4 - tension lambda^3 - hoop^-2 = 0."""
    constant = hoop**-2
    root = tension + constant**0.25
    for _ in range(60):
        step = (root**4 - tension * root**3 - constant) / (4 * root**3 - 3 * tension * root**2)
        root -= step
        if abs(step) < 1e-16 * root:
            break
    return float(root)


def _stored(first: float, second: float) -> float:
    return float(0.5 * (first**2 + second**2 + (first * second) ** -2 - 3))


def shoot(problem: Problem, a: float, guess: tuple[float, float], tolerance: float = 1e-13) -> Shot:
    """Return the peeling state at contact radius ``a`` from a guess of peel angle and pressure."""
    from scipy.optimize import root

    def miss(x: Any) -> list[float]:
        return _miss(problem, a, x, tolerance)[0]

    answer = root(miss, guess, tol=1e-14)
    return _miss(problem, a, answer.x, tolerance)[1]


def _miss(problem: Problem, a: float, x: Any, tolerance: float) -> tuple[list[float], Shot]:
    from scipy.integrate import solve_ivp

    angle, pressure = float(x[0]), float(x[1])
    sine = problem.curvature * a
    cosine = math.sqrt(1 - sine**2)
    drop = a * sine / (1 + cosine)
    slope = angle - math.asin(sine)
    tension = _tension_at_release(problem.work, angle, 1 / cosine)
    Q, P = a * tension * math.cos(slope), a * tension * math.sin(slope)
    pull = P - pressure * a**2 / 2

    def right(R: float, y: Any) -> list[float]:
        r, q, _, _ = y
        problem.calls[0] += 1
        vertical = pressure * r * r / 2 + pull
        size = math.hypot(q, vertical)
        hoop = r / R
        first = stretch(size / R, hoop)
        rise = first * vertical / size
        second = hoop - hoop**-3 * first**-2
        return [first * q / size, second - pressure * r * rise, rise, math.pi * r * r * rise]

    end = solve_ivp(right, (a, 1.0), [a, Q, -drop, 0.0], method="DOP853", rtol=tolerance, atol=tolerance).y[:, -1]
    cap = math.pi * drop / 6 * (3 * a**2 + drop**2)
    ratio = 1 + (float(end[3]) - cap) / problem.volume
    gas = (pressure + problem.atmosphere) * ratio - problem.pressure - problem.atmosphere
    return [float(end[0]) - 1, gas], Shot(float(end[2]), pull, pressure)


def _tension_at_release(work: float, angle: float, held: float) -> float:
    """Return the tension at which a membrane stuck with stretch ``held`` peels at an angle."""
    from scipy.optimize import brentq

    def excess(tension: float) -> float:
        first = stretch(tension, 1.0)
        return _stored(held, 1.0) - _stored(first, 1.0) + tension * (first - held * math.cos(angle)) - work

    low = held - held**-3  # the release rate is least where the stretches agree
    high = max(2 * low, 1e-6)
    while excess(high) < 0:
        high *= 2
    return float(brentq(excess, low, high, xtol=1e-16, rtol=1e-15))


def highest(
    problem: Problem, quantity: Callable[[Shot], float], bracket: tuple[float, float], guess: tuple[float, float]
) -> float:
    """Return the greatest value of a quantity over the contact radius, by Brent's method."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(
        lambda a: -quantity(shoot(problem, a, guess)), bounds=bracket, method="bounded", options={"xatol": 1e-8}
    )
    return -float(found.fun)


def collocated(problem: Problem, a: float, guess: tuple[float, float], tolerance: float) -> Shot:
    """Return the same state by ``scipy.integrate.solve_bvp``, for comparison of methods."""
    from scipy.integrate import solve_bvp

    sine = problem.curvature * a
    cosine = math.sqrt(1 - sine**2)
    drop = a * sine / (1 + cosine)
    cap = math.pi * drop / 6 * (3 * a**2 + drop**2)

    def right(R: Any, y: Any, unknown: Any) -> Any:
        r, q, _, _ = y
        problem.calls[0] += R.size
        angle, pressure = unknown
        pull = _pull(problem, a, float(angle), float(pressure), 1 / cosine, math.asin(sine))[1]
        vertical = pressure * r * r / 2 + pull
        size = np.hypot(q, vertical)
        hoop = r / R
        first = np.array([stretch(t, h) for t, h in zip(size / R, hoop, strict=True)])
        rise = first * vertical / size
        return np.stack(
            [first * q / size, hoop - hoop**-3 * first**-2 - pressure * r * rise, rise, np.pi * r * r * rise]
        )

    def ends(left: Any, end: Any, unknown: Any) -> Any:
        angle, pressure = unknown
        Q, _ = _pull(problem, a, float(angle), float(pressure), 1 / cosine, math.asin(sine))
        ratio = 1 + (end[3] - cap) / problem.volume
        gas = (pressure + problem.atmosphere) * ratio - problem.pressure - problem.atmosphere
        return np.array([left[0] - a, left[1] - Q, left[2] + drop, left[3], end[0] - 1, gas])

    R = a * (1 / a) ** np.linspace(0, 1, 8)
    start = np.stack([R, 0.4 * R, (R - a) * math.tan(guess[0]), np.zeros_like(R)])
    solved = solve_bvp(right, ends, R, start, p=list(guess), tol=tolerance, max_nodes=20000)
    assert solved.p is not None
    angle, pressure = (float(value) for value in solved.p)
    pull = _pull(problem, a, angle, pressure, 1 / cosine, math.asin(sine))[1]
    return Shot(float(solved.y[2, -1]), pull, pressure)


def _pull(
    problem: Problem, a: float, angle: float, pressure: float, held: float, substrate: float
) -> tuple[float, float]:
    tension = _tension_at_release(problem.work, angle, held)
    slope = angle - substrate
    return a * tension * math.cos(slope), a * tension * math.sin(slope) - pressure * a**2 / 2
