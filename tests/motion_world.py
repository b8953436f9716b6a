"""A world that only moves: a carriage and a plunger on a clock the test turns, nothing to touch."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

from drivers.emulated.faults import Fault, Faults
from drivers.emulated.motion import Carriage, Plunger


class MotionWorld:
    """Fits ``drivers.emulated.world.World``."""

    def __init__(self, position: float = 22e-3, diameter: float = 14.43e-3, lag: float = 1e-3) -> None:
        self.lock = threading.RLock()
        self.faults = Faults()
        self.time = 0.0
        self.sample = 0
        self.pressure = 0.0
        self.axis = Carriage(lambda: self.time, position, lag, lambda: None)
        self.syringe = Plunger(lambda: self.time, diameter, lambda: self.pressure, lambda: None)

    def advance(self, samples: int, rate: float) -> dict[str, NDArray[np.float64]]:
        with self.lock:
            self.time += samples / rate
            self.sample += samples
            self.faults.advance(self.sample)
        return {"force": np.zeros(samples), "pressure": np.zeros(samples), "supply": np.full(samples, 5.0)}

    def pass_time(self, seconds: float) -> None:
        """Let time pass at 1 kHz."""
        self.advance(round(seconds * 1000), 1000.0)

    def fail(self, device: str, kind: str, value: float = 0.0) -> None:
        """Begin a fault now."""
        self.faults.add(Fault(device, kind, value=value))
