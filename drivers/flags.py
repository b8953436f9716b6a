"""What can be wrong with a sensor's reading, and how an operator is told."""

from __future__ import annotations

from enum import IntFlag
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.errors import SensorFault

Array = NDArray[np.float64]


class SensorFlags(IntFlag):
    """Everything that was seen in a block of samples. 0 is a sound reading; a higher bit is worse."""

    NONE = 0
    HIGH_LOAD = 1
    """Beyond 80 % of the load cell's capacity."""
    OVER_RANGE = 2
    """Outside the calibrated range (100 % of capacity, 10...90 % of supply); the numbers are kept."""
    OVERLOAD = 4
    """Beyond 120 % of the load cell's capacity: stop at once."""
    CLIPPED = 8
    """At the rails of the channel or of the sensor's output: the true value may be anything beyond."""
    SUPPLY_STEP = 16
    """The supply has just jumped: until its average has followed, the pressure is a little off."""
    SUPPLY_RANGE = 32
    """Supply outside 4.75...5.25 V: not converted."""
    SUPPLY_LOST = 64
    """No supply, or its wire is open: not converted."""
    OPEN_WIRE = 128
    """The signal sits still where an open input sits: not converted."""
    WIRING = 256
    """The signal is where no live sensor can put it: not converted."""
    INVALID = 512
    """The recorded value is not a number."""

    def describe(self) -> str:
        """Return what is wrong, worst first, in the operator's words; ``"sound"`` if nothing is."""
        texts = [_TEXTS[flag] for flag in sorted(SensorFlags, reverse=True) if flag in self]
        return "; ".join(texts) or "sound"

    @property
    def faulty(self) -> bool:
        """Whether the run must end: anything but a high load, the end of the calibrated range, a step of the supply."""
        return bool(self & ~(SensorFlags.HIGH_LOAD | SensorFlags.OVER_RANGE | SensorFlags.SUPPLY_STEP))


_TEXTS = {
    SensorFlags.HIGH_LOAD: "beyond 80 % of capacity",
    SensorFlags.OVER_RANGE: "outside the calibrated range",
    SensorFlags.OVERLOAD: "overloaded, beyond 120 % of capacity",
    SensorFlags.CLIPPED: "saturated",
    SensorFlags.SUPPLY_STEP: "supply voltage has jumped",
    SensorFlags.SUPPLY_RANGE: "supply voltage outside 4.75 to 5.25 V",
    SensorFlags.SUPPLY_LOST: "supply lost",
    SensorFlags.OPEN_WIRE: "signal wire open",
    SensorFlags.WIRING: "not the signal of a live sensor",
    SensorFlags.INVALID: "not a number",
}

_REMEDIES = {
    SensorFlags.HIGH_LOAD: "reduce the load.",
    SensorFlags.OVER_RANGE: "stay within the sensor's range.",
    SensorFlags.OVERLOAD: "unload the cell, then check its zero and calibration.",
    SensorFlags.CLIPPED: "reduce the load or widen the channel's range; check the wiring.",
    SensorFlags.SUPPLY_STEP: "check the 5 V supply.",
    SensorFlags.SUPPLY_RANGE: "check the 5 V supply.",
    SensorFlags.SUPPLY_LOST: "check the 5 V supply and its wire to the DAQ.",
    SensorFlags.OPEN_WIRE: "check the wire from the sensor's output to the DAQ.",
    SensorFlags.WIRING: "check the sensor's supply and output wires.",
    SensorFlags.INVALID: "check the DAQ.",
}


class Reading(NamedTuple):
    """A converted block: values (n,) in SI units and everything that was wrong in it."""

    values: Array
    flags: SensorFlags


def raise_for(device: str, flags: SensorFlags) -> None:
    """Raise ``SensorFault`` if the reading is faulty; warnings pass.

    Parameters
    ----------
    device
        The sensor as the operator knows it.
    """
    if flags.faulty:
        worst = max(flag for flag in SensorFlags if flag in flags)
        raise SensorFault(device, f"{flags.describe()}.", _REMEDIES[worst])
