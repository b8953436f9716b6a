"""A world that only has signals: known functions of the sample's index, for the DAQ and its electronics."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drivers.daq import BridgeChannel, NIDaq, VoltageChannel
from drivers.emulated.daq import EmulatedDaq
from drivers.emulated.faults import Fault, Faults
from drivers.emulated.motion import Carriage, Plunger

Signal = Callable[[NDArray[np.int64]], NDArray[np.float64]]

RATE = 1000.0
FORCE = VoltageChannel("force", "Dev1/ai0")
PRESSURE = VoltageChannel("pressure", "Dev1/ai1", -5.0, 5.0)
SUPPLY = VoltageChannel("supply", "Dev1/ai2")
CHANNELS = (FORCE, PRESSURE, SUPPLY)
CHASSIS_CHANNELS = (
    BridgeChannel("force", "cDAQ1Mod1/ai0"),
    VoltageChannel("pressure", "cDAQ1Mod2/ai0", -5.0, 5.0),
    VoltageChannel("supply", "cDAQ1Mod2/ai1"),
)


def constant(value: float) -> Signal:
    return lambda index: np.full(index.size, value)


class SignalWorld:
    """Fits ``drivers.emulated.world.World``; ``force``, ``pressure`` and ``supply`` are functions of the index."""

    def __init__(self, *faults: Fault) -> None:
        self.lock = threading.RLock()
        self.faults = Faults(faults)
        self.sample = 0
        self.time = 0.0
        self.rates: list[float] = []
        self.force: Signal = constant(0.5)
        self.pressure: Signal = constant(-3200.0)
        self.supply: Signal = constant(5.02)
        self.axis = Carriage(lambda: self.time, 0.0, 1e-3, lambda: None)
        self.syringe = Plunger(lambda: self.time, 14.43e-3, lambda: 0.0, lambda: None)

    def advance(self, samples: int, rate: float) -> dict[str, NDArray[np.float64]]:
        with self.lock:
            index = np.arange(self.sample, self.sample + samples)
            self.sample += samples
            self.time += samples / rate
            self.rates.append(rate)
            self.faults.advance(self.sample)
            return {"force": self.force(index), "pressure": self.pressure(index), "supply": self.supply(index)}


def connect(
    server: EmulatedDaq, *channels: VoltageChannel | BridgeChannel, rate: float = RATE, **options: object
) -> NIDaq:
    """Return the started driver on this server."""
    daq = NIDaq(channels or CHANNELS, rate=rate, connection=server.connection, **options)  # type: ignore[arg-type]
    daq.start()
    return daq
