"""One block of samples and the polls that belong to it: what every step of a sequence receives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import PumpStatus, StageStatus

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Frame:
    """n samples of the DAQ in SI units, with the stage and pump polled once for it.

    Attributes
    ----------
    number
        Counts frames from 0.
    start
        Index of the first sample; time is index / rate.
    rate
        The DAQ's actual sample rate, Hz.
    volts
        (channels, n), as they came.
    force
        (n,), N at the load cell, untared, compression positive.
    pressure
        (n,), Pa gauge, or ``None`` where the scene has no pressure.
    stage
        The poll made right after the samples arrived.
    pump
        The poll made with it, or ``None``; may be older than the frame (``pump.received`` tells).
    resumed
        The first frame after a hold, which has stopped stage and pump; those of the hold reach no step.
    """

    number: int
    start: int
    rate: float
    volts: Array
    force: Array
    pressure: Array | None
    stage: StageStatus
    pump: PumpStatus | None = None
    resumed: bool = False

    @property
    def stop(self) -> int:
        """Index one past the last sample."""
        return self.start + self.force.size

    @property
    def time(self) -> float:
        """Time of the end of the frame, s."""
        return self.stop / self.rate
