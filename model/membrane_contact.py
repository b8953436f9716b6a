"""What the membrane does where it touches the substrate: the choice the papers leave open.

Lengths in units of R_0, energies per reference area and tensions in units of mu h_0. Every assumption gives the
conditions at the contact line (EML Eqs. 1 and 10; cap and height: Eqs. 8 and 9): where it lies, what ties it to the
free membrane, and the energy release rate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from model.membrane_material import energy, respond
from model.parameters import ContactStretch

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Surface:
    """The substrate by its curvature R_0 / r_b; a flat has curvature zero."""

    curvature: float

    def cosine(self, radius: Array) -> Array:
        """Return the cosine of the slope; kept positive up to the equator."""
        return np.sqrt(np.maximum(1 - (self.curvature * radius) ** 2, 1e-14))

    def height(self, radius: Array) -> Array:
        """Return the height above the apex, never positive."""
        return -self.curvature * radius**2 / (1 + self.cosine(radius))

    def gradient(self, radius: Array) -> Array:
        """Return d height / d radius."""
        return -self.curvature * radius / self.cosine(radius)

    def cap(self, radius: Array) -> Array:
        """Return the volume of the cap inside the contact line (EML Eq. 8)."""
        depth = -self.height(radius)
        return np.pi * depth / 6 * (3 * radius**2 + depth**2)


class EdgeState(NamedTuple):
    """State of the free membrane at the contact line, arrays (n,): u = r - a, Q, P, and p, f that P consists of."""

    a: Array
    u: Array
    Q: Array
    p: Array
    f: Array


class Edge(NamedTuple):
    """Conditions at the contact line. Arrays (n,); derivatives ``.._by`` (n, 4) by u, Q, p and f.

    ``tie`` vanishes where contact and free membrane fit together, ``tangency`` where the membrane leaves at no angle.
    """

    radius: Array
    height: Array
    gradient: Array
    """d height / d u and, times -pi r^2, d cap / d u."""
    tie: Array
    tie_by: Array
    release: Array
    release_by: Array
    tangency: Array
    tangency_by: Array
    peel_angle: Array


class Contact(Protocol):
    """One assumption about the contact."""

    @property
    def sticks(self) -> bool:
        """Whether points in contact stay where they touched."""
        ...

    def edge(self, surface: Surface, state: EdgeState, *, tension_field: bool) -> Edge:
        """Return the conditions at the contact line."""
        ...

    def radius(self, surface: Surface, a: Array, u: Array) -> Array:
        """Return the contact radius at reference radius ``a`` and displacement ``u``."""
        ...


class Line(NamedTuple):
    """A frozen contact at given reference radii, arrays (n,).

    ``radius`` and ``height`` are the place of the line, ``radius_rate`` and ``height_rate`` their derivatives by the
    reference radius, ``released`` is the derivative of the energy stored in contact by the reference area.
    """

    radius: Array
    height: Array
    radius_rate: Array
    height_rate: Array
    released: Array


ContactMap = Callable[[Surface, Array], Line]
"""Takes reference radii of the contact line to the substrate."""


@dataclass(frozen=True, slots=True)
class Frozen:
    """A membrane that sticks where it touches: the line's place follows from its reference radius."""

    line: ContactMap
    sticks: bool = True

    def radius(self, surface: Surface, a: Array, u: Array) -> Array:
        """Return the contact radius; the displacement does not matter."""
        return self.line(surface, a).radius

    def edge(self, surface: Surface, state: EdgeState, *, tension_field: bool) -> Edge:
        """Return the conditions at the contact line."""
        a, u, Q, p, f = state
        line = self.line(surface, a)
        width = -np.log(a)
        P = 0.5 * p * line.radius**2 + f
        N = np.hypot(Q, P)
        cosine, sine = Q / N, P / N
        hoop = line.radius / a
        stretch = respond(N / a, hoop, tension_field=tension_field).stretch
        versine = np.where(cosine > 0, sine**2 / (1 + np.abs(cosine)), 1 - cosine)
        opening = stretch - line.radius_rate + line.radius_rate * versine - sine * line.height_rate
        stored = energy(stretch, hoop, tension_field=tension_field)
        zero, half = np.zeros_like(a), 0.5 * line.radius**2
        by_Q = (stretch * cosine - line.radius_rate) / a
        by_P = (stretch * sine - line.height_rate) / a
        tangent = line.height_rate / line.radius_rate
        return Edge(
            radius=line.radius,
            height=line.height,
            gradient=zero,
            tie=(a + u - line.radius) / width,
            tie_by=np.stack([1 / width, zero, zero, zero], axis=1),
            release=line.released - stored + N / a * opening,
            release_by=np.stack([zero, by_Q, by_P * half, by_P], axis=1),
            tangency=P - tangent * Q,
            tangency_by=np.stack([zero, -tangent, half, np.ones_like(a)], axis=1),
            peel_angle=np.arctan2(P, Q) - np.arctan2(line.height_rate, line.radius_rate),
        )


def frozen(stretch: ContactStretch) -> Frozen:
    """Return one of the assumptions that every point keeps its radius."""
    released = {
        ContactStretch.EML: _mean_stretch,
        ContactStretch.PROJECTED: _local_stretch,
        ContactStretch.UNSTRETCHED: _nothing,
    }[stretch]

    def line(surface: Surface, a: Array) -> Line:
        if surface.curvature == 0:
            return flat_line(a)
        cosine, sine = surface.cosine(a), surface.curvature * a
        return Line(a, surface.height(a), np.ones_like(a), -sine / cosine, released(cosine, sine))

    return Frozen(line)


def flat_line(a: Array) -> Line:
    """Return an unstretched contact on a flat."""
    zero = np.zeros_like(a)
    return Line(a, zero, np.ones_like(a), zero, zero)


def _nothing(cosine: Array, _: Array) -> Array:
    return np.zeros_like(cosine)


def _local_stretch(cosine: Array, _: Array) -> Array:
    return energy(1 / cosine, np.ones_like(cosine))


def _mean_stretch(cosine: Array, sine: Array) -> Array:
    """Return d(a^2 W_2) / d(a^2) with the stretch arcsin(a / r_b) / (a / r_b) of EML Eq. 5."""
    stretch = np.arcsin(np.minimum(sine, 1.0)) / sine
    return energy(stretch, np.ones_like(sine)) + 0.5 * (stretch - stretch**-3) * (1 / cosine - stretch)
