"""Samples, polls and the clock: where the stage stood at each sample.

The DAQ counts samples and knows no clock; polls carry bench time. The earliest arrival of a frame, less index / rate,
is the offset between both: what comes later than that is late. Only as fast as two clocks can drift apart may the
offset rise, so a program that falls behind more and more does not take its own delay for the time.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import StageStatus

CLOCKS_APART = 2e-4
"""How much faster one clock may run: 50 ppm for the DAQ (NI 6211 specifications), 100 ppm for a computer, a margin."""


class TimeBase:
    """Maps sample indices to bench time and interpolates the stage onto the samples.

    Everything follows from the arguments of ``arrive`` and ``place``: a replay gives the same numbers to the bit.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._polls: deque[tuple[float, float]] = deque()
        self.offset = math.inf
        """Bench time of sample 0, s."""

    def arrive(self, stop: int, count: int, arrived: float) -> None:
        """Take note of when a frame came in."""
        self.offset = min(self.offset + CLOCKS_APART * count / self._rate, arrived - stop / self._rate)

    def place(self, start: int, count: int, stage: StageStatus) -> NDArray[np.float64]:
        """Return the stage's position at each sample of a frame, m, linear between the polls around it.

        In the first frame it is this poll's position.
        """
        times = self.offset + np.arange(start, start + count) / self._rate
        self._polls.append(_point(stage))
        while len(self._polls) > 2 and self._polls[1][0] <= times[0]:
            self._polls.popleft()
        moments, positions = zip(*self._polls, strict=True)
        height: NDArray[np.float64] = np.interp(times, moments, positions)
        return height

    def age(self, sample: int, moment: float) -> float:
        """Return how long before a moment a sample was taken, s; of a frame's end when it came: how late it was.

        What even the fastest frame took from the DAQ to the program cannot be seen.
        """
        return moment - sample / self._rate - self.offset


def _point(status: StageStatus) -> tuple[float, float]:
    return (status.sent + status.received) / 2, status.position
