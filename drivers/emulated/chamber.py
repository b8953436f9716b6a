"""The gas behind the membrane: a fixed amount of air in a volume that the syringe and the membrane change."""

from __future__ import annotations

import math
from dataclasses import dataclass

ATMOSPHERE = 101_300.0
"""Pressure of the room, Pa absolute."""


@dataclass(frozen=True, slots=True)
class Chamber:
    """Chamber, tubing and syringe as they really are.

    Attributes
    ----------
    volume
        V_0, m^3: all the gas at rest, the membrane flat.
    vented
        Open to the room: the gauge pressure is zero whatever happens.
    leak_time
        Time constant with which a gauge pressure leaks away at constant volume, s; infinite is tight.
    tubing_lag
        Time constant of the line from the chamber to the sensor, s.
    syringe_diameter
        True inner diameter of the syringe, m.
    """

    volume: float = 7.2e-6
    vented: bool = False
    leak_time: float = 3000.0
    tubing_lag: float = 0.05
    syringe_diameter: float = 14.43e-3

    def pressure(self, amount: float, change: float) -> float:
        """Gauge pressure, Pa, by Boyle's law.

        Parameters
        ----------
        amount
            Gas in the chamber over the gas that fills V_0 at room pressure.
        change
            Gas volume minus V_0, m^3.
        """
        return 0.0 if self.vented else ATMOSPHERE * (amount * self.volume / (self.volume + change) - 1.0)

    def leaked(self, amount: float, pressure: float, duration: float) -> float:
        """Amount of gas after a leak of ``duration`` seconds at a gauge pressure."""
        return amount - pressure / ATMOSPHERE * duration / self.leak_time

    def sensed(self, sensed: float, before: float, after: float, duration: float) -> float:
        """Pressure at the sensor after the chamber's has gone from ``before`` to ``after`` in a straight line."""
        slope = (after - before) / duration
        lagging = self.tubing_lag * slope
        return after - lagging + (sensed - before + lagging) * math.exp(-duration / self.tubing_lag)
