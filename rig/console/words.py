"""Quantities and conditions in words an operator reads at a glance."""

from __future__ import annotations

from rig.observe import StepEvent, StepPhase, StepPlan

MINUS = "\N{MINUS SIGN}"

_SHOWN = {"N": (1.0, "N"), "Pa": (1e-3, "kPa"), "m": (1e3, "mm"), "s": (1.0, "s"), "m^3": (1e6, "ml")}


def number(value: float, digits: int, *, sign: bool = False) -> str:
    """Return a number with a true minus sign; ``nan`` is a dash."""
    if value != value:  # noqa: PLR0124 - nan
        return "\N{EN DASH}"
    return f"{value:{'+' if sign else ''}.{digits}f}".replace("-", MINUS)


def quantity(value: float, unit: str, digits: int = 2) -> str:
    """Return an SI value in the unit an operator thinks in: N, kPa, mm, s, ml."""
    scale, shown = _SHOWN.get(unit, (1.0, unit))
    return f"{number(value * scale, digits)} {shown}".rstrip()


def progress(event: StepEvent) -> str:
    """Return how far a step is: ``0.31 of 0.50 N``."""
    scale, shown = _SHOWN.get(event.unit, (1.0, event.unit))
    digits = 1 if event.unit == "s" else 2
    return f"{number(event.value * scale, digits)} of {number(event.target * scale, digits)} {shown}".rstrip()


def condition(plan: StepPlan, last: StepEvent | None) -> str:
    """Return the active step with its condition in words: ``preload 0.31 of 0.50 N``."""
    if last is None or last.phase is not StepPhase.PROGRESS:
        return f"{plan.name}: until {plan.condition}"
    if plan.name == "retract":
        return f"retract: {quantity(last.value, last.unit, 3)}, peak so far {quantity(last.target, last.unit, 3)}"
    return f"{plan.name} {progress(last)}"


def fraction(event: StepEvent | None) -> float:
    """Return how far a step is, 0 to 1; 0 where its progress has no such meaning."""
    if event is None or event.phase is not StepPhase.PROGRESS or event.name == "retract" or not event.target:
        return 0.0
    return min(1.0, max(0.0, event.value / event.target))


def duration(seconds: float) -> str:
    """Return ``0:41`` or ``1:02:03``; tenths below ten seconds."""
    if seconds != seconds or seconds < 0:  # noqa: PLR0124 - nan
        return "\N{EN DASH}"
    whole = int(seconds)
    hours, minutes, rest = whole // 3600, whole // 60 % 60, whole % 60
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
