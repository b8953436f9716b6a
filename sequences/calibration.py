"""Calibrations: load cell against dead weights, compliance against a rigid stop, zero of the pressure sensor."""

from __future__ import annotations

from collections.abc import Sequence

from sequences.frame import Frame
from sequences.step import Apparatus, Motion, Step, Steps, rest


def dead_weights(apparatus: Apparatus, masses: Sequence[float], seconds: float) -> list[Step]:
    """Return the steps of a load cell calibration: hang each mass (kg), confirm, record; up and down again."""

    def ask(mass: float) -> Step:
        def act(frame: Frame) -> Steps:
            apparatus.tell.ask(f"hang {mass * 1e3:g} g on the gripper, wait until it is still, then go on")
            return (yield)

        return Step("prompt", f"{mass * 1e3:g} g hung", act)

    def weigh(mass: float) -> Step:
        return Step(f"weight {mass * 1e3:g} g", f"{seconds:g} s at rest", lambda frame: rest(apparatus, seconds, frame))

    order = [*masses, *reversed(masses[:-1])]
    return [step for mass in order for step in (ask(mass), weigh(mass))]


def pressure_zero(apparatus: Apparatus, seconds: float) -> list[Step]:
    """Return the steps of a pressure zero: open the sensor's port to the room, confirm, average."""

    def ask(frame: Frame) -> Steps:
        apparatus.tell.ask("open the sensor's port to the room, then go on")
        return (yield)

    def average(frame: Frame) -> Steps:
        return rest(apparatus, seconds, frame)

    return [Step("prompt", "the port is open", ask), Step("zero", f"{seconds:g} s at rest", average)]


def unload(apparatus: Apparatus, speed: float, distance: float) -> Step:
    """Return the step that backs away from a rigid stop (m/s, m), slowly enough to see force against travel."""

    def act(frame: Frame) -> Steps:
        target = min(frame.stage.position + distance, apparatus.stage.travel[1])
        motion = Motion(apparatus, target, speed)
        try:
            while not motion.arrived(frame):
                motion.extend(frame)
                frame = yield
                apparatus.tell.progress(frame.stage.position, target, "m")
        finally:
            apparatus.stage.stop()
        return frame

    return Step("unload", "clear of the stop", act)
