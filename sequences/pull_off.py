"""The pull-off test of both papers: contact, preload, pressurize, retract, pull-off, detachment.

EML 2020 Fig. 2c; speeds and preload from its section 2. Forces are counted from the tare, compression positive.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from sequences.errors import StepFailed
from sequences.frame import Array, Frame
from sequences.pressurize import Chamber, Pressurizer
from sequences.step import Apparatus, Motion, Step, Steps, rest, stopping_on_failure, travel

FEWEST_VALUES = 3
"""Different values in a tare: less is no sensor, whose noise every DAQ shows."""

PRESS_BY_HAND = "press the load cell by hand, `rig doctor` must show it; if not, look at its amplifier and wires"


@dataclass(frozen=True, slots=True)
class PullOffSettings:
    """Settings in SI units; ``initial_pressure`` is ``None`` for a vented chamber."""

    preload: float
    approach_speed: float
    retract_speed: float
    dwell: float
    tare: float
    contact_force: float
    initial_pressure: float | None
    pressure_tolerance: float
    chamber_volume: float
    atmospheric_pressure: float
    return_speed: float = 500e-6
    longest_retraction: float = 12e-3
    tail: float = 5.0


class PullOff:
    """One pull-off test. What a step finds, the later ones use."""

    def __init__(self, apparatus: Apparatus, settings: PullOffSettings) -> None:
        self._apparatus = apparatus
        self._settings = settings
        self._zero = 0.0
        self._noise = 0.0
        self._start_height = 0.0
        self._contact_height = 0.0
        self._least_force = 0.0

    def steps(self) -> list[Step]:
        """Return the steps this scene needs, in order."""
        s = self._settings
        steps = [*self.contact_steps(), Step("dwell", f"{s.dwell:g} s at rest", self._dwell)]
        if s.initial_pressure is not None:
            words = f"P_a = {s.initial_pressure / 1e3:+g} kPa within {s.pressure_tolerance / 1e3:g} kPa"
            steps.append(Step("pressurize", words, self._pressurize))
        return [
            *steps,
            Step("retract", "the tension has passed its peak", self._retract),
            Step("pull-off", f"no force for {s.tail:g} s", self._pull_off),
            Step("return", "back at the starting height", self._return),
        ]

    def contact_steps(self) -> list[Step]:
        """Return the steps up to the preload."""
        s = self._settings
        return [
            Step("tare", f"{s.tare:g} s without contact", self._tare),
            Step("approach", f"force above {s.contact_force * 1e3:g} mN", self._approach),
            Step("preload", f"force reaches {s.preload:g} N", self._preload),
        ]

    def _force(self, frame: Frame) -> float:
        return float(frame.force.mean()) - self._zero

    def _tare(self, frame: Frame) -> Steps:
        self._start_height = frame.stage.position
        blocks: list[Array] = []
        samples = 0
        while samples < self._settings.tare * frame.rate:
            frame = yield
            if frame.stage.moving:
                raise StepFailed("tare", "the stage is moving", "look at its controller, then run again")
            blocks.append(frame.force)
            samples += frame.force.size
            self._apparatus.tell.progress(samples / frame.rate, self._settings.tare, "s")
        force = np.concatenate(blocks)
        means = np.array([block.mean() for block in blocks])
        self._zero, self._noise = float(force.mean()), float(means.std(ddof=1))
        drift = abs(float(means[len(means) // 2 :].mean() - means[: len(means) // 2].mean()))
        if max(drift, 3 * self._noise) > self._settings.contact_force:
            raise StepFailed(
                "tare",
                f"the force is not at rest: noise {self._noise * 1e3:.2f} mN, change {drift * 1e3:.2f} mN, "
                f"contact is at {self._settings.contact_force * 1e3:g} mN",
                "let the load cell warm up, keep the gripper clear of the sample, or raise contact_force_mN",
            )
        self._insist_on_a_free_gripper(force)
        self._apparatus.tell.note(f"tare {self._zero:+.5f} N, noise of a frame's mean {self._noise * 1e3:.3f} mN")
        return frame

    def _insist_on_a_free_gripper(self, force: Array) -> None:
        """Refuse a sensor that cannot be true, and a contact that the tare would hide."""
        if np.unique(force).size < FEWEST_VALUES:
            raise StepFailed(
                "tare",
                f"the force does not scatter: all of its {force.size} samples are {self._zero:+.4f} N",
                PRESS_BY_HAND,
            )
        rest, within = self._apparatus.at_rest, self._apparatus.at_rest_within
        if abs(self._zero - rest) > within:
            raise StepFailed(
                "tare",
                f"the force at rest is {self._zero:+.3f} N, {rest:+g} N within {within:.2g} N expected",
                "drive the stage clear: the gripper is in contact; if it surely hangs free, enter what `rig doctor` "
                "shows as at_rest_N of the bench",
            )

    def _approach(self, frame: Frame) -> Steps:
        lowest = max(self._apparatus.stage.travel[0], self._apparatus.lowest_contact)
        motion = Motion(self._apparatus, lowest, self._settings.approach_speed, "approach")
        with stopping_on_failure(self._apparatus.stage):
            while abs(self._force(frame)) < self._settings.contact_force:
                if frame.stage.position < lowest or motion.arrived(frame):
                    raise StepFailed(
                        "approach",
                        f"no contact down to {lowest * 1e3:.3f} mm",
                        f"{PRESS_BY_HAND}; if it does, look whether the gripper is above the sample: raise the sample, "
                        "or correct lowest_contact_mm of the bench",
                    )
                motion.extend(frame)
                frame = yield
                self._apparatus.tell.progress(self._force(frame), self._settings.contact_force, "N")
        self._contact_height = frame.stage.position
        self._apparatus.tell.note(f"contact at {self._contact_height * 1e3:.4f} mm")
        return frame  # still moving: the preload takes over

    def _preload(self, frame: Frame) -> Steps:
        goal = self._settings.preload
        motion = Motion(self._apparatus, self._apparatus.stage.travel[0], self._settings.approach_speed, "preload")
        last = frame
        try:
            while self._force(frame) < goal:
                if self._force(frame) < -goal:
                    raise StepFailed(
                        "preload",
                        f"the force has fallen to {self._force(frame):+.3f} N while the stage went down",
                        "hang a weight on the gripper: the force must fall, or compression_positive is wrong; if it "
                        "falls, the sample pulls harder than preload_N",
                    )
                if motion.arrived(frame):
                    raise StepFailed(
                        "preload",
                        f"{self._force(frame):.3f} of {goal:g} N at the lowest height allowed",
                        f"{PRESS_BY_HAND}; if it does, raise the sample",
                    )
                motion.change_speed(self._preload_speed(last, frame))
                motion.extend(frame)
                last = frame
                frame = yield
                self._apparatus.tell.progress(self._force(frame), goal, "N")
        finally:
            self._apparatus.stage.stop()
        return frame

    def _preload_speed(self, last: Frame, frame: Frame) -> float:
        """Slow down as the force nears the preload: what is left should take at least a quarter of a second."""
        travelled = last.stage.position - frame.stage.position
        if travelled <= 0.05e-6:
            return self._settings.approach_speed
        stiffness = max((self._force(frame) - self._force(last)) / travelled, 1e-3)
        left = self._settings.preload - self._force(frame)
        return min(self._settings.approach_speed, max(left / stiffness / 0.25, 1e-6))

    def _dwell(self, frame: Frame) -> Steps:
        return rest(self._apparatus, self._settings.dwell, frame)

    def _pressurize(self, frame: Frame) -> Steps:
        goal = self._settings.initial_pressure
        if goal is None:  # such a scene has no pressurize step
            return frame
        chamber = Chamber(self._settings.chamber_volume, self._settings.atmospheric_pressure)
        gas = Pressurizer(self._apparatus, chamber, self._settings.pressure_tolerance, "pressurize")
        return (yield from gas.bring_to(goal, frame))

    def _retract(self, frame: Frame) -> Steps:
        motion = self._retraction("retract")
        least = self._force(frame)
        with stopping_on_failure(self._apparatus.stage):
            while not self._peak_passed(self._force(frame), least):
                frame = yield from self._on(motion, frame, "retract")
                least = min(least, self._force(frame))
                self._apparatus.tell.progress(self._force(frame), least, "N")
                if self._never_adhered(frame, least):
                    self._apparatus.tell.note("no adhesion: the force never became tensile")
                    break
        self._least_force = least
        return frame

    def _pull_off(self, frame: Frame) -> Steps:
        motion = self._retraction("pull-off")
        band = max(self._settings.contact_force / 2, 6 * self._noise, 0.04 * -self._least_force)
        quiet = 0
        recent: deque[float] = deque(maxlen=max(2, round(0.5 * frame.rate / frame.force.size)))
        try:
            while quiet < self._settings.tail * frame.rate:
                frame = yield from self._on(motion, frame, "pull-off")
                recent.append(self._force(frame))
                free = max(recent) - min(recent) < band and abs(recent[-1]) < band
                quiet = quiet + frame.force.size if free else 0
                self._apparatus.tell.progress(quiet / frame.rate, self._settings.tail, "s")
        finally:
            self._apparatus.stage.stop()
        self._apparatus.tell.note(f"detached below {frame.stage.position * 1e3:.4f} mm")
        return frame

    def _retraction(self, step: str) -> Motion:
        highest = self._apparatus.stage.travel[1]
        target = min(self._contact_height + self._settings.longest_retraction, highest)
        return Motion(self._apparatus, target, self._settings.retract_speed, step)

    def _on(self, motion: Motion, frame: Frame, step: str) -> Steps:
        """Go on retracting by one frame."""
        if motion.arrived(frame):
            raise StepFailed(
                step,
                f"still attached at {frame.stage.position * 1e3:.3f} mm, force {self._force(frame):+.4f} N",
                "free the sample by hand; a longer way up needs a higher maximum_mm",
            )
        motion.extend(frame)
        return (yield)

    def _peak_passed(self, force: float, least: float) -> bool:
        tension = -least
        return tension > max(self._settings.contact_force, 6 * self._noise) and force > least + max(
            0.1 * tension, 6 * self._noise
        )

    def _never_adhered(self, frame: Frame, least: float) -> bool:
        clear = frame.stage.position > self._contact_height + 3e-3
        return (
            clear and least > -self._settings.contact_force and abs(self._force(frame)) < self._settings.contact_force
        )

    def _return(self, frame: Frame) -> Steps:
        """Go up to the starting height."""
        target = max(self._start_height, frame.stage.position)
        speed = min(self._settings.return_speed, self._apparatus.return_speed)
        return travel(self._apparatus, target, speed, "return", frame)
