"""Adhesive contact of a sphere and an elastic body: JKR, DMT, Maugis, and the bounds of a thin bonded layer.

Forces and indentations are compression positive. ``modulus`` is everywhere the contact modulus
E* = 1 / ((1 - nu_1^2) / E_1 + (1 - nu_2^2) / E_2), Pa.

Sources: Johnson, Kendall, Roberts, Proc. R. Soc. A 324 (1971); Derjaguin, Muller, Toporov, J. Colloid Interface
Sci. 53 (1975); Maugis, J. Colloid Interface Sci. 150 (1992); SI Eq. S13.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import InvalidParameter

Array = NDArray[np.float64]

LENNARD_JONES_STRENGTH = 16 / (9 * math.sqrt(3))
"""Peak stress of a Lennard-Jones interface in units of work of adhesion over equilibrium separation."""


@dataclass(frozen=True)
class ContactCurve:
    """One unloading curve, from the deepest indentation to the last stable contact at fixed displacement.

    Attributes
    ----------
    indentation, force, contact_radius
        Arrays of equal length: m, N, m. The indentation falls along the curve.
    """

    indentation: Array
    force: Array
    contact_radius: Array

    @property
    def pull_off_force(self) -> float:
        """Greatest tension on the curve, N, a magnitude."""
        return max(0.0, -float(self.force.min()))

    def force_at(self, indentation: ArrayLike) -> Array:
        """Return the force at the given indentations, N; zero after detachment, nan deeper than the curve."""
        order = self.indentation[::-1]
        depth = np.asarray(indentation, dtype=float)
        return np.asarray(np.interp(depth, order, self.force[::-1], left=0.0, right=np.nan))


class WorkOfAdhesionBounds(NamedTuple):
    """What a pull-off force says about the work of adhesion under different supports, J/m^2."""

    incompressible_layer: float
    """Thin incompressible bonded layer, contact much wider than the layer is thick: F = 3 pi R w."""
    winkler_layer: float
    """Layer of independent springs (or DMT): F = 2 pi R w."""
    half_space: float
    """JKR half-space: F = 3/2 pi R w (SI Eq. S13)."""


def work_of_adhesion_jkr(pull_off_force: float, radius: float) -> float:
    """Return w = 2 F / (3 pi R), J/m^2 (SI Eq. S13)."""
    return 2 * pull_off_force / (3 * math.pi * _positive(radius, "radius"))


def pull_off_force_jkr(work_of_adhesion: float, radius: float) -> float:
    """Return F = 3/2 pi R w, N."""
    return 1.5 * math.pi * _positive(radius, "radius") * work_of_adhesion


def thin_layer_bounds(pull_off_force: float, radius: float) -> WorkOfAdhesionBounds:
    """Return the works of adhesion that one pull-off force allows, depending on what carries the fibres.

    Equation S13 takes a half-space; a 0.25 mm film on glass under a contact of 0.5 mm radius is none.
    """
    unit = pull_off_force / (math.pi * _positive(radius, "radius"))
    return WorkOfAdhesionBounds(incompressible_layer=unit / 3, winkler_layer=unit / 2, half_space=2 * unit / 3)


def contact_modulus(youngs_modulus: float, poissons_ratio: float = 0.5) -> float:
    """Return E* of an elastic body against a rigid one, Pa."""
    return _positive(youngs_modulus, "Young's modulus") / (1 - poissons_ratio**2)


def tabor_parameter(work_of_adhesion: float, radius: float, modulus: float, equilibrium_separation: float) -> float:
    """Return mu = (R w^2 / (E*^2 z_0^3))^(1/3): JKR above about 5, DMT below about 0.1."""
    separation = _positive(equilibrium_separation, "equilibrium separation")
    return float(np.cbrt(_positive(radius, "radius") * (work_of_adhesion / _positive(modulus, "modulus")) ** 2)) / (
        separation
    )


def maugis_parameter(work_of_adhesion: float, radius: float, modulus: float, strength: float) -> float:
    """Return lambda = 2 sigma_0 (R / (pi w K^2))^(1/3) with K = 4 E* / 3."""
    stiffness = 4 / 3 * _positive(modulus, "modulus")
    work = math.pi * _positive(work_of_adhesion, "work of adhesion")
    return 2 * strength * float(np.cbrt(_positive(radius, "radius") / (work * stiffness**2)))


def jkr_curve(
    work_of_adhesion: float, radius: float, modulus: float, *, largest_contact: float, points: int = 200
) -> ContactCurve:
    """Return the JKR unloading curve from contact radius ``largest_contact`` (m) to the fold at fixed displacement."""
    pull = math.pi * work_of_adhesion / (2 * _positive(modulus, "modulus"))
    fold = float(np.cbrt(radius**2 * pull / 4))
    contact = _falling(largest_contact, fold, points)
    indentation = contact**2 / radius - 2 * np.sqrt(pull * contact)
    force = jkr_force_at(contact, work_of_adhesion, radius, modulus)
    return ContactCurve(indentation, force, contact)


def jkr_contact_radius(indentation: ArrayLike, work_of_adhesion: float, radius: float, modulus: float) -> Array:
    """Return the exact JKR contact radius at given indentations, m; nan where no contact is stable.

    Solves a^2 / R - 2 sqrt(pi w a / (2 E*)) = indentation for its larger root by Newton's method; the left side is
    convex and rising there, so that the iteration from above cannot miss.
    """
    depth = np.asarray(indentation, dtype=float)
    pull = math.pi * work_of_adhesion / (2 * _positive(modulus, "modulus"))
    root_fold = float(np.cbrt(radius * math.sqrt(pull) / 2))  # square root of the contact radius at the fold
    deepest_pull = root_fold**4 / radius - 2 * math.sqrt(pull) * root_fold
    alive = depth >= deepest_pull
    reach = np.maximum(depth, 0.0)
    root = np.sqrt(np.sqrt(radius * reach)) + np.cbrt(2 * radius * math.sqrt(pull))
    for _ in range(60):
        value = root**4 / radius - 2 * math.sqrt(pull) * root - depth
        slope = 4 * root**3 / radius - 2 * math.sqrt(pull)
        step = np.divide(value, slope, out=np.zeros_like(root), where=alive & (slope > 0))
        root = np.maximum(root - step, root_fold)
        if np.all(np.abs(step) <= 1e-15 * root):
            break
    return np.where(alive, root**2, np.nan)


def jkr_force(indentation: ArrayLike, work_of_adhesion: float, radius: float, modulus: float) -> Array:
    """Return the exact JKR force at given indentations, N; nan where no contact is stable."""
    contact = jkr_contact_radius(indentation, work_of_adhesion, radius, modulus)
    return jkr_force_at(contact, work_of_adhesion, radius, modulus)


def jkr_force_at(contact: Array, work_of_adhesion: float, radius: float, modulus: float) -> Array:
    """Return the JKR force at given contact radii, N."""
    pull = math.pi * work_of_adhesion / (2 * modulus)
    return np.asarray(4 * modulus * (contact**3 / (3 * radius) - np.sqrt(pull * contact**3)), dtype=float)


def jkr_contact_under(load: float, work_of_adhesion: float, radius: float, modulus: float) -> float:
    """Return the JKR contact radius under a compressive load (N), m (Johnson, Kendall and Roberts 1971, Eq. 13)."""
    pull = 3 * math.pi * work_of_adhesion * radius
    cube = 3 * radius / (4 * _positive(modulus, "modulus")) * (load + pull + math.sqrt(2 * pull * load + pull**2))
    return float(np.cbrt(cube))


def dmt_curve(
    work_of_adhesion: float, radius: float, modulus: float, *, largest_contact: float, points: int = 200
) -> ContactCurve:
    """Return the DMT unloading curve: Hertz's contact plus the constant attraction 2 pi R w."""
    contact = _falling(largest_contact, 0.0, points)
    force = 4 * modulus * contact**3 / (3 * radius) - 2 * math.pi * radius * work_of_adhesion
    return ContactCurve(contact**2 / radius, force, contact)


def maugis_curve(
    work_of_adhesion: float,
    radius: float,
    modulus: float,
    strength: float,
    *,
    largest_contact: float,
    points: int = 200,
) -> ContactCurve:
    """Return Maugis' unloading curve for a cohesive zone of constant stress ``strength`` (Pa).

    Parametrised by the width of the cohesive zone, for which Maugis' condition is a quadratic in the contact radius:
    nothing is iterated but the two ends of the curve.
    """
    cohesion = maugis_parameter(work_of_adhesion, radius, modulus, strength)
    stiffness = 4 / 3 * modulus
    length = float(np.cbrt(math.pi * work_of_adhesion * radius**2 / stiffness))
    widths = np.geomspace(1e-12, 1e12, 4001)
    contact, _, indentation = _maugis(widths, cohesion)
    first = int(np.argmax(contact <= largest_contact / length))
    last = int(np.argmin(indentation))
    if contact[last] >= contact[first]:
        raise InvalidParameter(
            f"largest_contact = {largest_contact:g} m lies below the last stable contact {contact[last] * length:g} m"
        )
    near = np.linspace(widths[max(last - 1, 0)], widths[min(last + 1, widths.size - 1)], 2001)
    fold = float(near[np.argmin(_maugis(near, cohesion)[2])])
    start = float(np.exp(np.interp(-math.log(largest_contact / length), -np.log(contact), np.log(widths))))
    scaled = _maugis(np.geomspace(start, fold, points), cohesion)
    return ContactCurve(
        indentation=scaled[2] * length**2 / radius,
        force=scaled[1] * math.pi * work_of_adhesion * radius,
        contact_radius=scaled[0] * length,
    )


def pull_off_force_maugis(work_of_adhesion: float, radius: float, modulus: float, strength: float) -> float:
    """Return the greatest tension of Maugis' curve, N: between 3/2 and 2 times pi R w."""
    from scipy.optimize import minimize_scalar

    cohesion = maugis_parameter(work_of_adhesion, radius, modulus, strength)
    logs = np.linspace(-40.0, 40.0, 1601)
    best = logs[np.argmin(_maugis(np.exp(logs), cohesion)[1])]
    lowest = minimize_scalar(
        lambda log: float(_maugis(np.exp(np.array([log])), cohesion)[1][0]),
        bounds=(best - 0.05, best + 0.05),
        method="bounded",
        options={"xatol": 1e-10},
    )
    return -float(lowest.fun) * math.pi * work_of_adhesion * radius


def _maugis(width: Array, cohesion: float) -> tuple[Array, Array, Array]:
    """Return scaled contact radius, force and indentation for width = sqrt(m^2 - 1), m = outer over contact radius."""
    angle = np.arctan(width)
    excess = width**2 / (1 + np.sqrt(1 + width**2))  # m - 1 without cancellation
    opening = np.where(
        width < 0.02,
        4 / 3 * width**3 * (1 - width**2 * (0.4 - width**2 * 9 / 35)),
        width + (width**2 - 1) * angle,
    )
    quadratic = cohesion / 2 * opening
    linear = 4 / 3 * cohesion**2 * (width * angle - excess)
    contact = 2 / (linear + np.sqrt(linear**2 + 4 * quadratic))
    force = contact**3 - cohesion * contact**2 * (width + (1 + width**2) * angle)
    indentation = contact**2 - 4 / 3 * cohesion * contact * width
    return contact, force, indentation


def _falling(largest: float, smallest: float, points: int) -> Array:
    if largest <= smallest:
        raise InvalidParameter(f"largest_contact = {largest:g} m lies below the last stable contact {smallest:g} m")
    return np.linspace(largest, smallest, points)


def _positive(value: float, name: str) -> float:
    if not (value > 0 and math.isfinite(value)):
        raise InvalidParameter(f"{name} = {value!r}: it must be positive and finite")
    return value
