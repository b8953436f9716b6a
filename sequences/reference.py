"""Referencing: the stage seeks its switch, away from the sample, then parks. Only on the operator's explicit word."""

from __future__ import annotations

from dataclasses import dataclass

from sequences.errors import StepFailed
from sequences.frame import Frame
from sequences.step import Apparatus, Step, Steps, stopping_on_failure, travel

LONGEST_SECONDS = 120.0


@dataclass(frozen=True, slots=True)
class Parking:
    """How the stage is brought to where a test begins: the way there touches nothing, or is given up.

    Attributes
    ----------
    start
        Height, m; ``None`` is the highest allowed.
    speed
        m/s, at most.
    touch
        Change of force that is taken for a touch, N.
    """

    start: float | None
    speed: float
    touch: float


def reference(apparatus: Apparatus, parking: Parking) -> list[Step]:
    """Return the steps that reference the axis and park it.

    Raises
    ------
    StepFailed
        The stage cannot be parked there.
    """
    low, high = apparatus.stage.travel
    start = high if parking.start is None else parking.start
    if not low <= start <= high:
        raise StepFailed(
            "park",
            f"start_mm = {start * 1e3:g} lies outside the stage's travel of {low * 1e3:g} to {high * 1e3:g} mm",
            "correct start_mm in the bench file",
        )

    def seek(frame: Frame) -> Steps:
        stage = apparatus.stage
        with stopping_on_failure(stage):
            stage.reference()
            left = LONGEST_SECONDS * frame.rate
            frame = yield
            while frame.stage.moving or not stage.referenced:
                if frame.resumed and not stage.referenced:
                    stage.reference()
                left -= frame.force.size
                if left < 0:
                    raise StepFailed("reference", "the switch is not found", "check the stage's cable and its switches")
                frame = yield
            stage.servo(True)
        return frame

    def park(frame: Frame) -> Steps:
        zero = float(frame.force.mean())

        def watch(frame: Frame) -> None:
            force = float(frame.force.mean()) - zero
            if abs(force) > parking.touch:
                raise StepFailed(
                    "park",
                    f"something is in the way at {frame.stage.position * 1e3:.3f} mm, force {force:+.3f} N",
                    "take specimen and gripper out of the stage's path, or correct start_mm in the bench file",
                )

        return travel(apparatus, start, parking.speed, "park", frame, watch)

    return [Step("reference", "the switch is found", seek), Step("park", "at the starting height", park)]
