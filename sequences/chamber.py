"""Tests of the chamber alone, closed and out of contact: its volume (Boyle) and its leak."""

from __future__ import annotations

from collections.abc import Sequence

from sequences.frame import Frame
from sequences.pressurize import Chamber, Pressurizer
from sequences.step import Apparatus, Step, Steps, by_hand, rest

CLOSE = "Open the chamber to the room, then close the gripper's mouth with the plate"


def volume(apparatus: Apparatus, chamber: Chamber, strokes: Sequence[float], settle: float) -> list[Step]:
    """Return the steps of a volume test: the pump moves by each stroke (m^3) in turn and rests."""

    def stroke(number: int, amount: float) -> Step:
        def act(frame: Frame) -> Steps:
            name = f"stroke {number}"
            frame = yield from Pressurizer(apparatus, chamber, 0.0, name).dispense(amount, frame)
            return (yield from rest(apparatus, settle, frame))

        return Step(f"stroke {number}", f"{amount * 1e6:+g} ml moved and {settle:g} s at rest", act)

    return [*_closed(apparatus), *(stroke(number, amount) for number, amount in enumerate(strokes, 1))]


def leak(apparatus: Apparatus, chamber: Chamber, pressure: float, tolerance: float, hold: float) -> list[Step]:
    """Return the steps of a leak test: bring the chamber to a pressure (Pa), hold the pump still, watch, and let go."""

    def pressurize(frame: Frame) -> Steps:
        return Pressurizer(apparatus, chamber, tolerance, "pressurize").bring_to(pressure, frame)

    def relieve(frame: Frame) -> Steps:
        return Pressurizer(apparatus, chamber, max(tolerance, 100.0), "relieve").bring_to(0.0, frame)

    return [
        *_closed(apparatus),
        Step("pressurize", f"P_a = {pressure / 1e3:+g} kPa within {tolerance / 1e3:g} kPa", pressurize),
        _rest(apparatus, "hold", hold),
        Step("relieve", "P_a = 0 kPa", relieve),
    ]


def _closed(apparatus: Apparatus) -> list[Step]:
    return [by_hand(apparatus, "close", "the operator goes on", CLOSE), _rest(apparatus, "tare", 2.0)]


def _rest(apparatus: Apparatus, name: str, seconds: float) -> Step:
    return Step(name, f"{seconds:g} s at rest", lambda frame: rest(apparatus, seconds, frame))
