"""Calibration records: what turns volts into newtons, and how well that is known.

A record never changes, and every recording carries the whole of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import date
from typing import Any

from drivers.errors import DeviceError


class InvalidCalibration(DeviceError, ValueError):
    """A calibration record is incomplete or impossible."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """A straight line from the recorded unit to the physical one.

    Attributes
    ----------
    id
        What recordings refer to, e.g. ``"GSO-1K-2024-03"``.
    certificate
        Number of the certificate, or the name of the protocol sheet.
    date
        Day of the calibration.
    operator
        Who did it.
    serial
        Serial number of the sensor.
    slope, intercept
        physical = slope * recorded + intercept, in ``unit`` per ``recorded_unit`` and ``unit``.
    residual
        Standard deviation of the calibration points about the line, ``unit``.
    uncertainty
        Relative standard uncertainty (1 sigma) of the slope.
    temperature
        Room temperature at the calibration, degC.
    unit, recorded_unit
        ``"N"`` and ``"V"``, or ``"mV/V"`` for a bridge channel.

    Raises
    ------
    InvalidCalibration
        A text is empty or a placeholder, or a number impossible.
    """

    id: str
    certificate: str
    date: date
    operator: str
    serial: str
    slope: float
    intercept: float
    residual: float
    uncertainty: float
    temperature: float
    unit: str = "N"
    recorded_unit: str = "V"

    def __post_init__(self) -> None:
        for name in ("id", "certificate", "operator", "serial", "unit", "recorded_unit"):
            _check_text(self.id, name, getattr(self, name))
        if not isinstance(self.date, date):
            raise _invalid(self.id, f"date is {self.date!r}, not a day.")
        for name in ("slope", "intercept", "residual", "uncertainty", "temperature"):
            _check_number(self.id, name, getattr(self, name))
        if self.slope == 0:
            raise _invalid(self.id, "slope is 0: every reading would be the same.")
        if self.residual < 0 or not 0 <= self.uncertainty < 1:
            raise _invalid(
                self.id,
                f"residual {self.residual} must not be negative and uncertainty {self.uncertainty} lie in 0...1.",
            )


def _check_text(name: str, field: str, value: Any) -> None:
    if not isinstance(value, str) or not value.strip():
        raise _invalid(name, f"{field} is {value!r}, it must be a text.")
    if value.strip().upper().startswith(("FILL", "TODO", "XXX", "<")):
        raise _invalid(name, f"{field} is still the placeholder {value!r}.")


def _check_number(name: str, field: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _invalid(name, f"{field} is {value!r}, it must be a finite number.")


def _invalid(name: str, message: str) -> InvalidCalibration:
    return InvalidCalibration(f"calibration {name}", message, "copy the values from the certificate.")
