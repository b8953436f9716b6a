"""Limits that end a run, checked on untared values of every sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import StageStatus
from rig.bench import Bench
from rig.errors import Interlock

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits in SI units; forces are magnitudes at the load cell, untared.

    Attributes
    ----------
    compression, tension
        N.
    pressure
        Lowest and highest, Pa gauge; ``None`` without a pressure sensor.
    travel
        Lowest and highest height, m.
    lag
        How late a frame may come, s.
    """

    compression: float
    tension: float
    travel: tuple[float, float]
    pressure: tuple[float, float] | None = None
    lag: float = 0.5


def limits_of(bench: Bench, travel: tuple[float, float], uses_pressure: bool) -> Limits:
    """Return a bench's limits for a run with this travel (m)."""
    pressure = (bench.limits.pressure_low_kPa * 1e3, bench.limits.pressure_high_kPa * 1e3)
    return Limits(
        compression=bench.limits.compression_N,
        tension=bench.limits.tension_N,
        travel=travel,
        pressure=pressure if uses_pressure else None,
        lag=bench.limits.lag_s,
    )


class Interlocks:
    """Raises ``Interlock`` with the value, the limit and the remedy."""

    _TRAVEL_MARGIN = 20e-6

    def __init__(self, limits: Limits) -> None:
        self.limits = limits

    def check_signals(self, force: Array, pressure: Array | None) -> None:
        """Check what the sensors say; called before anything else is done with a frame."""
        high, low = _extremes(force)
        if not (high <= self.limits.compression and low >= -self.limits.tension):
            worst = high if high > self.limits.compression else low
            limit = self.limits.compression if worst > 0 else -self.limits.tension
            raise Interlock(
                f"force {worst:+.3f} N has passed the limit {limit:+g} N (untared). Remedy: drive the stage clear by "
                "hand, look at the load cell, approach more slowly or lower the preload."
            )
        if pressure is None or self.limits.pressure is None:
            return
        lowest, highest = self.limits.pressure
        high, low = _extremes(pressure)
        if not (low >= lowest and high <= highest):
            worst = low if low < lowest else high
            raise Interlock(
                f"pressure {worst / 1e3:+.2f} kPa has left {lowest / 1e3:+g} to {highest / 1e3:+g} kPa. "
                "Remedy: open the vent, check the tubing and the sensor's supply."
            )

    def first_beyond(self, force: Array, pressure: Array | None) -> int:
        """Return the index of the first sample beyond a limit; of the first of all where none is."""
        beyond = ~((force <= self.limits.compression) & (force >= -self.limits.tension))
        if pressure is not None and self.limits.pressure is not None:
            lowest, highest = self.limits.pressure
            beyond |= ~((pressure >= lowest) & (pressure <= highest))
        return int(beyond.argmax())

    def check_motion(self, stage: StageStatus, lag: float) -> None:
        """Check where the stage is and that the data are fresh."""
        low, high = self.limits.travel
        if not low - self._TRAVEL_MARGIN <= stage.position <= high + self._TRAVEL_MARGIN:
            raise Interlock(
                f"stage at {stage.position * 1e3:.4f} mm, outside {low * 1e3:g} to {high * 1e3:g} mm. "
                "Remedy: check the bench's limits and whether the stage is referenced."
            )
        if lag > self.limits.lag:
            raise Interlock(
                f"data come {lag:.2f} s late, {self.limits.lag:g} s are allowed. "
                "Remedy: close other programs on this computer or lengthen frame_ms in the bench."
            )


def _extremes(values: Array) -> tuple[float, float]:
    """Return the highest and the lowest value, NaN if there is one."""
    return float(np.maximum.reduce(values)), float(np.minimum.reduce(values))
