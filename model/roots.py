"""Bracketed root finding to machine precision, for floats and for many brackets at once."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from model.prediction import Array

EPSILON = 2.220446049250313e-16


def bracketed(function: Callable[[float], float], a: float, b: float, fa: float, fb: float) -> float:
    """Return the root between ``a`` and ``b``, where the function takes the values ``fa`` and ``fb`` of opposite sign.

    Chandrupatla's method (Advances in Engineering Software 28, 1997): inverse quadratic steps where they are safe,
    bisection otherwise; the secant is tried first.
    """
    if fa == 0.0:
        return a
    if fb == 0.0:
        return b
    fraction = min(max(fa / (fa - fb), 0.01), 0.99) if fa != fb else 0.5
    for _ in range(200):
        x = a + fraction * (b - a)
        fx = function(x)
        if (fx > 0) == (fa > 0):
            c, fc = a, fa
        else:
            c, fc = b, fb
            b, fb = a, fa
        a, fa = x, fx
        best = a if abs(fa) < abs(fb) else b
        tolerance = 4 * EPSILON * abs(best) + 5e-324
        limit = tolerance / abs(b - a) if b != a else 1.0
        if limit > 0.5 or fa == 0.0 or fb == 0.0:
            return best
        fraction = _fraction(a, b, c, fa, fb, fc)
        fraction = min(max(fraction, limit), 1 - limit)
    return best


def _fraction(a: float, b: float, c: float, fa: float, fb: float, fc: float) -> float:
    if c == b or fb in (fc, fa):
        return 0.5
    xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
    if phi**2 < xi and (1 - phi) ** 2 < 1 - xi:
        step = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
        return step if math.isfinite(step) else 0.5
    return 0.5


def bracketed_many(
    function: Callable[[Array], Array], a: Array, b: Array, fa: Array, fb: Array, tolerance: float = 1e-13
) -> Array:
    """Return the roots in many brackets at once (Chandrupatla's method, element by element).

    Brackets of no width return their end; elements whose values do not differ in sign end somewhere inside.
    """
    fraction = np.clip(np.where(fa == fb, 0.5, fa / np.where(fa == fb, 1.0, fa - fb)), 0.01, 0.99)
    best = b
    for _ in range(60):
        x = a + fraction * (b - a)
        fx = function(x)
        same = (fx > 0) == (fa > 0)
        c, fc = np.where(same, a, b), np.where(same, fa, fb)
        b, fb = np.where(same, b, a), np.where(same, fb, fa)
        a, fa = x, fx
        best = np.where(np.abs(fa) < np.abs(fb), a, b)
        width = np.abs(b - a)
        limit = np.where(width > 0, (tolerance * np.abs(best) + 5e-324) / width, 1.0)
        if ((limit > 0.5) | (fx == 0)).all():
            break
        xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
        step = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
        safe = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi) & np.isfinite(step)
        fraction = np.clip(np.where(safe, step, 0.5), np.minimum(limit, 0.5), np.maximum(1 - limit, 0.5))
    return best
