"""Transducer Techniques GSO load cells: recorded volts (or mV/V) to newtons.

Untared: interlocks act on what the cell really carries, fixture included. A tare is the sequence's affair and is kept
apart from the calibration. Compression is positive, tension (adhesion, a hung weight) negative.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from drivers.calibration import Calibration, InvalidCalibration
from drivers.flags import Array, Reading, SensorFlags

_LOADS = ((0.8, SensorFlags.HIGH_LOAD), (1.0, SensorFlags.OVER_RANGE), (1.2, SensorFlags.OVERLOAD))


@dataclass(frozen=True, slots=True)
class LoadCell:
    """One load cell on one channel.

    Attributes
    ----------
    name
        The cell as the operator knows it.
    capacity
        N.
    calibration
        Its record, into N; the slope carries the magnitude, ``compression_positive`` the direction.
    minimum, maximum
        Rails of the channel, in the recorded unit: a sample at or beyond them is clipped.
    compression_positive
        Whether a load that presses on the specimen raises the recorded signal.

    Raises
    ------
    InvalidCalibration
        The record is not one of a force.
    ValueError
        Capacity or rails are impossible.
    """

    name: str
    capacity: float
    calibration: Calibration
    minimum: float = -10.0
    maximum: float = 10.0
    compression_positive: bool = True
    _sound: tuple[float, float] = field(init=False, repr=False, compare=False)
    """Recorded values in between need no closer look."""

    def __post_init__(self) -> None:
        if self.calibration.unit != "N":
            raise InvalidCalibration(
                self.name,
                f"calibration {self.calibration.id} is in {self.calibration.unit}, not N.",
                "use the cell's own.",
            )
        if not (np.isfinite(self.capacity) and self.capacity > 0):
            raise ValueError(f"{self.name}: capacity {self.capacity} N must be positive")
        if not self.minimum < self.maximum:
            raise ValueError(f"{self.name}: minimum {self.minimum} is not below maximum {self.maximum}")
        object.__setattr__(self, "_sound", self._find_sound())

    def convert(self, recorded: Array) -> Reading:
        """Return the untared force (n,) in N and what was wrong; sample by sample, so frames may be cut anyhow."""
        if not recorded.size:
            return Reading(np.empty(0), SensorFlags.NONE)
        low, high = float(np.minimum.reduce(recorded)), float(np.maximum.reduce(recorded))
        if self._sound[0] < low and high < self._sound[1]:
            return Reading(self._force(recorded), SensorFlags.NONE)
        with np.errstate(over="ignore", invalid="ignore"):
            return Reading(self._force(recorded), self._check(low, high))

    def _force(self, recorded: Array) -> Array:
        sign = 1.0 if self.compression_positive else -1.0
        force: Array = recorded * (sign * self.calibration.slope) + sign * self.calibration.intercept
        return force

    def _check(self, low: float, high: float) -> SensorFlags:
        """The extremes tell everything: the conversion is a straight line."""
        if not (math.isfinite(low) and math.isfinite(high)):
            return SensorFlags.INVALID
        load = max(map(abs, self._force(np.array([low, high])).tolist())) / self.capacity
        flags = SensorFlags.NONE
        for limit, flag in _LOADS:
            if load > limit:
                flags |= flag
        if low <= self.minimum or high >= self.maximum:
            flags |= SensorFlags.CLIPPED
        return flags

    def _find_sound(self) -> tuple[float, float]:
        """Return the recorded values between which the load is below the first limit and the rails are not touched."""
        most = (1 - 1e-9) * _LOADS[0][0] * self.capacity
        ends = [(load - self.calibration.intercept) / self.calibration.slope for load in (-most, most)]
        return max(min(ends), self.minimum), min(max(ends), self.maximum)
