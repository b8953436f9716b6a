"""Fault scripts: what goes wrong on the emulated bench, and when.

A script is a list of ``Fault``. Emulators ask ``Faults.active(device, kind)`` whenever they are about to answer;
the plant tells the script its sample count, and the run tells it which step has begun.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes
    ----------
    device
        ``"stage"``, ``"pump"``, ``"daq"``, ``"force"``, ``"pressure"`` or ``"supply"``.
    kind
        What goes wrong; each emulator lists its kinds in ``FAULTS``.
    at_sample
        Start at this sample of the plant.
    at_step
        Start when this step begins (its first occurrence) ...
    after_samples
        ... or this many samples later.
    for_samples
        End after so many samples; ``None`` is for ever.
    value
        A number the kind may need (seconds of delay, newtons, an error code).
    """

    device: str
    kind: str
    at_sample: int | None = None
    at_step: str | None = None
    after_samples: int = 0
    for_samples: int | None = None
    value: float = 0.0


class Faults:
    """The script being played; safe to ask from any thread."""

    def __init__(self, script: Iterable[Fault] = ()) -> None:
        self._lock = threading.RLock()  # a signal handler may stop the stage while its own thread is in here
        self._sample = 0
        self._starts: list[tuple[int, Fault]] = []
        self._waiting: list[Fault] = []
        for fault in script:
            self.add(fault)

    def add(self, fault: Fault) -> None:
        """Add a fault to the script; without ``at_sample`` and ``at_step`` it is active from now on."""
        with self._lock:
            if fault.at_step is not None:
                self._waiting.append(fault)
            else:
                start = self._sample if fault.at_sample is None else fault.at_sample
                self._starts.append((start + fault.after_samples, fault))

    def clear(self) -> None:
        """End every fault."""
        with self._lock:
            self._starts.clear()
            self._waiting.clear()

    def advance(self, sample: int) -> None:
        """The plant has reached this sample."""
        with self._lock:
            self._sample = sample

    def step_started(self, name: str) -> None:
        """A step of the sequence has begun."""
        with self._lock:
            begun = [fault for fault in self._waiting if fault.at_step == name]
            self._waiting = [fault for fault in self._waiting if fault.at_step != name]
            self._starts += [(self._sample + fault.after_samples, fault) for fault in begun]

    def active(self, device: str, kind: str) -> Fault | None:
        """Return the active fault of this kind, or ``None``. Cheap when the script is empty."""
        if not self._starts:
            return None
        with self._lock:
            for start, fault in self._starts:
                if (fault.device, fault.kind) == (device, kind) and self._has_begun(start, fault):
                    return fault
        return None

    @property
    def scheduled(self) -> bool:
        """Whether any fault has, or will have, its time; a cheap question."""
        return bool(self._starts)

    def during(self, device: str, kind: str, start: int, stop: int) -> list[tuple[int, int, Fault]]:
        """Return (first, last + 1, fault) of every fault of this kind that touches samples ``start`` to ``stop - 1``.

        Exact to the sample, whatever blocks the samples are produced in.
        """
        if not self._starts:
            return []
        with self._lock:
            spans = [
                (max(start, begin), min(stop, self._end(begin, fault)), fault)
                for begin, fault in self._starts
                if (fault.device, fault.kind) == (device, kind)
            ]
        return [(first, last, fault) for first, last, fault in spans if first < last]

    def _end(self, start: int, fault: Fault) -> int:
        return sys.maxsize if fault.for_samples is None else start + fault.for_samples

    def _has_begun(self, start: int, fault: Fault) -> bool:
        return start <= self._sample < self._end(start, fault)
