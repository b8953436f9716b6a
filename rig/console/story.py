"""All that has been told of one run, and what of it is seen when the playhead stands at a given sample.

Live, the playhead is at the end. In a replay the operator moves it. The window asks only ``Story.at``, so both look the
same. No Qt here.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import PumpStatus, StageStatus
from rig.console.pyramid import Pyramid
from rig.live_data import GONE, TOUCH_N
from rig.live_prediction import LivePrediction
from rig.observe import Ending, Event, RunInfo, StepEvent, StepPhase, StepPlan
from rig.wire import Gap, Message, Samples

Array = NDArray[np.float64]

T = TypeVar("T")

_SPEED_S = 0.3
"""The stage's speed is taken over this time."""


@dataclass(frozen=True)
class Moment:
    """What the operator sees at one sample.

    Attributes
    ----------
    sample, time
        Where the playhead stands: index, and s.
    force, pressure
        The last 0.1 s of signal, mean: N tared, Pa.
    speed
        Of the stage, m/s, rising positive.
    step, progress
        The step under way and the last word on it.
    done
        Names of the steps that have ended, with their outcomes.
    force_zero, zero_height
        What the load cell reads at no force (N), and the stage position at z_r = 0 (m) or ``nan``.
    """

    sample: int
    time: float
    force: float
    pressure: float | None
    stage: StageStatus | None
    pump: PumpStatus | None
    speed: float
    step: StepPlan | None
    progress: StepEvent | None
    done: dict[str, str]
    prediction: LivePrediction | None
    events: int
    ending: Ending | None
    force_zero: float
    zero_height: float


def _last(items: Sequence[T], samples: list[int], sample: int) -> T | None:
    place = bisect_right(samples, sample)
    return items[place - 1] if place else None


class Story:
    """One run, from its description to its end."""

    def __init__(self, info: RunInfo) -> None:
        self.info = info
        self.force = Pyramid()
        self.height = Pyramid()
        self.pressure = Pyramid() if info.uses_pressure else None
        self.events: list[Event] = []
        self.predictions: list[LivePrediction] = []
        self.steps: list[StepEvent] = []
        self.ending: Ending | None = None
        self.missed = 0
        self._event_samples: list[int] = []
        self._prediction_samples: list[int] = []
        self._step_samples: list[int] = []
        self._polls: list[tuple[StageStatus, PumpStatus | None]] = []
        self._poll_samples: list[int] = []
        self._last_position = (0, np.nan)

    @property
    def rate(self) -> float:
        """Hz."""
        return self.info.rate

    @property
    def end(self) -> int:
        """Number of samples so far."""
        return len(self.force)

    def add(self, message: Message) -> None:
        """Take in one message of the link."""
        match message:
            case Samples():
                self._add_samples(message)
            case StepEvent():
                self.steps.append(message)
                self._step_samples.append(message.sample)
            case Event():
                self.events.append(message)
                self._event_samples.append(message.sample)
            case LivePrediction():
                self.predictions.append(message)
                self._prediction_samples.append(message.sample)
            case Ending():
                self.ending = message
            case Gap():
                self.missed += message.messages
            case RunInfo():
                raise ValueError("a new run needs a new story")

    def _add_samples(self, samples: Samples) -> None:
        if samples.start > self.end:  # messages were missed: keep the time axis true
            self._pad(samples.start - self.end)
        self.force.extend(samples.force)
        if self.pressure is not None:
            missing = np.full(samples.force.size, np.nan)
            self.pressure.extend(missing if samples.pressure is None else samples.pressure)
        index, position = self._last_position
        known = np.append(index, samples.ends), np.append(position, samples.positions)
        if np.isnan(position):
            known = samples.ends, samples.positions
        self.height.extend(np.interp(np.arange(samples.start, samples.stop) + 1.0, *known))
        self._last_position = (int(samples.ends[-1]), float(samples.positions[-1]))
        self._polls.append((samples.stage, samples.pump))
        self._poll_samples.append(samples.stop)

    def _pad(self, count: int) -> None:
        gap = np.full(count, np.nan)
        for signal in (self.force, self.height, self.pressure):
            if signal is not None:
                signal.extend(gap)

    # -- what is seen

    def at(self, sample: int) -> Moment:
        """Return what is seen with the playhead at ``sample``."""
        sample = min(sample, self.end)
        steps = self.steps[: bisect_right(self._step_samples, sample)]
        stage, pump = _last(self._polls, self._poll_samples, sample) or (None, None)
        prediction = _last(self.predictions, self._prediction_samples, sample)
        name = next((event.name for event in reversed(steps) if event.phase is StepPhase.STARTED), None)
        over = {event.name: event.outcome for event in steps if event.phase is StepPhase.ENDED}
        last = next((event for event in reversed(steps) if event.name == name), None)
        zero = self._force_zero(steps, prediction)
        return Moment(
            sample=sample,
            time=sample / self.rate,
            force=self._recent(self.force, sample) - zero,
            pressure=None if self.pressure is None else self._recent(self.pressure, sample),
            stage=stage,
            pump=pump,
            speed=self._speed(sample),
            step=None if name in over else self._plan(name),
            progress=last,
            done=over,
            prediction=prediction,
            events=bisect_right(self._event_samples, sample),
            ending=self.ending if sample >= self.end else None,
            force_zero=zero,
            zero_height=self._zero_height(steps, prediction, sample),
        )

    def retraction(self, moment: Moment) -> tuple[int, int]:
        """Return the stretch of samples from the start of the retraction to where the playhead stands in it."""
        start = stop = None
        for event in self.steps:
            if event.sample > moment.sample:
                break
            if event.name == "retract" and event.phase is StepPhase.STARTED:
                start, stop = event.sample, None
            elif event.name == "return" and event.phase is StepPhase.STARTED:
                stop = event.sample
        if start is None:
            return 0, 0
        return start, min(moment.sample, self.end if stop is None else stop)

    def measured(self, moment: Moment) -> tuple[float, float] | None:
        """Return F_p (N) and D_p (m) as the samples show them, or ``None`` while the contact holds.

        A first look at the running mean over 20 ms; the analysis of the recording has the last word.
        """
        start, stop = self.retraction(moment)
        window = max(1, int(0.02 * self.rate))
        blocks = (stop - start) // window
        if blocks < 2 or np.isnan(moment.zero_height):
            return None
        stretch = self.force.values[start : start + blocks * window].reshape(blocks, window)
        tension = moment.force_zero - stretch.mean(axis=1)
        peak = int(np.argmax(tension))
        gone = np.flatnonzero(tension[peak:] < GONE * tension[peak])
        if not gone.size or tension[peak] < 20 * TOUCH_N:
            return None
        last = start + (peak + int(gone[0])) * window
        return float(tension[peak]), float(self.height.values[last]) - moment.zero_height

    def waiting(self, moment: Moment) -> str:
        """Return what the run waits for: ``hold``, the text of a prompt, or nothing."""
        for event in reversed(self.events[: moment.events]):
            if event.kind == "prompt" or (event.kind, event.text) == ("operator", "hold"):
                return event.text
            if (event.kind, event.text) == ("operator", "resume"):
                return ""
        return ""

    def boundaries(self, moment: Moment) -> list[tuple[int, str]]:
        """Return where each step so far began."""
        return [
            (event.sample, event.name)
            for event in self.steps
            if event.phase is StepPhase.STARTED and event.sample <= moment.sample
        ]

    def _plan(self, name: str | None) -> StepPlan | None:
        if name is None:
            return None
        return next((plan for plan in self.info.plan if plan.name == name), StepPlan(name, ""))

    def _recent(self, signal: Pyramid, sample: int) -> float:
        stretch = signal.values[max(0, sample - int(0.1 * self.rate)) : sample]
        return float(stretch.mean()) if stretch.size else np.nan

    def _speed(self, sample: int) -> float:
        stretch = self.height.values[max(0, sample - int(_SPEED_S * self.rate)) : sample]
        return float((stretch[-1] - stretch[0]) / (stretch.size - 1) * self.rate) if stretch.size > 1 else np.nan

    def _force_zero(self, steps: list[StepEvent], prediction: LivePrediction | None) -> float:
        if prediction is not None:
            return prediction.force_zero.value
        start = stop = None
        for event in steps:
            if event.name == "tare" and event.phase is StepPhase.STARTED:
                start = event.sample
            elif event.name == "tare" and event.phase is StepPhase.ENDED:
                stop = event.sample
        if start is None or stop is None or stop <= start:
            return 0.0
        return float(self.force.values[start:stop].mean())

    def _zero_height(self, steps: list[StepEvent], prediction: LivePrediction | None, sample: int) -> float:
        if prediction is not None:
            return prediction.zero_height
        start = next((event.sample for event in reversed(steps) if event.name == "retract"), None)
        begun = next(
            (event.sample for event in steps if event.name == "retract" and event.phase is StepPhase.STARTED), start
        )
        return np.nan if begun is None or begun >= min(sample, self.end) else float(self.height.values[begun])
