"""The raw channels of a run to force and pressure, and whether they can be believed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.flags import SensorFlags, raise_for
from drivers.force import LoadCell

if TYPE_CHECKING:
    from drivers.pressure import HoneywellHSC

Array = NDArray[np.float64]


class SensorConverter:
    """Converts frames of the channels ``force`` [, ``pressure``, ``supply``], in that order."""

    def __init__(self, cell: LoadCell, sensor: HoneywellHSC | None) -> None:
        self._cell = cell
        self._sensor = sensor
        self._force_flags = SensorFlags.NONE
        self._pressure_flags = SensorFlags.NONE

    def convert(self, volts: Array) -> tuple[Array, Array | None]:
        """Return force (N, untared, compression positive) and pressure (Pa gauge) or ``None``."""
        force, self._force_flags = self._cell.convert(volts[0])
        if self._sensor is None:
            return force, None
        pressure, self._pressure_flags = self._sensor.convert(volts[1], volts[2])
        return force, pressure

    def check(self) -> None:
        """Refuse the last frame if it cannot be true.

        Raises
        ------
        SensorFault
            Names the sensor, what is wrong and the remedy.
        """
        if self._force_flags or self._pressure_flags:
            raise_for("load cell", self._force_flags)
            raise_for("pressure sensor", self._pressure_flags)
