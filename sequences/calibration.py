"""Calibrations: load cell against dead weights, compliance against a rigid stop, zero of the pressure sensor."""

from __future__ import annotations

from collections.abc import Sequence

from sequences.frame import Frame
from sequences.step import Apparatus, Step, Steps, by_hand, rest, travel

WEIGH = "weigh"
"""First word of the steps in which a known mass hangs still."""


def weighing_order(masses: Sequence[float]) -> list[float]:
    """Return the masses in the order they are hung: up and down again, so that hysteresis shows."""
    return [*masses, *reversed(masses[:-1])]


def dead_weights(apparatus: Apparatus, masses: Sequence[float], seconds: float) -> list[Step]:
    """Return the steps of a load cell calibration: hang each mass (kg), confirm, record; up and down again."""

    def hang_and_weigh(number: int, mass: float) -> list[Step]:
        load = f"{mass * 1e3:g} g" + (" going down" if number >= len(masses) else "")
        request = f"Hang {mass * 1e3:g} g on the gripper" if mass else "Take every weight off the gripper"
        return [
            by_hand(apparatus, f"hang {load}", "the operator goes on", f"{request}, wait until it is still"),
            Step(f"{WEIGH} {load}", f"{seconds:g} s at rest", lambda frame: rest(apparatus, seconds, frame)),
        ]

    order = weighing_order(masses)
    return [step for number, mass in enumerate(order) for step in hang_and_weigh(number, mass)]


def pressure_zero(apparatus: Apparatus, seconds: float) -> list[Step]:
    """Return the steps of a pressure zero: open the sensor's port to the room, confirm, average."""

    def average(frame: Frame) -> Steps:
        return rest(apparatus, seconds, frame)

    return [
        by_hand(apparatus, "open", "the operator goes on", "Open the sensor's port to the room"),
        Step("zero", f"{seconds:g} s at rest", average),
    ]


def unload(apparatus: Apparatus, speed: float, distance: float) -> Step:
    """Return the step that backs away from a rigid stop (m/s, m), slowly enough to see force against travel."""

    def act(frame: Frame) -> Steps:
        target = min(frame.stage.position + distance, apparatus.stage.travel[1])
        return travel(apparatus, target, speed, "unload", frame)

    return Step("unload", f"{distance * 1e6:g} um further up, clear of the stop", act)
