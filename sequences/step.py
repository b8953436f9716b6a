"""What a step is, and how steps follow one another.

A step is a generator: it commands the stage or the pump, then ``frame = yield`` until its condition holds; its
``finally`` stops what it started. Time is counted in the samples it is given: neither the wall nor a hold counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivers.interfaces import Pump, Stage
from sequences.errors import StepFailed
from sequences.frame import Frame

Steps = Generator[None, Frame, Frame]
"""Receives frames; returns the last one it took."""


class Teller(Protocol):
    """Where steps report to."""

    def started(self, name: str) -> None:
        """A step has begun."""
        ...

    def progress(self, value: float, target: float, unit: str) -> None:
        """How far the present step is from its condition (SI)."""
        ...

    def ended(self, name: str, outcome: str) -> None:
        """A step has ended: ``done`` or what happened instead."""
        ...

    def note(self, text: str) -> None:
        """Something the log should hold."""
        ...

    def ask(self, text: str) -> None:
        """Ask the operator for a hand: no further frame comes before the run is resumed."""
        ...


@dataclass(frozen=True)
class Apparatus:
    """What the steps act on.

    Attributes
    ----------
    look_ahead
        A move under way is never commanded further than this beyond the present position, m (dead man).
    frame
        Usual length of a frame, s.
    room
        How far the stage may go on from a force (N, a magnitude) against something rigid, m.
    lowest_contact
        Where the approach ends without contact, m.
    at_rest, at_rest_within
        What the load cell reads with the gripper free, and how far from it a tare may lie, N.
    return_speed
        The fastest at which a force limit stops the stage in time, whatever it meets, m/s.
    """

    stage: Stage
    pump: Pump | None
    tell: Teller
    look_ahead: float = 50e-6
    frame: float = 20e-3
    room: Callable[[float], float] = lambda force: math.inf
    lowest_contact: float = -math.inf
    at_rest: float = 0.0
    at_rest_within: float = math.inf
    return_speed: float = math.inf

    def ahead(self, frame: Frame) -> float:
        """Return how far ahead of its position the stage may be commanded, m: the cell outlives this program."""
        return min(self.look_ahead, max(0.0, self.room(float(np.abs(frame.force).max()))))


@dataclass(frozen=True)
class Step:
    """A named step, the condition that ends it in words, and what it does."""

    name: str
    condition: str
    act: Callable[[Frame], Steps]


def play(steps: Sequence[Step], tell: Teller) -> Generator[None, Frame, None]:
    """Play the steps one after another; each gets the frame in which its predecessor ended."""
    frame = yield
    for step in steps:
        tell.started(step.name)
        outcome = "stopped"
        try:
            frame = yield from step.act(frame)
            outcome = "done"
        finally:
            tell.ended(step.name, outcome)


STILL = 20e-6
"""A stage at rest that is found so much further is not at rest, m; from 500 um/s it brakes within 2 um."""


def rest(apparatus: Apparatus, seconds: float, frame: Frame) -> Steps:
    """Let so much time pass, counted in samples.

    Raises
    ------
    StepFailed
        The stage moves.
    """
    rested = 0
    place = frame.stage.position
    while rested < seconds * frame.rate:
        frame = yield
        if abs(frame.stage.position - place) > STILL:
            apparatus.stage.stop()
            raise StepFailed(
                "rest",
                f"the stage is to stand still, but has gone from {place * 1e3:.4f} to "
                f"{frame.stage.position * 1e3:.4f} mm",
                "look at the stage's controller; nobody may move it by joystick",
            )
        rested += frame.force.size
        apparatus.tell.progress(rested / frame.rate, seconds, "s")
    return frame


def by_hand(apparatus: Apparatus, name: str, condition: str, request: str) -> Step:
    """Return the step that asks the operator for a hand and waits until he lets the run go on."""

    def act(frame: Frame) -> Steps:
        apparatus.tell.ask(f"{request}, then go on")
        return (yield)

    return Step(name, condition, act)


@contextmanager
def stopping_on_failure(stage: Stage) -> Iterator[None]:
    """Stop the stage if the step is left by an error or closed; a step that ends well hands its motion on."""
    try:
        yield
    except BaseException:
        stage.stop()
        raise


class Motion:
    """A move commanded a short stretch at a time, so that the stage stops by itself if the program dies.

    Call ``extend`` with every frame. After a hold the move is taken up again.

    Raises
    ------
    StepFailed
        Named by ``step``: it takes much longer than it should.
    """

    _RESOLUTION = 1e-6
    _DELAY = 30.0

    def __init__(self, apparatus: Apparatus, target: float, speed: float, step: str) -> None:
        self._apparatus = apparatus
        self._step = step
        self._left: float | None = None
        self._target = target
        self._commanded: float | None = None
        self._speed = speed
        apparatus.stage.set_speed(speed)

    @property
    def speed(self) -> float:
        """Commanded speed, m/s."""
        return self._speed

    def change_speed(self, speed: float) -> None:
        """Change the speed of the running move, m/s; differences below a tenth are not worth a command."""
        if abs(speed - self._speed) > 0.1 * self._speed:
            self._speed = speed
            self._apparatus.stage.set_speed(speed)
            self._commanded = None  # most controllers take a new speed with the next move

    def extend(self, frame: Frame) -> None:
        """Command the next stretch when half of the last one has been travelled."""
        position, ahead = frame.stage.position, self._apparatus.ahead(frame)
        self._insist_on_progress(frame)
        if self._is_due(frame, position, ahead):
            low, high = self._apparatus.stage.travel
            way = min(max(self._target, low), high) - position
            self._commanded = position + max(min(way, ahead), -ahead)
            self._apparatus.stage.move_to(self._commanded)

    def _insist_on_progress(self, frame: Frame) -> None:
        if self._left is None:
            self._left = (3 * abs(self._target - frame.stage.position) / self._speed + self._DELAY) * frame.rate
        self._left -= frame.force.size
        if self._left < 0:
            raise StepFailed(self._step, "the stage does not arrive", "check the path and the stage's servo")

    def arrived(self, frame: Frame) -> bool:
        """Whether the stage stands at the target."""
        return not frame.stage.moving and abs(frame.stage.position - self._target) < 2 * self._RESOLUTION

    def _is_due(self, frame: Frame, position: float, ahead: float) -> bool:
        if self._commanded is None:
            return True
        left = abs(self._commanded - position)
        if abs(self._commanded - self._target) < self._RESOLUTION:
            return not frame.stage.moving and left > 2 * self._RESOLUTION
        return left < ahead / 2 or not frame.stage.moving


def travel(
    apparatus: Apparatus,
    target: float,
    speed: float,
    name: str,
    frame: Frame,
    watch: Callable[[Frame], None] = lambda frame: None,
) -> Steps:
    """Go to a height (m) at a speed (m/s), or as fast as the look-ahead allows.

    Parameters
    ----------
    name
        Of the step, for its failure.
    watch
        Called with every frame; what it raises stops the motion.

    Raises
    ------
    StepFailed
        It takes much longer than it should.
    """
    motion = Motion(apparatus, target, min(speed, steady_speed(apparatus.ahead(frame), apparatus.frame)), name)
    try:
        while not motion.arrived(frame):
            motion.extend(frame)
            frame = yield
            watch(frame)
            apparatus.tell.progress(frame.stage.position, target, "m")
    finally:
        apparatus.stage.stop()
    return frame


def steady_speed(look_ahead: float, frame: float) -> float:
    """Return the fastest speed (m/s) at which a look-ahead (m) outlasts several frames (s): no stutter."""
    return look_ahead / 4 / frame
