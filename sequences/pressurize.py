"""Bringing the chamber to a pressure: feed-forward from Boyle's law, then correction."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from drivers.interfaces import Pump, PumpState
from sequences.errors import StepFailed
from sequences.frame import Frame
from sequences.step import Apparatus, Steps

SETTLE, MEAN, STROKE = 1.0, 0.5, 4.0
"""Seconds: rest after a stroke, average, and how long a stroke should take."""

MOST_STROKES = 12

LARGE, RESPONSE = 500.0, 0.3
"""A stroke that should change the pressure by so much (Pa) must change it by this part of that; then no vent is open,
and the sensor sees the chamber. On the emulated bench the part is 0.97 to 1.01."""

FINEST = 2e-12
"""m^3; what is less the pump cannot be told."""


@dataclass(frozen=True, slots=True)
class Chamber:
    """What Boyle's law needs: V_0 (m^3) and P_atm (Pa)."""

    volume: float
    atmospheric_pressure: float


class Pressurizer:
    """Moves the pump until the pressure is right; the pump is always given a target volume."""

    def __init__(self, apparatus: Apparatus, chamber: Chamber, tolerance: float, step: str) -> None:
        if apparatus.pump is None:
            raise StepFailed(step, "the bench has no pump", "add [pump] and [pressure] to the bench")
        self._pump: Pump = apparatus.pump
        self._apparatus = apparatus
        self._chamber = chamber
        self._tolerance = tolerance
        self._step = step
        self._goal = self._wanted = 0.0

    def bring_to(self, goal: float, frame: Frame) -> Steps:
        """Bring the chamber to ``goal`` (Pa gauge)."""
        self._goal = goal
        pressure, before = np.nan, goal
        for _ in range(MOST_STROKES):
            frame = yield from self._settle(frame)
            pressure, frame = yield from self.mean_pressure(frame)
            self._insist_on_response(before, pressure)
            if abs(pressure - goal) <= 0.6 * self._tolerance:
                self._apparatus.tell.note(f"P_0 reached: {pressure / 1e3:+.3f} kPa")
                return frame
            before = pressure
            self._wanted = goal - pressure
            after = self._chamber.atmospheric_pressure + goal
            frame = yield from self.dispense(self._chamber.volume * (goal - pressure) / after, frame)
        raise StepFailed(
            self._step,
            f"P_a stays at {pressure / 1e3:+.3f} kPa, {goal / 1e3:+g} kPa wanted",
            "look for a leak, check chamber_volume_ml and the syringe diameter",
        )

    def _insist_on_response(self, before: float, pressure: float) -> None:
        """Pump no further into a chamber whose pressure does not follow."""
        wanted, found = self._goal - before, pressure - before
        if abs(wanted) >= LARGE and found / wanted < RESPONSE:
            raise StepFailed(
                self._step,
                f"P_a has changed by {found / 1e3:+.3f} kPa where the stroke should make {wanted / 1e3:+.3f} kPa",
                "close the vent, check tubing, syringe and the pressure sensor's wires; then chamber_volume_ml",
            )

    def _insist_on_volume(self, frame: Frame) -> None:
        """Stop a stroke that makes far more pressure than it should."""
        if frame.pressure is None or self._wanted == 0.0:
            return
        pressure = float(frame.pressure.mean())
        beyond = (pressure - self._goal) * np.sign(self._wanted)
        if beyond > max(LARGE, abs(self._wanted) / 2):
            raise StepFailed(
                self._step,
                f"P_a has come to {pressure / 1e3:+.3f} kPa, {self._goal / 1e3:+g} kPa wanted: the chamber is smaller "
                f"than chamber_volume_ml = {self._chamber.volume * 1e6:g}",
                "open the vent, correct chamber_volume_ml (`rig run volume` measures it) or the syringe diameter",
            )

    def dispense(self, volume: float, frame: Frame) -> Steps:
        """Move the pump by so much (m^3, positive into the chamber) and wait until it has done so.

        A hold stops the pump; what it has not moved by then is moved afterwards.
        """
        goal = _moved(frame) + volume
        try:
            while abs(volume) >= FINEST:
                frame, held = yield from self._stroke(volume, frame)
                volume = goal - _moved(frame) if held else 0.0
        finally:
            self._pump.stop()
        return frame

    def _stroke(self, volume: float, frame: Frame) -> Generator[None, Frame, tuple[Frame, bool]]:
        """Let the pump move once; return the last frame and whether a hold has stopped it."""
        slowest, fastest = self._pump.rate_limits
        rate = min(max(abs(volume) / STROKE, 2 * slowest), 0.9 * fastest)
        before, held = frame.pump, False
        self._pump.dispense(volume, rate)
        left = (3 * abs(volume) / rate + 5) * frame.rate
        while frame.pump is before or frame.pump is None or frame.pump.state in _RUNNING:
            frame = yield
            self._show(frame)
            self._insist_on_volume(frame)
            left -= frame.force.size
            if frame.resumed:
                before, held = frame.pump, True  # that poll may be older than the stop
            if left < 0:
                raise StepFailed(self._step, "the pump did not reach its target volume", "look at the pump's screen")
        if frame.pump.state in (PumpState.STALLED, PumpState.AT_LIMIT):
            raise StepFailed(
                self._step,
                f"the pump is {frame.pump.state} after {frame.pump.volume * 1e6:.4f} ml",
                "free the syringe, check its travel and the force setting, then run again",
            )
        return frame, held

    def mean_pressure(self, frame: Frame) -> Generator[None, Frame, tuple[float, Frame]]:
        """Return the mean over half a second, Pa, and the last frame."""
        means: list[float] = []
        left = MEAN * frame.rate
        while left > 0:
            frame = yield
            left -= frame.force.size
            if frame.pressure is not None:
                means.append(float(frame.pressure.mean()))
            self._show(frame)
        return float(np.mean(means)), frame

    def _settle(self, frame: Frame) -> Steps:
        left = SETTLE * frame.rate
        while left > 0:
            frame = yield
            left -= frame.force.size
            self._show(frame)
        return frame

    def _show(self, frame: Frame) -> None:
        if frame.pressure is not None:
            self._apparatus.tell.progress(float(frame.pressure.mean()), self._goal, "Pa")


_RUNNING = (PumpState.INFUSING, PumpState.WITHDRAWING)


def _moved(frame: Frame) -> float:
    """Return what the pump has moved so far, m^3."""
    return 0.0 if frame.pump is None else frame.pump.volume
