"""What a run tells its observers (terminal, console link, live prediction) and what they may ask of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from sequences.frame import Frame


@dataclass(frozen=True, slots=True)
class StepPlan:
    """One step of the sequence before it has begun: its name and, in words, the condition that ends it."""

    name: str
    condition: str


@dataclass(frozen=True)
class RunInfo:
    """What is known before the first frame.

    Attributes
    ----------
    title, protocol
        From the scene.
    recording
        Path of the recording, or empty.
    pid
        Process that runs the loop.
    rate, frame_samples
        The DAQ's actual rate (Hz) and the samples in a frame.
    uses_pressure
        Whether pump and pressure sensor are open.
    plan
        The steps to come.
    limits
        Bench and scene limits in SI, by name (``compression_N``, ``travel_low_m``, ...).
    scene
        The scene as it was checked, by section.
    identities
        What each instrument said of itself.
    virtual
        Whether the time of the bench is the plant's and not the wall's.
    repeat, repeats
        Which of how many tests of this scene in a row, from 1.
    """

    title: str
    protocol: str
    recording: str
    pid: int
    rate: float
    frame_samples: int
    uses_pressure: bool
    plan: tuple[StepPlan, ...]
    limits: Mapping[str, float]
    scene: Mapping[str, Any]
    identities: Mapping[str, str]
    virtual: bool
    repeat: int = 1
    repeats: int = 1


class StepPhase(StrEnum):
    """A step begins, gets on, ends."""

    STARTED = "started"
    PROGRESS = "progress"
    ENDED = "ended"


@dataclass(frozen=True, slots=True)
class StepEvent:
    """Something about a step: ``value`` of ``target`` in ``unit`` (SI) while it gets on, ``outcome`` when it ends."""

    phase: StepPhase
    name: str
    sample: int
    outcome: str = ""
    value: float = 0.0
    target: float = 0.0
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Event:
    """One line of the log.

    ``kind`` is ``command``, ``operator``, ``prompt``, ``note``, ``warning``, ``timing``, ``fault``, ``interlock`` or
    ``end``.
    """

    sample: int
    kind: str
    text: str


@dataclass(frozen=True)
class Ending:
    """How a run ended: ``reason`` is ``done`` or the error's text, ``exit_code`` as of the command line."""

    reason: str
    exit_code: int
    samples: int
    features: Mapping[str, Any] = field(default_factory=dict)


class Observer:
    """Told of everything on the loop's thread; overrides what it needs. It must not block; who raises is dropped."""

    def started(self, info: RunInfo) -> None:
        """The instruments are open, the stage is referenced; no step has begun."""

    def frame(self, frame: Frame) -> None:
        """A frame has been checked and recorded."""

    def step(self, event: StepEvent) -> None:
        """A step began, got on or ended."""

    def event(self, event: Event) -> None:
        """A line for the log."""

    def prediction(self, prediction: Any) -> None:
        """A live prediction (``rig.live_prediction.LivePrediction``)."""

    def finished(self, ending: Ending) -> None:
        """Everything has been stopped and the recording closed."""


class Wish(StrEnum):
    """What the operator has asked for and the loop has not yet done."""

    NONE = "none"
    HOLD = "hold"
    RESUME = "resume"
    STOP = "stop"
    EMERGENCY = "emergency stop"


class Controls:
    """The operator's hand on the run. Safe from any thread and any signal handler; the loop looks at it once a frame.

    There is no lock: a signal handler runs on the loop's thread, which may be just in here, and would wait for itself.
    """

    def __init__(self) -> None:
        self._wishes: deque[Wish] = deque()
        self._stop_now: Callable[[], None] | None = None
        self.ending = False
        """Whether a stop has ever been asked for; no further run is begun then."""
        self.emergency = False
        """Whether the emergency stop has ever been pressed; nothing is set in motion then."""

    def connect(self, stop_now: Callable[[], None] | None) -> None:
        """Give the action of the emergency stop: it writes to the instruments from the caller's thread."""
        self._stop_now = stop_now

    def hold(self) -> None:
        """Stop the motion and wait; data keep coming."""
        self._wishes.append(Wish.HOLD)

    def resume(self) -> None:
        """Go on after a hold."""
        self._wishes.append(Wish.RESUME)

    def stop(self) -> None:
        """End the run in good order."""
        self.ending = True
        self._wishes.append(Wish.STOP)

    def emergency_stop(self) -> None:
        """Stop the stage at once from this thread, then end the run."""
        self.ending = self.emergency = True
        self._wishes.append(Wish.EMERGENCY)
        if self._stop_now is not None:
            self._stop_now()

    def take(self) -> Wish:
        """Return what was asked since the last call, the gravest stop or else the last word; the loop calls this."""
        asked = [self._wishes.popleft() for _ in range(len(self._wishes))]
        stops = (wish for wish in (Wish.EMERGENCY, Wish.STOP) if wish in asked)
        return next(stops, asked[-1] if asked else Wish.NONE)
