"""How a contact line moves: pinned between two energies, at a finite rate beyond them (adhesion hysteresis)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

FASTEST = 5.0
"""Contact lines do not outrun this, m/s."""

RADIUS_TOLERANCE = 2e-6
"""Allowed error of a contact radius in one step, m, besides a twentieth of its change."""


@dataclass(frozen=True, slots=True)
class ContactLine:
    """The edge of an adhesive contact.

    Attributes
    ----------
    receding, advancing
        Work of adhesion of a receding and an advancing line at zero speed, J/m^2.
    line_speed, rate_exponent
        A receding line needs w = receding (1 + (v / line_speed)^rate_exponent), as polymers do, m/s.
    advancing_speed
        Largest speed of an advancing line, m/s.
    """

    receding: float = 3.7
    advancing: float = 0.2
    line_speed: float = 1.0
    rate_exponent: float = 0.35
    advancing_speed: float = 0.05

    def speed(self, release: float, zipping: float, *, movable: bool = True) -> float:
        """Speed of the line, m/s; positive advances.

        Parameters
        ----------
        release
            Energy release rate of the contact as it is, J/m^2.
        zipping
            What closing it further would cost, J/m^2; negative where the surfaces are pressed into each other.
        movable
            Whether there is room to advance.
        """
        excess = release / self.receding - 1
        if excess > 0.0:
            return -min(self.line_speed * math.pow(excess, 1 / self.rate_exponent), FASTEST)
        lack = 1 - zipping / self.advancing
        if lack <= 0.0 or not movable:
            return 0.0
        return self.advancing_speed * (1.0 if lack >= 1.0 else math.pow(lack, 1 / self.rate_exponent))

    def varied(self, receding: float, advancing: float) -> Self:
        """Return another specimen's line, so many standard deviations away."""
        return replace(
            self,
            receding=self.receding * math.exp(0.03 * receding),
            advancing=self.advancing * math.exp(0.2 * advancing),
        )


def line_error(correction: float, change: float) -> float:
    """Error of a step of the line over what is allowed."""
    return abs(correction) / (RADIUS_TOLERANCE + 0.05 * abs(change))
