"""What the membrane does where it touches the substrate: the choice the papers leave open.

Lengths in units of R_0, energies per reference area in units of mu h_0. A contact map takes the reference radius of
the contact line to its place on the substrate and says how much stored energy peeling sets free.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.membrane_material import energy

Array = NDArray[np.float64]


class ContactStretch(StrEnum):
    """How the membrane is stretched where it is in contact. On a flat all but friction's absence agree."""

    EML = "eml"
    """W_2 of EML Eq. 5: every point keeps its radius; stored is the energy of one mean meridional stretch."""
    PROJECTED = "projected"
    """Perfect stick, every point vertically below its place in the flat membrane."""
    UNSTRETCHED = "unstretched"
    """Every point keeps its radius, nothing is stored (SI Eq. S8)."""


class Contact(NamedTuple):
    """The contact line at given reference radii, arrays (n,).

    ``radius`` and ``height`` are its place, ``radius_rate`` and ``height_rate`` their derivatives by the reference
    radius, ``released`` is the derivative of the energy stored in contact by the reference area.
    """

    radius: Array
    height: Array
    radius_rate: Array
    height_rate: Array
    released: Array


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

    def cap(self, radius: Array) -> Array:
        """Return the volume of the cap inside the contact line (EML Eq. 8)."""
        depth = -self.height(radius)
        return np.pi * depth / 6 * (3 * radius**2 + depth**2)


ContactMap = Callable[[Surface, Array], Contact]
"""Takes reference radii of the contact line to the substrate."""


def contact_map(stretch: ContactStretch) -> ContactMap:
    """Return the map of the contact line for one of the assumptions."""
    released = {
        ContactStretch.EML: _mean_stretch,
        ContactStretch.PROJECTED: _local_stretch,
        ContactStretch.UNSTRETCHED: _nothing,
    }[stretch]

    def at(surface: Surface, a: Array) -> Contact:
        if surface.curvature == 0:
            return _flat(a)
        cosine, sine = surface.cosine(a), surface.curvature * a
        return Contact(a, surface.height(a), np.ones_like(a), -sine / cosine, released(cosine, sine))

    return at


def _flat(a: Array) -> Contact:
    zero = np.zeros_like(a)
    return Contact(a, zero, np.ones_like(a), zero, zero)


def _nothing(cosine: Array, _: Array) -> Array:
    return np.zeros_like(cosine)


def _local_stretch(cosine: Array, _: Array) -> Array:
    return energy(1 / cosine, np.ones_like(cosine))


def _mean_stretch(cosine: Array, sine: Array) -> Array:
    """Return d(a^2 W_2) / d(a^2) with the stretch arcsin(a / r_b) / (a / r_b) of EML Eq. 5."""
    stretch = np.arcsin(np.minimum(sine, 1.0)) / sine
    return energy(stretch, np.ones_like(sine)) + 0.5 * (stretch - stretch**-3) * (1 / cosine - stretch)
