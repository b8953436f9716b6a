"""The control loop: the DAQ is its clock, one thread, no timers.

read -> convert -> interlocks -> record -> observers -> sequence
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError, SensorFault
from drivers.interfaces import Clock, Daq, Pump, PumpStatus, Stage, StageStatus
from rig.errors import FileError, Interlock, StoppedByOperator
from rig.interlocks import Interlocks
from rig.latency import Latencies
from rig.observe import Controls, Event, Observer, StepEvent, StepPhase, Wish
from rig.timebase import TimeBase
from sequences.frame import Frame

Array = NDArray[np.float64]
Sequencer = Generator[None, Frame, None]

PROGRESS_FRAMES = 5


class Converter(Protocol):
    """Volts to SI, and whether they can be believed."""

    def convert(self, volts: Array) -> tuple[Array, Array | None]:
        """Return force (N, untared, compression positive) and pressure (Pa gauge) or ``None``."""
        ...

    def check(self) -> None:
        """Raise ``SensorFault`` if the frame converted last cannot be true."""
        ...


class Store(Protocol):
    """Where a run is kept: the recorder, or in a replay what holds it against the recording."""

    def append(self, frame: Frame, height: Array, arrived: float) -> None:
        """Take a frame."""
        ...

    def step(self, event: StepEvent) -> None:
        """Take the beginning or the end of a step."""
        ...

    def event(self, event: Event) -> None:
        """Take a line of the log."""
        ...

    def prediction(self, sample: int, text: str) -> None:
        """Take a live prediction as JSON."""
        ...


@dataclass(frozen=True)
class Instruments:
    """What a run has open. ``pump`` is ``None`` in a scene without pressure."""

    stage: Stage
    pump: Pump | None
    daq: Daq
    clock: Clock


class Reporter:
    """Carries steps, events and predictions to store and observers. A failing observer is dropped, loudly."""

    def __init__(self, observers: Iterable[Observer] = ()) -> None:
        self.store: Store | None = None
        self._observers = list(observers)
        self._step = ""
        self._frames = 0
        self.sample = 0
        self._asked = False

    def add(self, observer: Observer) -> None:
        """Tell one more observer from now on."""
        self._observers.append(observer)

    @property
    def step(self) -> str:
        """Name of the step under way."""
        return self._step

    def started(self, name: str) -> None:
        """A step has begun."""
        self._step, self._frames = name, 0
        self._tell(StepEvent(StepPhase.STARTED, name, self.sample))

    def progress(self, value: float, target: float, unit: str) -> None:
        """The step gets on; observers hear of it a few times a second."""
        self._frames += 1
        if self._frames % PROGRESS_FRAMES == 1:
            self._tell(StepEvent(StepPhase.PROGRESS, self._step, self.sample, "", value, target, unit))

    def ended(self, name: str, outcome: str) -> None:
        """A step has ended."""
        self._tell(StepEvent(StepPhase.ENDED, name, self.sample, outcome))

    def note(self, text: str) -> None:
        """A line of the sequence."""
        self.event("note", text)

    def ask(self, text: str) -> None:
        """Ask the operator for a hand; the loop holds until the run is resumed."""
        self.event("prompt", text)
        self._asked = True

    def take_question(self) -> bool:
        """Return whether the operator was asked since the last call."""
        asked, self._asked = self._asked, False
        return asked

    def event(self, kind: str, text: str) -> None:
        """A line for the log."""
        event = Event(self.sample, kind, text)
        if self.store is not None:
            self.store.event(event)
        self.notify("event", event)

    def prediction(self, prediction: Any, text: str) -> None:
        """A live prediction, and its form in the recording."""
        if self.store is not None:
            self.store.prediction(self.sample, text)
        self.notify("prediction", prediction)

    def notify(self, what: str, subject: Any) -> None:
        """Tell every observer; one that raises hears nothing more, and the log says so."""
        for observer in tuple(self._observers):
            try:
                getattr(observer, what)(subject)
            except Exception as error:  # noqa: BLE001 - an observer must not stop the loop
                self._observers.remove(observer)
                self.event("warning", f"observer {type(observer).__name__} failed and was dropped: {error!r}")

    def _tell(self, event: StepEvent) -> None:
        if self.store is not None:
            self.store.step(event)
        self.notify("step", event)


class Loop:
    """One run of one sequence.

    Parameters
    ----------
    frame_samples
        Samples in a frame; a frame that comes late is followed by one longer by what has come in meanwhile.
    pump_frames
        The pump is polled once in so many frames.

    Attributes
    ----------
    samples
        Recorded so far.
    interlock_latency, stop_age
        From the frame read, and from the sample that passed the limit, to the stop sent, s; ``None`` without one.
    checks, ages
        From the frame read, and from its oldest sample, to the interlocks passed.
    """

    def __init__(
        self,
        instruments: Instruments,
        converter: Converter,
        interlocks: Interlocks,
        store: Store | None,
        reporter: Reporter,
        controls: Controls,
        *,
        frame_samples: int,
        pump_frames: int = 5,
    ) -> None:
        self._instruments = instruments
        self._converter = converter
        self._interlocks = interlocks
        self._store = store
        self._reporter = reporter
        self._controls = controls
        self._frame_samples = frame_samples
        self._pump_frames = pump_frames
        self._stage_status: StageStatus
        self._pump_status: PumpStatus | None = None
        self._holding = self._resumed = False
        self.samples = 0
        self._timebase: TimeBase
        self.interlock_latency: float | None = None
        self.stop_age: float | None = None
        self.checks = Latencies()
        self.ages = Latencies()

    def run(self, sequence: Sequencer) -> None:
        """Run until the sequence ends. Leaves the instruments as they are: the caller makes them safe.

        Raises
        ------
        Interlock
            A limit was passed.
        DeviceError
            An instrument failed.
        StepFailed
            A step could not reach its condition.
        StoppedByOperator
            The operator ended the run.
        """
        next(sequence)
        try:
            for frame in self._frames():
                self._reporter.notify("frame", frame)
                self._obey(self._controls.take())
                if not self._holding:
                    sequence.send(replace(frame, resumed=True) if self._resumed else frame)
                    self._resumed = False
                    self._holding = self._reporter.take_question()
        except StopIteration:
            return
        except BaseException:
            self._leave(sequence)
            raise

    def _leave(self, sequence: Sequencer) -> None:
        """Let the step stop what it started; if that fails too, the first failure stays the one that is told."""
        try:
            sequence.close()
        except Exception as error:  # noqa: BLE001 - whatever the driver raises, the safe state tries again
            self._reporter.event("fault", f"leaving step {self._reporter.step}: {error}")

    def _frames(self) -> Generator[Frame, None, None]:
        stage, daq, clock = self._instruments.stage, self._instruments.daq, self._instruments.clock
        self._stage_status = stage.status()
        daq.start()
        timebase = self._timebase = TimeBase(daq.rate)
        number = waiting = 0
        while True:
            volts = daq.read(self._frame_samples * (1 + waiting))
            arrived = clock()
            timebase.arrive(self.samples + volts.shape[1], volts.shape[1], arrived)
            force, pressure = self._checked(volts, arrived)
            try:
                self._stage_status = status = stage.status()
                pump_status = self._poll_pump(number)
            except Exception:
                self._keep_last(volts, force, pressure, arrived)
                raise
            frame = Frame(number, self.samples, daq.rate, volts, force, pressure, status, pump_status)
            waiting = int(self._take(frame, arrived) * daq.rate / self._frame_samples)
            yield frame
            number += 1

    def _checked(self, volts: Array, arrived: float) -> tuple[Array, Array | None]:
        """Convert and check before anything slower is done; a passed limit stops the stage here."""
        began = time.perf_counter()
        force, pressure = self._converter.convert(volts)
        try:
            self._converter.check()
            self._interlocks.check_signals(force, pressure)
        except (Interlock, SensorFault):
            self._stop_at_once()
            self.interlock_latency = time.perf_counter() - began
            self.stop_age = self._age(self._interlocks.first_beyond(force, pressure))
            self._keep_last(volts, force, pressure, arrived)
            raise
        self.checks.add(time.perf_counter() - began)
        self.ages.add(self._age(0))
        return force, pressure

    def _age(self, index: int) -> float:
        """Return how old a sample of the frame just read is by the bench's clock, s."""
        return self._timebase.age(self.samples + index, self._instruments.clock())

    def _keep_last(self, volts: Array, force: Array, pressure: Array | None, arrived: float) -> None:
        """Record the frame with which the run ends; stage or pump may have been polled last for the frame before.

        If that fails too, what has ended the run stays what is told of it.
        """
        status = self._stage_status
        frame = Frame(-1, self.samples, self._instruments.daq.rate, volts, force, pressure, status, self._pump_status)
        try:
            self._record(frame, np.full(force.size, status.position), arrived)
        except FileError as error:
            self._reporter.event("fault", str(error))
        self._reporter.notify("frame", frame)

    def _take(self, frame: Frame, arrived: float) -> float:
        """Return how late the frame was, s; what has come in meanwhile is read at once."""
        height = self._timebase.place(frame.start, frame.force.size, frame.stage)
        self._record(frame, height, arrived)
        lag = self._timebase.age(frame.stop, arrived)
        try:
            self._interlocks.check_motion(frame.stage, lag)
        except Interlock:
            self._stop_at_once()
            raise
        return lag

    def _stop_at_once(self) -> None:
        """Send the stop byte; where that fails the limit stays what ended the run, and the safe state tries again."""
        try:
            self._instruments.stage.emergency_stop()
        except DeviceError as error:
            self._reporter.event("fault", str(error))

    def _record(self, frame: Frame, height: Array, arrived: float) -> None:
        self.samples = self._reporter.sample = frame.stop
        if self._store is not None:
            self._store.append(frame, height, arrived)

    def _poll_pump(self, number: int) -> PumpStatus | None:
        pump = self._instruments.pump
        if pump is not None and number % self._pump_frames == 0:
            self._pump_status = pump.status()
        return self._pump_status

    def _obey(self, wish: Wish) -> None:
        if wish is Wish.NONE:
            return
        self._reporter.event("operator", wish.value)
        if wish is Wish.HOLD and not self._holding:
            self._holding = True
            self._instruments.stage.stop()
            if self._instruments.pump is not None:
                self._instruments.pump.stop()
        elif wish is Wish.RESUME:
            self._resumed, self._holding = self._holding, False
        elif wish in (Wish.STOP, Wish.EMERGENCY):
            raise StoppedByOperator(f"{wish.value} by the operator in step {self._reporter.step}")
