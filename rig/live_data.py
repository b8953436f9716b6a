"""What a live prediction knows of a test: gathered frame by frame, a few numbers each."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.observe import StepEvent, StepPhase
from sequences.frame import Frame

Array = NDArray[np.float64]

TOUCH_N = 1.5e-3
"""A force that differs from the tare by so much is a touch; five standard deviations of the tare if that is more."""
REST_S = 0.5
"""P_0 is the mean pressure over this time before the retraction."""
GONE = 0.05
"""The contact is gone when the tension has fallen to this part of its peak."""


class Glance(NamedTuple):
    """A frame in short: means of force (N, untared) and pressure (Pa, or ``nan``), and the stage's position."""

    number: int
    start: int
    stop: int
    rate: float
    force: float
    pressure: float
    position: float

    @classmethod
    def at(cls, frame: Frame) -> Glance:
        """Reduce a frame."""
        pressure = np.nan if frame.pressure is None else float(frame.pressure.mean())
        force = float(frame.force.mean())
        return cls(frame.number, frame.start, frame.stop, frame.rate, force, pressure, frame.stage.position)


@dataclass(frozen=True)
class Evidence:
    """What has been measured up to a frame. SI units, heights as the stage counts them.

    Attributes
    ----------
    frame, sample
        Number of the last frame, and the index one past its last sample.
    force_zero, force_noise
        Mean of the load cell before contact (N), and the standard deviation of a frame's mean.
    touch
        Height at first touch, m, or ``nan``.
    start
        Height at the start of the retraction, m.
    initial_pressure
        P_0 as measured, Pa, or ``None``.
    height, force, pressure
        (n,), means over each frame of the retraction: m, N untared, Pa (or ``None``).
    """

    frame: int
    sample: int
    force_zero: float
    force_noise: float
    touch: float
    start: float
    initial_pressure: float | None
    height: Array
    force: Array
    pressure: Array | None


@dataclass
class Gathering:
    """Takes in frames and steps; knows when the retraction is under way and when the contact is gone."""

    retracting: bool = False
    gone: bool = False
    _step: str = ""
    _tare: list[float] = field(default_factory=list)
    _touch: float = np.nan
    _touch_level: float = np.nan
    _rest: deque[tuple[int, float]] = field(default_factory=deque)
    _initial_pressure: float | None = None
    _last_position: float = np.nan
    _start: float = np.nan
    _rows: list[tuple[float, float, float]] = field(default_factory=list)
    _peak: float = 0.0
    _last: tuple[int, int] = (0, 0)

    def step(self, event: StepEvent) -> None:
        """Note which step is under way."""
        if event.phase is StepPhase.STARTED:
            self._step = event.name
            if event.name == "retract":
                self.retracting = True
                self._start = self._last_position
                if self._rest:
                    self._initial_pressure = float(np.mean([value for _, value in self._rest]))
            elif event.name == "return":
                self.gone = True

    def add(self, glance: Glance) -> None:
        """Take in a frame."""
        if self._step == "tare":
            self._tare.append(glance.force)
        elif self._step in ("approach", "preload") and np.isnan(self._touch):
            self._feel(glance.force, glance.position)
        elif self.retracting and not self.gone:
            self._pull(glance)
        if not np.isnan(glance.pressure) and not self.retracting:
            self._rest.append((glance.stop, glance.pressure))
            while self._rest[-1][0] - self._rest[0][0] > REST_S * glance.rate:
                self._rest.popleft()
        self._last_position = glance.position
        self._last = (glance.number, glance.stop)

    def _feel(self, force: float, position: float) -> None:
        if len(self._tare) < 2:
            return
        if np.isnan(self._touch_level):
            self._touch_level = max(TOUCH_N, 5 * float(np.std(self._tare)))
        if abs(force - float(np.mean(self._tare))) > self._touch_level:
            self._touch = (position + self._last_position) / 2

    def _pull(self, glance: Glance) -> None:
        tension = self.zero - glance.force
        self._peak = max(self._peak, tension)
        if self._peak > 20 * TOUCH_N and tension < GONE * self._peak:
            self.gone = True
            return
        self._rows.append(((glance.position + self._last_position) / 2, glance.force, glance.pressure))

    @property
    def zero(self) -> float:
        """Mean of the load cell before contact, N."""
        return float(np.mean(self._tare)) if self._tare else 0.0

    @property
    def height(self) -> float:
        """The stage's last position, m."""
        return self._last_position

    @property
    def frames(self) -> int:
        """How many frames of the retraction there are."""
        return len(self._rows)

    def evidence(self) -> Evidence:
        """Return what is known now."""
        rows = np.array(self._rows).reshape(-1, 3)
        measured = self._initial_pressure is not None
        return Evidence(
            frame=self._last[0],
            sample=self._last[1],
            force_zero=self.zero,
            force_noise=float(np.std(self._tare)) if len(self._tare) > 1 else 0.0,
            touch=self._touch,
            start=self._start,
            initial_pressure=self._initial_pressure,
            height=rows[:, 0],
            force=rows[:, 1],
            pressure=rows[:, 2] if measured else None,
        )
