"""Samples, polls and the clock: where the stage stood at each sample.

The DAQ counts samples and knows no clock; polls carry bench time. The earliest arrival seen in a window of frames,
less index / rate, is the offset between both: late arrivals are ignored rather than averaged.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import StageStatus

WINDOW_FRAMES = 64


class TimeBase:
    """Maps sample indices to bench time and interpolates the stage onto the samples.

    Everything follows from the arguments of ``place``, so that a replay gives the same numbers to the bit.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._offsets: deque[float] = deque(maxlen=WINDOW_FRAMES)
        self._last: tuple[float, float] | None = None

    @property
    def offset(self) -> float:
        """Bench time of sample 0, s: the lower envelope over the window."""
        return min(self._offsets)

    def place(self, start: int, count: int, arrived: float, stage: StageStatus) -> NDArray[np.float64]:
        """Return the stage's position at each sample of a frame, m, linear between the poll before and this one.

        In the first frame it is this poll's position.
        """
        self._offsets.append(arrived - (start + count) / self._rate)
        now = _point(stage)
        times = self.offset + np.arange(start, start + count) / self._rate
        last = self._last or now
        height = np.interp(times, (last[0], now[0]), (last[1], now[1]))
        self._last = now
        return height

    def lag(self, stop: int, arrived: float) -> float:
        """Return how much later than the earliest in the window a frame came, s."""
        return arrived - stop / self._rate - self.offset


def _point(status: StageStatus) -> tuple[float, float]:
    return (status.sent + status.received) / 2, status.position
