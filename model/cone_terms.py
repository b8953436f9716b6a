"""The truncated-cone energy of EML Eqs. 1-9 and its derivatives, without dimensions.

Lengths are divided by R_0, forces by k R_0 and energies by k R_0^2 with k = pi h_0 E_m / 6, pressures by
3 k / (pi R_0), volumes by pi R_0^3 / 3. The unknown beside the contact radius rho is not the height but the slope
t = d / (R_0 - r) of the cone: in it every term stays regular where the contact reaches the rim (r -> R_0), which is
where differences of the tabulated energy become unstable (SI Fig. S8).

Every formula is written once and takes floats as well as arrays; only the functions of the sphere need to know which.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

EQUATOR = 1e-8
"""Cosine below which a contact edge counts as lying on the equator, where the slope of the sphere is infinite."""

SERIES_LIMIT = 0.1
_ARCSINE_SERIES = (1 / 6, 3 / 40, 15 / 336, 105 / 3456, 945 / 42240, 10395 / 599040, 135135 / 9676800)

Number = Any
"""A float, or an array of floats."""


class Edge(NamedTuple):
    """What depends on the contact radius alone."""

    radius: Number
    gap: Number
    """1 - rho."""
    drop: Number
    """h, below the apex."""
    slope: Number
    """dh/drho."""
    curvature: Number
    """d2h/drho2."""
    load: Number
    """d/drho of contact stretch minus adhesion."""
    load_slope: Number
    cap: Number
    """V_c."""
    outer: Number
    """1 + rho."""
    area: Number
    """dV/dz."""
    lever: Number
    """dV/drho at constant z is lever * (t + slope)."""
    swell: Number
    """Derivative with respect to t of what the pressure depends on: V, or z if it was measured."""
    shrink: Number
    """The same with respect to rho at constant t, divided by -(t + slope)."""


class State(NamedTuple):
    """Force, pressure and derivatives of the energy at (rho, t)."""

    residual: Number
    """dPi/drho at constant z."""
    residual_t: Number
    residual_radius: Number
    """At constant t."""
    force: Number
    """Compression positive."""
    force_t: Number
    force_radius: Number
    """At constant t."""
    pressure: Number


@dataclass(frozen=True, slots=True)
class Isothermal:
    """Boyle's law: P_0 at the anchor volume (EML Eq. 6)."""

    initial: Number
    atmosphere: Number
    anchor: Number
    """Volume at which the pressure is P_0."""
    offset: Number = 0.0
    """V_0 minus the anchor volume."""

    def at(self, growth: Number) -> tuple[Number, Number]:
        """Return gauge pressure and its derivative, given V - V_0 (the small difference keeps its digits)."""
        change = growth + self.offset
        volume = self.anchor + change
        pressure = (self.initial * self.anchor - self.atmosphere * change) / volume
        return pressure, (-self.atmosphere - pressure) / volume

    def potential(self, growth: float) -> float:
        """Return U_p, up to a constant."""
        relative = (growth + self.offset) / self.anchor
        logarithm = math.log1p(relative)
        return float(self.anchor * (self.atmosphere * (relative - logarithm) - self.initial * logarithm))

    @property
    def neutral_growth(self) -> Number:
        """V - V_0 at which the gauge pressure is zero."""
        return self.anchor * self.initial / self.atmosphere - self.offset


@dataclass(frozen=True, slots=True)
class Vented:
    """A chamber held at P_0."""

    initial: Number


@dataclass(frozen=True)
class Driven:
    """Measured P_a(z): linear between the knots, constant beyond them."""

    position: np.ndarray
    pressure: np.ndarray
    steepness: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        inner = np.diff(self.pressure) / np.diff(self.position)
        object.__setattr__(self, "steepness", np.concatenate(([0.0], inner, [0.0])))

    def at(self, position: Number) -> tuple[Number, Number]:
        """Return gauge pressure and its derivative with respect to z."""
        pressure = np.interp(position, self.position, self.pressure)
        steepness = self.steepness[np.searchsorted(self.position, position, side="right")]
        if isinstance(position, float):
            return float(pressure), float(steepness)
        return pressure, steepness


Gas = Isothermal | Vented | Driven


@dataclass
class Cone:
    """The dimensionless cone model of one scene (floats), or of many alike in kind (arrays).

    ``evaluations`` counts the points at which each term was evaluated.
    """

    adhesion: Number
    """12 omega_a / (E_m h_0)."""
    sphere: Number | None
    """r_b / R_0; None on a flat."""
    start_radius: Number
    start_position: Number
    gas: Gas
    contact_stretch: bool
    evaluations: dict[str, int] = field(default_factory=dict)

    @cached_property
    def start_edge(self) -> Edge:
        """The contact edge at r_i."""
        return self.edge(self.start_radius)

    def edge(self, radius: Number) -> Edge:
        """Return what depends on the contact radius alone; a flat needs neither cap nor contact stretch."""
        gap, outer = 1 - radius, 1 + radius
        square = radius * radius
        area, lever = outer + square, (outer + radius) * gap
        driven = isinstance(self.gas, Driven)
        volume = (outer, area, lever, gap if driven else gap * area, 1.0 if driven else 3 * square)
        load = -self.adhesion * radius
        if self.sphere is None:
            return Edge(radius, gap, 0.0, 0.0, 0.0, load, -self.adhesion, 0.0, *volume)
        self._count("spherical cap", radius)
        array = isinstance(radius, np.ndarray)
        u = radius / self.sphere
        cosine = (np.sqrt if array else math.sqrt)((1 - u) * (1 + u))
        cosine = np.maximum(cosine, EQUATOR) if array else max(cosine, EQUATOR)
        drop, slope = radius * u / (1 + cosine), u / cosine
        curvature = 1 / (self.sphere * cosine**3)
        cap = drop * (3 * square + drop * drop) / 2
        if not self.contact_stretch:
            return Edge(radius, gap, drop, slope, curvature, load, -self.adhesion, cap, *volume)
        self._count("contact stretch", radius)
        stretch, stretch_slope = _contact_stretch(u, cosine, arc_excess_array(u) if array else arc_excess(u))
        load, load_slope = load + radius * stretch, stretch_slope - self.adhesion
        return Edge(radius, gap, drop, slope, curvature, load, load_slope, cap, *volume)

    def residual(self, edge: Edge, t: Number) -> tuple[Number, Number]:
        """Return dPi/drho at constant z and its derivative with respect to t."""
        self._count("elastic energy", t)
        energy, energy_t, energy_tt = stretch_energy(t)
        tau = t + edge.slope
        elastic = edge.load - 2 * edge.radius * energy
        if self.unpressurised:
            return (
                elastic + tau * edge.outer * energy_t,
                edge.gap * energy_t + tau * edge.outer * energy_tt,
            )
        pressure, rate = self._pressure(edge, t)
        pull = edge.lever * pressure
        return (
            elastic + tau * (edge.outer * energy_t - pull),
            edge.gap * energy_t - pull + tau * (edge.outer * energy_tt - edge.lever * edge.swell * rate),
        )

    def state(self, edge: Edge, t: Number) -> State:
        """Return force, pressure and all first derivatives of force and residual."""
        self._count("elastic energy", t)
        energy, energy_t, energy_tt = stretch_energy(t)
        radius, outer, curvature = edge.radius, edge.outer, edge.curvature
        tau = t + edge.slope
        residual = edge.load - 2 * radius * energy
        residual_radius = (tau + outer * curvature) * energy_t - 2 * energy + edge.load_slope
        if self.unpressurised:
            return State(
                residual + tau * outer * energy_t,
                edge.gap * energy_t + tau * outer * energy_tt,
                residual_radius,
                -outer * energy_t,
                -outer * energy_tt,
                -energy_t,
                0.0,
            )
        pressure, rate = self._pressure(edge, t)
        pressure_t, pressure_radius = rate * edge.swell, -rate * edge.shrink * tau
        pull = edge.lever * pressure
        return State(
            residual + tau * (outer * energy_t - pull),
            edge.gap * energy_t - pull + tau * (outer * energy_tt - edge.lever * pressure_t),
            residual_radius - pressure * (1 - 4 * radius) * tau - pull * curvature - pressure_radius * edge.lever * tau,
            pressure * edge.area - outer * energy_t,
            pressure_t * edge.area - outer * energy_tt,
            pressure * (outer + radius) + pressure_radius * edge.area - energy_t,
            pressure,
        )

    def pressure(self, edge: Edge, t: float) -> float:
        """Return the gauge pressure."""
        return 0.0 if self.unpressurised else float(self._pressure(edge, t)[0])

    def position(self, edge: Edge, t: Number) -> Number:
        """Return z of the rim above the apex."""
        return edge.gap * t - edge.drop

    def growth(self, edge: Edge, t: Number) -> Number:
        """Return V - V_0, EML Eq. 7."""
        return edge.gap * edge.area * t - edge.cap

    def potential(self, edge: Edge, t: float) -> float:
        """Return Pi (EML Eq. 1) up to a constant; floats only, not for a measured pressure."""
        radius = edge.radius
        energy = (1 + radius) * edge.gap * stretch_energy(t)[0] - self.adhesion * radius**2 / 2
        if self.sphere is not None and self.contact_stretch and radius > 0:
            energy += contact_energy(radius, self.sphere)
        if isinstance(self.gas, Isothermal):
            return float(energy + self.gas.potential(self.growth(edge, t)))
        if isinstance(self.gas, Vented) and self.gas.initial != 0:
            return float(energy - self.gas.initial * self.growth(edge, t))
        return float(energy)

    @cached_property
    def unpressurised(self) -> bool:
        """Whether the chamber is open to the room: no gas term is evaluated at all."""
        return isinstance(self.gas, Vented) and isinstance(self.gas.initial, float) and self.gas.initial == 0

    def _pressure(self, edge: Edge, t: Number) -> tuple[Number, Number]:
        """Return the gauge pressure and its rate with the volume, or with z if it was measured."""
        gas = self.gas
        if isinstance(gas, Vented):
            return gas.initial, 0.0
        self._count("chamber gas", t)
        if isinstance(gas, Driven):
            return gas.at(self.position(edge, t))
        return gas.at(edge.swell * t - edge.cap)

    def _count(self, term: str, where: Number) -> None:
        self.evaluations[term] = self.evaluations.get(term, 0) + (where.size if isinstance(where, np.ndarray) else 1)


def stretch_energy(t: Number) -> tuple[Number, Number, Number]:
    """Return (lambda - 1 / lambda)^2 with lambda^2 = 1 + t^2 (EML Eqs. 2-4) and its first two derivatives."""
    x = t * t
    y = 1 / (1 + x)
    xy = x * y
    twice = (xy + xy) * y
    return x * xy, twice * t * (2 + x), twice * y * (6 + x * (3 + x))


def _contact_stretch(u: Number, cosine: Number, excess: Number) -> tuple[Number, Number]:
    """Return X = d(u^2 w_2)/du / u and d(u X)/du with w_2 = (lambda_2 - 1 / lambda_2)^2, EML Eq. 5.

    ``excess`` is lambda_2 - 1; its logarithmic derivative q and that of q are formed without cancellation.
    """
    stretch = 1 + excess
    strain = excess * (2 + excess) / stretch
    strain_rate = 1 + 1 / stretch**2
    q = u**2 / (cosine * (1 + cosine)) - excess
    q_rate = u**2 / cosine**3 - q
    value = 2 * strain * (strain + strain_rate * q)
    rate = 2 * (strain_rate * q) ** 2 + 2 * strain * (
        2 * strain_rate * q + strain_rate * q_rate - 2 * q**2 / stretch**3
    )
    return value, value + rate


def contact_energy(radius: float, sphere: float) -> float:
    """Return W_2 (EML Eq. 4), dimensionless."""
    excess = arc_excess(radius / sphere)
    return (radius * excess * (2 + excess) / (1 + excess)) ** 2


def arc_excess(u: float) -> float:
    """Return asin(u) / u - 1 to full relative accuracy."""
    return math.asin(u) / u - 1 if u > SERIES_LIMIT else _arc_series(u * u)


def arc_excess_array(u: np.ndarray) -> np.ndarray:
    """Return asin(u) / u - 1 to full relative accuracy, element by element."""
    large = np.maximum(u, SERIES_LIMIT)
    result: np.ndarray = np.where(u > SERIES_LIMIT, np.arcsin(large) / large - 1, _arc_series(np.minimum(u, 1.0) ** 2))
    return result


def _arc_series(x: Number) -> Number:
    total = 0.0
    for coefficient in reversed(_ARCSINE_SERIES):
        total = (total + coefficient) * x
    return total
