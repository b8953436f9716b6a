"""Numbers with their standard uncertainty, unit and reason."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from analysis.errors import FeatureMissing

if TYPE_CHECKING:
    import pandas as pd

DISPLAY = {"m": ("mm", 1e3), "Pa": ("kPa", 1e-3), "J": ("mJ", 1e3), "m^2": ("cm²", 1e4), "m^3": ("mL", 1e6)}
"""Units people read, by SI unit, with the factor."""

SMALL = 1e-3
"""Numbers below it are written with an exponent."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """One measured number.

    Attributes
    ----------
    value, uncertainty
        In ``unit``; the uncertainty is one standard deviation.
    unit
        SI unit.
    explanation
        What the number is and how it was found.
    budget
        Standard uncertainty by source, same unit; their squares add up to that of ``uncertainty``.
    """

    value: float
    uncertainty: float
    unit: str
    explanation: str = ""
    budget: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        unit, factor = DISPLAY.get(self.unit, (self.unit, 1.0))
        return f"{with_uncertainty(self.value * factor, self.uncertainty * factor)} {unit}".strip()


def with_uncertainty(value: float, uncertainty: float) -> str:
    """Write a value rounded to two significant digits of its uncertainty; very small ones with an exponent."""
    if not math.isfinite(value):
        return "–"
    if not math.isfinite(uncertainty) or uncertainty <= 0:
        return f"{value:.5g}"
    largest = max(abs(value), uncertainty)
    if largest < SMALL:
        exponent = math.floor(math.log10(largest))
        return f"({with_uncertainty(value / 10.0**exponent, uncertainty / 10.0**exponent)})e{exponent}"
    decimals = 1 - math.floor(math.log10(uncertainty))
    if decimals < 0:
        return f"{round(value, decimals):.0f} ± {round(uncertainty, decimals):.0f}"
    if decimals > 9:
        return f"{value:.5g} ± {uncertainty:.2g}"
    return f"{value:.{decimals}f} ± {uncertainty:.{decimals}f}"


class Features(Mapping[str, Quantity]):
    """What was measured, in order, and what was not, with the reason.

    Keys carry the unit: ``pull_off_force_N``, ``pull_off_distance_m``.
    """

    def __init__(self, found: Mapping[str, Quantity], missing: Mapping[str, str] | None = None) -> None:
        self._found = dict(found)
        self.missing = dict(missing or {})

    def __getitem__(self, name: str) -> Quantity:
        if name in self.missing:
            raise FeatureMissing(f"{name}: {self.missing[name]}")
        return self._found[name]

    def __contains__(self, name: object) -> bool:
        return name in self._found

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)

    def value(self, name: str) -> float:
        """Return the value, or ``nan`` where the feature is missing."""
        return self._found[name].value if name in self._found else math.nan

    def uncertainty(self, name: str) -> float:
        """Return the standard uncertainty, or ``nan`` where the feature is missing."""
        return self._found[name].uncertainty if name in self._found else math.nan

    def as_json(self) -> dict[str, Any]:
        """Return values by name, then ``uncertainty``, ``budget`` and ``missing``; no finite number is null."""
        return {
            **{name: finite(quantity.value) for name, quantity in self.items()},
            "uncertainty": {name: finite(quantity.uncertainty) for name, quantity in self.items()},
            "budget": {
                name: {source: finite(part) for source, part in quantity.budget.items()}
                for name, quantity in self.items()
                if quantity.budget
            },
            "missing": dict(self.missing),
        }

    def frame(self) -> pd.DataFrame:
        """Return one row per feature: value, uncertainty, unit, explanation."""
        import pandas as pd

        rows = [(name, q.value, q.uncertainty, q.unit, q.explanation) for name, q in self.items()]
        return pd.DataFrame(rows, columns=["feature", "value", "uncertainty", "unit", "explanation"]).set_index(
            "feature"
        )


def finite(number: float) -> float | None:
    """Return the number, or ``None`` where JSON has no word for it."""
    return float(number) if math.isfinite(number) else None
