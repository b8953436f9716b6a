"""Calibration records: what turns volts into newtons, and how well that is known.

A record never changes. Every run refers to it by its id, and its digest betrays a value edited after the fact.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from datetime import date
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drivers.errors import DeviceError

_FEWEST_WEIGHTS = 5


class InvalidCalibration(DeviceError, ValueError):
    """A calibration record is incomplete, impossible or has been edited."""


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

    @property
    def digest(self) -> str:
        """SHA-256 of the whole record, in hexadecimal digits."""
        text = json.dumps(self.as_mapping(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    def as_mapping(self) -> dict[str, str | float]:
        """Return the record as text and numbers, for files."""
        return {**asdict(self), "date": self.date.isoformat()}

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Calibration:
        """Build the record from a file's table; a ``digest`` in it must be the record's own.

        Raises
        ------
        InvalidCalibration
            A key is missing or unknown, a value impossible, or the digest of another record.
        """
        record = dict(mapping)
        name = str(record.get("id", "without id"))
        digest = record.pop("digest", None)
        known = {field.name for field in fields(cls)}
        optional = {"unit", "recorded_unit"}
        if unknown := sorted(record.keys() - known):
            raise _invalid(name, f"unknown key {unknown[0]!r}; known are {', '.join(sorted(known))}.")
        if missing := sorted(known - optional - record.keys()):
            raise _invalid(name, f"{missing[0]} is missing.")
        record["date"] = _day(name, record["date"])
        calibration = cls(**{key: _plain(value) for key, value in record.items()})
        if digest is not None and digest != calibration.digest:
            raise _invalid(
                name,
                f"its values do not belong to digest {str(digest)[:12]}...: the record has been edited.",
                "restore the values of the certificate, or make a new record with a new id.",
            )
        return calibration

    @classmethod
    def from_points(cls, recorded: ArrayLike, applied: ArrayLike, **record: Any) -> Calibration:
        """Fit a record to readings under known loads (at least five, up and down).

        Parameters
        ----------
        recorded, applied
            Readings (n,) in ``recorded_unit`` and loads (n,) in ``unit``; a hung weight is a negative load.
        record
            The remaining fields; ``uncertainty`` is the weights' own and is combined with the fit's.
        """
        x, y = np.asarray(recorded, float), np.asarray(applied, float)
        name = str(record.get("id", "without id"))
        if x.shape != y.shape or x.ndim != 1 or len(np.unique(y)) < _FEWEST_WEIGHTS:
            raise _invalid(name, f"a fit needs at least {_FEWEST_WEIGHTS} different loads and a reading for each.")
        spread = x - x.mean()
        slope = float(spread @ y / (spread @ spread))
        intercept = float(y.mean() - slope * x.mean())
        residual = float(np.sqrt(np.sum((y - slope * x - intercept) ** 2) / (len(x) - 2)))
        fit = residual / math.sqrt(spread @ spread) / abs(slope)
        uncertainty = math.hypot(fit, record.pop("uncertainty", 0.0))
        return cls(slope=slope, intercept=intercept, residual=residual, uncertainty=uncertainty, **record)


def _plain(value: Any) -> Any:
    """Whole numbers of a file are numbers like any other, so that 1 and 1.0 have one digest."""
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _day(name: str, value: Any) -> date:
    if isinstance(value, str):
        try:
            return date.fromisoformat(value)
        except ValueError:
            raise _invalid(name, f"date {value!r} is not of the form 2024-03-31.") from None
    return (
        value if type(value) is not date and not isinstance(value, date) else date(value.year, value.month, value.day)
    )


def _check_text(name: str, field: str, value: Any) -> None:
    if not isinstance(value, str) or not value.strip():
        raise _invalid(name, f"{field} is {value!r}, it must be a text.")
    if value.strip().upper().startswith(("FILL", "TODO", "XXX", "<")):
        raise _invalid(name, f"{field} is still the placeholder {value!r}.")


def _check_number(name: str, field: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _invalid(name, f"{field} is {value!r}, it must be a finite number.")


def _invalid(name: str, message: str, remedy: str = "copy the values from the certificate.") -> InvalidCalibration:
    return InvalidCalibration(f"calibration {name}", message, remedy)
