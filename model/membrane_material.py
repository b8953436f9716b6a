"""The neo-Hookean membrane in terms of its meridional tension.

Energies and tensions are per reference area and width in units of mu h_0 = E_m h_0 / 3, stretches lambda_1 (along the
meridian) and lambda_2 (hoop); incompressible (EML Eq. 2). Given the nominal meridional tension the meridional stretch
follows, so that nothing is singular where the membrane turns vertical.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LAST_STEP = 1e-8
"""Relative step after which the quadratic convergence of the stretch is at rounding."""


class Response(NamedTuple):
    """State of the membrane at given meridional tension and hoop stretch.

    ``compliance``, ``coupling`` and ``hoop_stiffness`` are d lambda_1 / d tension, d lambda_1 / d lambda_2 and
    d hoop_tension / d lambda_2; by symmetry d hoop_tension / d tension = -coupling.
    """

    stretch: Array
    hoop_tension: Array
    compliance: Array
    coupling: Array
    hoop_stiffness: Array


def energy(stretch: Array, hoop: Array, *, tension_field: bool = False) -> Array:
    """Return (lambda_1^2 + lambda_2^2 + lambda_1^-2 lambda_2^-2 - 3) / 2 without cancellation at small strains."""
    if tension_field:
        hoop = np.maximum(hoop, stretch**-0.5)
    thickness = 1 / (stretch * hoop)
    return 0.5 * ((stretch - thickness) ** 2 + (hoop - 1) ** 2 * (hoop + 2) / hoop)


def tension(stretch: Array, hoop: Array) -> Array:
    """Return the nominal meridional tension lambda_1 - lambda_1^-3 lambda_2^-2."""
    return stretch - stretch**-3 * hoop**-2


def respond(tension: Array, hoop: Array, *, tension_field: bool = False) -> Response:
    """Return the response to a tension >= 0 and a hoop stretch > 0, arrays of equal shape.

    With ``tension_field`` the hoop direction carries no compression: where it would, the relaxed energy of the
    wrinkled membrane holds (lambda_1^2 + 2 / lambda_1 - 3) / 2.
    """
    inverse_square = hoop**-2
    stretch = _larger_root(tension, inverse_square, power=4)
    cube = inverse_square / stretch**3
    stiffness = 1 + 3 * cube / stretch
    mixed = 2 * cube / hoop
    hoop_stiffness = 1 + 3 * inverse_square**2 / stretch**2
    hoop_tension = hoop - inverse_square / (hoop * stretch**2)
    response = Response(stretch, hoop_tension, 1 / stiffness, -mixed / stiffness, hoop_stiffness - mixed**2 / stiffness)
    return _wrinkled(tension, response) if tension_field else response


def _wrinkled(tension: Array, taut: Response) -> Response:
    wrinkled = taut.hoop_tension < 0
    stretch = np.where(wrinkled, _larger_root(tension, np.ones_like(tension), power=3), taut.stretch)
    zero = np.zeros_like(tension)
    return Response(
        stretch,
        np.where(wrinkled, zero, taut.hoop_tension),
        np.where(wrinkled, 1 / (1 + 2 / stretch**3), taut.compliance),
        np.where(wrinkled, zero, taut.coupling),
        np.where(wrinkled, zero, taut.hoop_stiffness),
    )


def _larger_root(tension: Array, constant: Array, *, power: int) -> Array:
    """Solve x^(n-1) (x - tension) = constant for its largest root by Newton's method.

    The start is the series in small tension, bounded by tension + constant^(1/n) above the root: there the left side
    is convex and the iteration cannot leave it.
    """
    base = constant ** (1 / power)
    root = np.minimum(base + tension / power * (1 + (power - 1) / (2 * power) * tension / base), base + tension)
    for _ in range(50):
        lower = root ** (power - 2)
        step = (lower * root * (root - tension) - constant) / (lower * (power * root - (power - 1) * tension))
        root = root - step
        if not (np.abs(step) > LAST_STEP * root).any():
            break
    return root
