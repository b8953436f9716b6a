"""A running acquisition: the plant's samples on their way to the reader, at once or in real time, and its faults.

Free of any wire, like ``electronics``: the emulated DAQ and the direct back end read from the same object.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.emulated.electronics import Electronics, Refusal
from drivers.emulated.world import World

Array = NDArray[np.float64]

FAULTS: Mapping[str, str] = {
    "silent": "no sample is delivered while time goes on; reads time out",
    "slow": "every read answers `value` seconds late; the samples in between wait in the buffer",
    "partial": "a read times out after `value` samples (half of them when 0)",
    "overrun": "the buffer has been overwritten: -200279",
    "removed": "the device has been unplugged: -201003",
    "error_code": "reads fail with DAQmx error `value`",
}

OVERWRITTEN = "Attempted to read samples that are no longer available; they have been overwritten."
_ENDLESS = 10.0  # s; how long a read without a time-out waits for a device that is silent
_LARGEST_BLOCK = 1000


class Pace(Protocol):
    """How time passes while a reader waits."""

    def until(self, acquisition: Acquisition, samples: int, timeout: float) -> None:
        """Wait for so many samples, at most ``timeout`` seconds (negative: without end)."""
        ...

    def rest(self, acquisition: Acquisition, seconds: float) -> None:
        """Let time pass; what is sampled meanwhile goes to the buffer."""
        ...


class Acquisition:
    """One started task: produces samples into its buffer and hands them out.

    Parameters
    ----------
    buffer
        Samples per channel the buffer holds.
    total
        Samples of a finite acquisition; ``None`` is continuous.
    """

    def __init__(
        self, world: World, electronics: Electronics, pace: Pace, rate: float, buffer: int, total: int | None = None
    ) -> None:
        self.rate = rate
        self._world, self._electronics, self._pace = world, electronics, pace
        self._buffer, self._total = buffer, total
        self._blocks: deque[Array] = deque()
        self._nothing = np.empty((electronics.channels, 0))
        self._lock = threading.Lock()
        self._begun = False
        self._overwritten = False
        self.available = 0
        self.acquired = 0

    @property
    def position(self) -> int:
        """Index of the next sample to be read."""
        return self.acquired - self.available

    @property
    def done(self) -> bool:
        """Whether a finite acquisition has all its samples."""
        return self._total is not None and self.acquired >= self._total

    def produce(self, samples: int) -> None:
        """Move the plant on by ``samples`` and keep what the device makes of them."""
        if not self._begun:
            self._begun = True
            self._electronics.begin(self._world.sample)
        while samples > 0:
            count = min(samples, _LARGEST_BLOCK)
            volts = self._electronics.digitise(self._world.advance(count, self.rate))
            with self._lock:
                self._store(volts)
            samples -= count

    def read(self, samples: int, timeout: float) -> Array:
        """Return ``samples`` columns, or fewer if the time-out passes before they are there.

        Raises
        ------
        Refusal
            Overrun, removed device, or whatever the fault script says.
        """
        patience = _ENDLESS if timeout < 0 else timeout
        self.check()
        if self._fault("silent") is not None:
            self._pace.rest(self, patience)
            return self._take(0)
        if (value := self._fault("slow")) is not None:
            self._pace.rest(self, min(value, patience))
            if value > patience:
                return self._take(0)
        if (value := self._fault("partial")) is not None:
            self._pace.rest(self, patience)
            return self._take(min(samples, int(value) or samples // 2))
        if self._total is not None and self.position + samples > self._total:
            raise Refusal(-200278, "The finite acquisition has no more samples.", 0)
        self._pace.until(self, samples, timeout)
        self.check()
        return self._take(samples)

    def check(self) -> None:
        """Refuse if samples have been lost or the device is gone."""
        check_present(self._world)
        if (value := self._fault("error_code")) is not None:
            raise Refusal(int(value), f"The device reports error {int(value)}.", 0)
        if self._overwritten or self._fault("overrun") is not None:
            self._overwritten = True
            raise Refusal(-200279, OVERWRITTEN, 0)

    def _fault(self, kind: str) -> float | None:
        fault = self._world.faults.active("daq", kind)
        return None if fault is None else fault.value

    def _store(self, volts: Array) -> None:
        if self._total is not None:
            volts = volts[:, : max(self._total - self.acquired, 0)]
        self.acquired += volts.shape[1]
        if self._overwritten or not volts.size:
            return
        self._blocks.append(volts)
        self.available += volts.shape[1]
        if self.available > self._buffer:
            self._overwritten = True
            self._blocks.clear()
            self.available = 0

    def _take(self, samples: int) -> Array:
        with self._lock:
            if self._blocks and self._blocks[0].shape[1] == samples:
                taken = self._blocks.popleft()
            else:
                waiting = np.concatenate(self._blocks, axis=1) if self._blocks else self._nothing
                taken = waiting[:, :samples]
                self._blocks = deque([waiting[:, samples:]] if waiting.shape[1] > samples else [])
            self.available -= taken.shape[1]
            return taken


def check_present(world: World) -> None:
    """Refuse if the fault script has unplugged the device."""
    if world.faults.active("daq", "removed") is not None:
        raise Refusal(-201003, "Device cannot be accessed: it has been removed, or has lost its power.", 0)


class AtOnce:
    """Virtual time: the plant moves on by what is asked for, as fast as the processor allows."""

    def until(self, acquisition: Acquisition, samples: int, timeout: float) -> None:
        """Produce what is missing."""
        acquisition.produce(samples - acquisition.available)

    def rest(self, acquisition: Acquisition, seconds: float) -> None:
        """Produce so many seconds' samples."""
        acquisition.produce(round(seconds * acquisition.rate))


class RealTime:
    """Real time, ``speed`` times as fast: a thread moves the plant on, whether anybody reads or not.

    Parameters
    ----------
    world
        The plant.
    speed
        Plant seconds per second.
    idle_rate
        Sample rate while nothing is acquired, Hz.
    """

    _TICK = 0.005  # s

    def __init__(self, world: World, speed: float, idle_rate: float = 1000.0) -> None:
        if not (math.isfinite(speed) and speed > 0):
            raise ValueError(f"speed must be a positive number, not {speed}")
        self._world, self._speed, self._idle_rate = world, speed, idle_rate
        self._changed = threading.Condition()
        self._acquisition: Acquisition | None = None
        self._failure: Exception | None = None
        self._running = False
        self._thread = threading.Thread(target=self._run, name="plant", daemon=True)
        self._rebase()

    def start(self) -> None:
        """Start the plant's time."""
        self._running = True
        self._rebase()
        self._thread.start()

    def stop(self) -> None:
        """Stop the plant's time; raises what has gone wrong in it."""
        with self._changed:
            self._running = False
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()
        self._raise_failure()

    def attach(self, acquisition: Acquisition | None) -> None:
        """Let the plant feed this acquisition from now on (``None``: run idle)."""
        with self._changed:
            self._catch_up()
            self._acquisition = acquisition
            self._rebase()

    def until(self, acquisition: Acquisition, samples: int, timeout: float) -> None:
        """Wait for the samples."""
        end = math.inf if timeout < 0 else time.perf_counter() + timeout
        with self._changed:
            while self._catch_up() and acquisition is self._acquisition:
                missing = samples - acquisition.available
                left = end - time.perf_counter()
                if missing <= 0 or left <= 0 or acquisition.done:
                    return
                self._changed.wait(min(left, max(missing - self._owed(), 0.1) / (acquisition.rate * self._speed)))
                acquisition.check()

    def rest(self, acquisition: Acquisition, seconds: float) -> None:
        """Wait."""
        end = time.perf_counter() + seconds
        with self._changed:
            while self._running and (left := end - time.perf_counter()) > 0:
                self._changed.wait(left)

    def _run(self) -> None:
        with self._changed:
            while self._running and self._catch_up():
                self._changed.wait(self._TICK)

    def _rate(self) -> float:
        return self._acquisition.rate if self._acquisition else self._idle_rate

    def _rebase(self) -> None:
        self._origin, self._produced = time.perf_counter(), 0

    def _owed(self) -> float:
        """Samples that are due and not yet produced; a fraction at least."""
        return (time.perf_counter() - self._origin) * self._speed * self._rate() - self._produced

    def _catch_up(self) -> bool:
        """Produce what is due; whether time is still running. A failing plant ends it, and is told to every reader."""
        self._raise_failure()
        count = int(self._owed())
        if self._running and count > 0:
            try:
                if self._acquisition:
                    self._acquisition.produce(count)
                else:
                    self._world.advance(count, self._idle_rate)
            except Exception as error:
                self._failure = error
                self._running = False
                raise
            self._produced += count
        return self._running

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise RuntimeError(f"the emulated plant has failed: {self._failure!r}") from self._failure
