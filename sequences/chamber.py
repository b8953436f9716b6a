"""Tests of the chamber alone, closed and out of contact: its volume (Boyle) and its leak."""

from __future__ import annotations

from collections.abc import Sequence

from sequences.frame import Frame
from sequences.pressurize import Chamber, Pressurizer
from sequences.step import Apparatus, Step, Steps, rest


def volume(apparatus: Apparatus, chamber: Chamber, strokes: Sequence[float], settle: float) -> list[Step]:
    """Return the steps of a volume test: the pump moves by each stroke (m^3) in turn and rests."""

    def stroke(amount: float) -> Step:
        def act(frame: Frame) -> Steps:
            gas = Pressurizer(apparatus, chamber, 0.0, "stroke")
            frame = yield from gas.dispense(amount, frame)
            return (yield from rest(apparatus, settle, frame))

        return Step("stroke", f"{amount * 1e6:+g} ml, then {settle:g} s at rest", act)

    return [_rest(apparatus, "tare", 2.0), *(stroke(amount) for amount in strokes)]


def leak(apparatus: Apparatus, chamber: Chamber, pressure: float, tolerance: float, hold: float) -> list[Step]:
    """Return the steps of a leak test: bring the chamber to a pressure (Pa), hold the pump still, watch, and let go."""

    def pressurize(frame: Frame) -> Steps:
        return Pressurizer(apparatus, chamber, tolerance, "pressurize").bring_to(pressure, frame)

    def relieve(frame: Frame) -> Steps:
        return Pressurizer(apparatus, chamber, max(tolerance, 100.0), "relieve").bring_to(0.0, frame)

    return [
        _rest(apparatus, "tare", 2.0),
        Step("pressurize", f"P_a = {pressure / 1e3:+g} kPa", pressurize),
        _rest(apparatus, "hold", hold),
        Step("relieve", "P_a = 0", relieve),
    ]


def _rest(apparatus: Apparatus, name: str, seconds: float) -> Step:
    return Step(name, f"{seconds:g} s at rest", lambda frame: rest(apparatus, seconds, frame))
