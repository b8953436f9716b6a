"""Referencing: the stage seeks its switch, away from the sample, then parks. Only on the operator's explicit word."""

from __future__ import annotations

from sequences.errors import StepFailed
from sequences.frame import Frame
from sequences.step import Apparatus, Motion, Step, Steps, stopping_on_failure

PARK_SPEED = 500e-6
LONGEST_SECONDS = 120.0


def reference(apparatus: Apparatus, start: float | None = None) -> list[Step]:
    """Return the steps that reference the axis and park it at ``start`` (m), or at the highest allowed position."""

    def seek(frame: Frame) -> Steps:
        with stopping_on_failure(apparatus.stage):
            apparatus.stage.reference()
            deadline = frame.stop + round(LONGEST_SECONDS * frame.rate)
            frame = yield
            while frame.stage.moving or not apparatus.stage.referenced:
                if frame.stop > deadline:
                    raise StepFailed("reference", "the switch is not found", "check the stage's cable and its switches")
                frame = yield
            apparatus.stage.servo(True)
        return frame

    def park(frame: Frame) -> Steps:
        target = apparatus.stage.travel[1] if start is None else start
        motion = Motion(apparatus, target, PARK_SPEED)
        deadline = frame.stop + round(LONGEST_SECONDS * frame.rate)
        try:
            while not motion.arrived(frame):
                motion.extend(frame)
                frame = yield
                apparatus.tell.progress(frame.stage.position, target, "m")
                if frame.stop > deadline:
                    raise StepFailed("park", "the stage does not arrive", "check the path and the stage's servo")
        finally:
            apparatus.stage.stop()
        return frame

    return [Step("reference", "the switch is found", seek), Step("park", "at the starting height", park)]
