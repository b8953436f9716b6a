"""A recording in the place of the instruments: the same loop sees the same frames again."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import Identity, PumpStatus, StageStatus
from rig.layout import pieces, unpack_pump, unpack_stage
from rig.observe import Controls, Event, StepEvent, StepPhase, Wish
from rig.recording import Recording
from sequences.frame import Frame

Array = NDArray[np.float64]


class EndOfRecording(Exception):
    """The recording holds no further frame."""


class Pace:
    """How fast a replay goes: ``speed`` in times real time, ``math.inf`` as fast as possible."""

    def __init__(self, speed: float = math.inf) -> None:
        self._speed = speed
        self._begin: float | None = None

    def wait(self, sample: int, rate: float) -> None:
        """Block until the frame that ends at ``sample`` is due."""
        now, due = time.perf_counter(), sample / rate / self._speed
        if self._begin is None:
            self._begin = now - due
        time.sleep(max(0.0, self._begin + due - now))


class ReplayedDaq:
    """A ``Daq`` that hands out the recorded frames, and the clock that reads their arrival."""

    def __init__(self, recording: Recording, pace: Pace) -> None:
        self._recording = recording
        self._pace = pace
        self._frame = -1
        self.identity = Identity("recording", str(recording.path), "", "")

    @property
    def channels(self) -> tuple[str, ...]:
        """See ``Daq``."""
        return self._recording.channels

    @property
    def units(self) -> tuple[str, ...]:
        """See ``Daq``."""
        return self._recording.units

    @property
    def rate(self) -> float:
        """See ``Daq``."""
        return self._recording.rate

    def start(self) -> None:
        """See ``Daq``."""

    def read(self, samples: int) -> Array:
        """Return the next recorded frame, whatever its length.

        Raises
        ------
        EndOfRecording
            There is none.
        """
        del samples
        self._frame += 1
        if self._frame >= len(self._recording.frames):
            raise EndOfRecording
        row = self._recording.frames[self._frame]
        start, count = int(row["start"]), int(row["samples"])
        self._pace.wait(start + count, self.rate)
        return np.ascontiguousarray(self._recording.volts[:, start : start + count])

    def clock(self) -> float:
        """Return when the present frame arrived, s."""
        return float(self._recording.frames[max(self._frame, 0)]["arrived_s"])

    def stop(self) -> None:
        """See ``Daq``."""

    def close(self) -> None:
        """See ``Daq``."""


class ReplayedStage:
    """A ``Stage`` that answers the recorded polls and does nothing it is told."""

    def __init__(self, recording: Recording) -> None:
        self._rows = recording.stage
        self._next = 0
        limits = recording.info["limits"]
        self.travel = (float(limits["travel_low_m"]), float(limits["travel_high_m"]))
        self.identity = Identity("recording", recording.info["identities"].get("stage", ""), "", "")
        self.referenced = True

    def status(self) -> StageStatus:
        """Return the next recorded poll; the one before the first frame is not recorded and is the first again."""
        index = min(max(self._next - 1, 0), len(self._rows) - 1)
        self._next += 1
        if index < 0 or (index > 0 and self._rows[index] == self._rows[index - 1]):
            raise EndOfRecording  # the poll failed: the last frame was kept with the one before
        return unpack_stage(self._rows[index])

    def reference(self) -> None:
        """See ``Stage``."""

    def servo(self, on: bool) -> None:
        """See ``Stage``."""

    def set_speed(self, speed: float) -> None:
        """See ``Stage``."""

    def move_to(self, position: float) -> None:
        """See ``Stage``."""

    def stop(self) -> None:
        """See ``Stage``."""

    def emergency_stop(self) -> None:
        """See ``Stage``."""

    def close(self) -> None:
        """See ``Stage``."""


class ReplayedPump:
    """A ``Pump`` that answers the recorded polls and does nothing it is told."""

    def __init__(self, recording: Recording) -> None:
        self._rows = recording.pump if recording.pump is not None else np.empty(0)
        self._next = -1
        limits = recording.info["limits"]
        self.rate_limits = (float(limits["pump_slowest_m3_s"]), float(limits["pump_fastest_m3_s"]))
        self.identity = Identity("recording", recording.info["identities"].get("pump", ""), "", "")

    def status(self) -> PumpStatus:
        """Return the next recorded poll."""
        self._next += 1
        if self._next >= len(self._rows):
            raise EndOfRecording
        return unpack_pump(self._rows[self._next])

    def dispense(self, volume: float, rate: float) -> None:
        """See ``Pump``."""

    def stop(self) -> None:
        """See ``Pump``."""

    def close(self) -> None:
        """See ``Pump``."""


class ReplayedControls(Controls):
    """What the operator asked for then, at the same frames."""

    def __init__(self, recording: Recording, sample: Callable[[], int], now: Controls | None = None) -> None:
        super().__init__()
        self._now = now
        self._sample = sample
        self._asked_then = [
            (int(row["sample"]), Wish(row["text"].decode())) for row in recording.events if row["kind"] == b"operator"
        ]

    def take(self) -> Wish:
        """Return what was asked at this frame then, or what is asked now."""
        if self._asked_then and self._asked_then[0][0] <= self._sample():
            return self._asked_then.pop(0)[1]
        return Wish.NONE if self._now is None else self._now.take()


@dataclass
class Verification:
    """A store that holds everything a replay derives against the recording, bit by bit."""

    recording: Recording
    differences: list[str] = field(default_factory=list)
    frames: int = 0
    predictions: int = 0
    _steps: list[tuple[Any, ...]] = field(default_factory=list)
    _events: list[tuple[int, str, str]] = field(default_factory=list)

    def append(self, frame: Frame, height: Array, arrived: float) -> None:
        """Compare a frame's derived signals."""
        self.frames += 1
        part = slice(frame.start, frame.stop)
        self._compare("force", frame.force, self.recording.force[part], frame.start)
        self._compare("height", height, self.recording.height[part], frame.start)
        if frame.pressure is not None and self.recording.pressure is not None:
            self._compare("pressure", frame.pressure, self.recording.pressure[part], frame.start)

    def step(self, event: StepEvent) -> None:
        """Keep a step for ``finish``."""
        if event.phase is not StepPhase.PROGRESS:
            self._steps.append((event.sample, event.phase.value, event.name, event.outcome))

    def event(self, event: Event) -> None:
        """Keep a derived line of the log for ``finish``."""
        if event.kind in _DERIVED:
            self._events += [(event.sample, event.kind, piece) for piece in pieces(event.text)]

    def prediction(self, sample: int, text: str) -> None:
        """Compare a live prediction, its run time aside."""
        if self.predictions < len(self.recording.predictions):
            row = self.recording.predictions[self.predictions]
            if int(row["sample"]) != sample or _timeless(row["json"].decode()) != _timeless(text):
                self.differences.append(f"live prediction {self.predictions} at sample {sample} differs")
        self.predictions += 1

    def finish(self, *, predictions: bool = True) -> list[str]:
        """Compare steps, log and counts; return every difference found, in words."""
        recording = self.recording
        steps = [(int(r["sample"]), *(r[k].decode() for k in ("phase", "name", "outcome"))) for r in recording.steps]
        events = [
            (int(row["sample"]), kind, row["text"].decode(errors="ignore"))
            for row in recording.events
            if (kind := row["kind"].decode()) in _DERIVED
        ]
        self._compare_lists("step", self._steps, steps)
        self._compare_lists("log line", self._events, events)
        counts = [("frames", self.frames, len(recording.frames))]
        if predictions:
            counts.append(("live predictions", self.predictions, len(recording.predictions)))
        for what, count, recorded in counts:
            if count != recorded:
                self.differences.append(f"{recorded} {what} recorded, {count} replayed")
        return self.differences

    def _compare(self, what: str, ours: Array, recorded: Array, start: int) -> None:
        if ours.tobytes() != recorded.tobytes():
            self.differences.append(f"{what} differs in the frame at sample {start}")

    def _compare_lists(self, what: str, ours: list[Any], recorded: list[Any]) -> None:
        for mine, theirs in zip(ours, recorded, strict=False):
            if mine != theirs:
                self.differences.append(f"{what} differs: recorded {theirs}, replayed {mine}")
                return
        if len(ours) != len(recorded):
            self.differences.append(f"{len(recorded)} {what}s recorded, {len(ours)} replayed")


_DERIVED = {"note", "command", "operator", "prompt"}


def _timeless(text: str) -> Any:
    content = json.loads(text)
    content.pop("runtime_s", None)
    return content
