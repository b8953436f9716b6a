"""Live prediction beside a run: an observer that watches frames and tells predictions, and never delays the loop.

In virtual time a prediction is made on the loop's thread at fixed frames: the run's time stands still meanwhile, and
runs stay identical. In real time a process of its own makes the next one as soon as the last is ready.
"""

from __future__ import annotations

import json
import signal
import threading
from collections import deque
from collections.abc import Callable, Sequence
from multiprocessing import get_context
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Protocol

from model.parameters import Parameters
from rig.live import UPDATES, LivePredictor
from rig.live_data import Gathering, Glance
from rig.live_prediction import LivePrediction
from rig.observe import Ending, Observer, StepEvent, StepPhase
from sequences.frame import Frame

MOST_WAITING = 50_000
"""Frames the process may be behind before it is given up."""

Tell = Callable[[LivePrediction, str], None]
"""Takes a prediction and the form of it that a recording keeps."""


class Maker(Protocol):
    """Makes predictions out of steps and frames."""

    def step(self, event: StepEvent) -> None:
        """Take in a step."""
        ...

    def frame(self, glance: Glance) -> LivePrediction | None:
        """Take in a frame; return a prediction when there is a new one."""
        ...

    def close(self) -> None:
        """Give up what is held."""
        ...


class Live(Observer):
    """The observer. ``tell`` is called on the loop's thread (``Reporter.prediction``)."""

    def __init__(self, maker: Maker, tell: Tell) -> None:
        self._maker = maker
        self._tell = tell

    def step(self, event: StepEvent) -> None:
        """Take in a step."""
        if event.phase is StepPhase.STARTED:
            self._maker.step(event)

    def frame(self, frame: Frame) -> None:
        """Take in a frame and tell a prediction if there is one."""
        prediction = self._maker.frame(Glance.at(frame))
        if prediction is not None:
            self._tell(prediction, prediction.to_json())

    def finished(self, ending: Ending) -> None:
        """The run is over."""
        self._maker.close()


def live(parameters: Parameters, tell: Tell, *, virtual: bool, compliance: float = 0.0) -> Live:
    """Return the observer for a run: beside the loop in real time, at fixed frames in virtual time."""
    maker = Inline(parameters, compliance) if virtual else Beside(parameters, compliance)
    return Live(maker, tell)


def live_again(
    parameters: Parameters, tell: Tell, recorded: Sequence[tuple[int, str]], *, compliance: float = 0.0
) -> Live:
    """Return the observer for a replay: it makes every recorded prediction (sample, JSON) again, from the same frames.

    It tells each at the sample it was told at, so that the operator sees what was seen.
    """
    return Live(Again(parameters, compliance, recorded), tell)


def live_what_if(parameters: Parameters, tell: Tell, *, model: str = "cone", compliance: float = 0.0) -> Live:
    """Return the observer for a replay that asks what another model or other values would have said."""
    return Live(Inline(parameters, compliance, model), tell)


class _Schedule:
    """A prediction is due at P_0, and whenever the stage has gone another part of the predicted way."""

    def __init__(self) -> None:
        self._next = -float("inf")

    def due(self, gathering: Gathering) -> bool:
        return gathering.retracting and not gathering.gone and gathering.frames > 0 and gathering.height >= self._next

    def made(self, gathering: Gathering, prediction: LivePrediction | None) -> None:
        way = 1e-3 if prediction is None else max(prediction.pull_off_distance.value, 1e-4)
        self._next = gathering.height + way / UPDATES


class Inline:
    """Makes predictions on the caller's thread, at frames that depend on the data alone."""

    def __init__(self, parameters: Parameters, compliance: float, model: str = "cone") -> None:
        self._gathering = Gathering()
        self._predictor = LivePredictor(parameters, compliance=compliance, model=model)
        self._schedule = _Schedule()

    def step(self, event: StepEvent) -> None:
        """See ``Maker``."""
        self._gathering.step(event)

    def frame(self, glance: Glance) -> LivePrediction | None:
        """See ``Maker``."""
        self._gathering.add(glance)
        if not self._schedule.due(self._gathering):
            return None
        prediction = self._predictor.predict(self._gathering.evidence())
        self._schedule.made(self._gathering, prediction)
        return prediction

    def close(self) -> None:
        """See ``Maker``."""


class Again:
    """Makes recorded predictions again: from the frames each one names, told when it was told."""

    def __init__(self, parameters: Parameters, compliance: float, recorded: Sequence[tuple[int, str]]) -> None:
        self._gathering = Gathering()
        self._predictor = LivePredictor(parameters, compliance=compliance)
        self._told = [sample for sample, _ in recorded]
        self._frames = [int(json.loads(text)["frame"]) for _, text in recorded]
        self._made: deque[LivePrediction | None] = deque()

    def step(self, event: StepEvent) -> None:
        """See ``Maker``."""
        self._gathering.step(event)

    def frame(self, glance: Glance) -> LivePrediction | None:
        """See ``Maker``."""
        self._gathering.add(glance)
        if self._frames and glance.number >= self._frames[0]:
            self._frames.pop(0)
            self._made.append(self._predictor.predict(self._gathering.evidence()))
        if self._made and glance.stop >= self._told[0]:
            self._told.pop(0)
            return self._made.popleft()
        return None

    def close(self) -> None:
        """See ``Maker``."""


class Beside:
    """Makes predictions in a process of its own, of whatever has come when the last one is ready.

    A frame costs the caller one entry in a queue. A thread writes the queue to the process: should that be frozen, the
    thread waits, not the loop.
    """

    def __init__(self, parameters: Parameters, compliance: float) -> None:
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_work, args=(theirs, parameters, compliance), daemon=True, name="live prediction"
        )
        self._process.start()
        theirs.close()
        self._queue: SimpleQueue[object] = SimpleQueue()
        self._feeder = threading.Thread(target=self._feed, daemon=True, name="live prediction feed")
        self._feeder.start()
        self.lost = False
        """Whether the process has died or is hopelessly behind."""

    def step(self, event: StepEvent) -> None:
        """See ``Maker``."""
        self._put({"step": event.name, "sample": event.sample})

    def frame(self, glance: Glance) -> LivePrediction | None:
        """See ``Maker``.

        Raises
        ------
        ChildProcessError
            The process has died or is hopelessly behind; there will be no more predictions.
        """
        self._put({"frame": glance})
        try:
            if not self.lost:
                return LivePrediction.from_json(self._pipe.recv_bytes().decode()) if self._pipe.poll() else None
        except (EOFError, OSError):
            self.lost = True
        self.close()
        raise ChildProcessError("the process of the live prediction has died or fallen behind; the run goes on without")

    def _put(self, message: object) -> None:
        if self._queue.qsize() > MOST_WAITING:
            self.lost = True
        if not self.lost:
            self._queue.put(message)

    def _feed(self) -> None:
        try:
            while (message := self._queue.get()) is not None:
                self._pipe.send_bytes(json.dumps(message).encode())
        except OSError:
            self.lost = True

    def close(self) -> None:
        """See ``Maker``."""
        self._queue.put(None)
        self._process.kill()  # it holds nothing, and may be frozen
        self._process.join()
        self._feeder.join()
        self._pipe.close()
        self._process.close()


def _work(pipe: Connection, parameters: Parameters, compliance: float) -> None:
    """Read on one thread, predict on another: the pipe is empty even while a prediction takes its time."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is the run's business
    gathering, schedule = Gathering(), _Schedule()
    lock, news, over = threading.Lock(), threading.Event(), threading.Event()

    def read() -> None:
        try:
            while True:
                message = json.loads(pipe.recv_bytes())
                with lock:
                    if "step" in message:
                        gathering.step(StepEvent(StepPhase.STARTED, message["step"], message["sample"]))
                    else:
                        gathering.add(Glance(*message["frame"]))
                news.set()
        except (EOFError, OSError):
            over.set()
            news.set()

    threading.Thread(target=read, daemon=True, name="live frames").start()
    predictor = LivePredictor(parameters, compliance=compliance)
    while True:
        news.wait()
        news.clear()
        if over.is_set():
            return
        with lock:
            evidence = gathering.evidence() if schedule.due(gathering) else None
        if evidence is None:
            continue
        prediction = predictor.predict(evidence)
        with lock:
            schedule.made(gathering, prediction)
        if prediction is not None:
            try:
                pipe.send_bytes(prediction.to_json().encode())
            except OSError:
                return
