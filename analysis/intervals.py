"""Interval arithmetic on printed numbers: what a table's digits allow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import ROUND_HALF_UP, Decimal
from typing import Self


@dataclass(frozen=True, slots=True)
class Interval:
    """All values between ``low`` and ``high``."""

    low: float
    high: float

    @classmethod
    def printed(cls, text: str) -> Self:
        """Return what a printed number stands for: half a unit of its last digit either way."""
        half = 0.5 * 10.0 ** -decimals(text)
        return cls(float(text) - half, float(text) + half)

    @classmethod
    def exactly(cls, value: float) -> Self:
        """Return an interval of no width."""
        return cls(value, value)

    def __add__(self, other: Interval) -> Interval:
        return Interval(self.low + other.low, self.high + other.high)

    def __mul__(self, other: Interval | float) -> Interval:
        second = Interval.exactly(other) if isinstance(other, int | float) else other
        products = [a * b for a in (self.low, self.high) for b in (second.low, second.high)]
        return Interval(min(products), max(products))

    def __truediv__(self, other: Interval | float) -> Interval:
        second = Interval.exactly(other) if isinstance(other, int | float) else other
        if second.low <= 0 <= second.high:
            raise ZeroDivisionError(f"division by an interval that holds zero: {second.low:g} to {second.high:g}")
        return self * Interval(1 / second.high, 1 / second.low)

    def overlaps(self, other: Interval) -> bool:
        """Whether the two have a value in common."""
        return self.low <= other.high and other.low <= self.high


def mean(intervals: Sequence[Interval]) -> Interval:
    """Return the mean of several intervals."""
    total = intervals[0]
    for interval in intervals[1:]:
        total = total + interval
    return total / len(intervals)


def decimals(text: str) -> int:
    """Return how many digits follow the point of a printed number."""
    return len(text.partition(".")[2])


def as_printed(value: float, like: str) -> str:
    """Return a value rounded (half up) to as many digits as ``like`` shows."""
    return str(Decimal(repr(value)).quantize(Decimal(1).scaleb(-decimals(like)), rounding=ROUND_HALF_UP))
