"""Noise and drift that belong to a sample's index and to plant time, however the samples are asked for."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

BLOCK = 4096


class NoiseStream:
    """White noise of several channels by sample index: the same index always gets the same numbers.

    Parameters
    ----------
    seed
        Chooses the stream.
    scales
        Standard deviation of each channel.
    """

    def __init__(self, seed: int, scales: tuple[float, ...]) -> None:
        self._seed = seed
        self._scales = np.array(scales)[:, None]
        self._number = -1
        self._block = np.empty((len(scales), 0))

    def take(self, start: int, stop: int) -> NDArray[np.float64]:
        """Return the noise of samples ``start`` to ``stop - 1``, shape (channels, samples)."""
        first, last = start // BLOCK, max(stop - 1, start) // BLOCK
        if first == last:
            offset = first * BLOCK
            return self._load(first)[:, start - offset : stop - offset]
        pieces = [
            self._load(number)[:, max(start - number * BLOCK, 0) : stop - number * BLOCK]
            for number in range(first, last + 1)
        ]
        return np.concatenate(pieces, axis=1)

    def _load(self, number: int) -> NDArray[np.float64]:
        if number != self._number:
            generator = np.random.default_rng([self._seed, number])
            self._block = generator.standard_normal((len(self._scales), BLOCK)) * self._scales
            self._number = number
        return self._block


class Drift:
    """A slow drift: a straight line and three incommensurate slow waves of random phase, zero at time zero."""

    PERIODS = (197.0, 611.0, 1789.0)

    def __init__(self, generator: np.random.Generator, slope: float, wander: float) -> None:
        self._slope = slope * float(generator.normal())
        self._waves = [
            (wander * float(generator.normal()), 2 * math.pi / period, float(generator.uniform(0, 2 * math.pi)))
            for period in self.PERIODS
        ]
        self._zero = 0.0
        self._zero = self.at(0.0)

    def at(self, time: float) -> float:
        """Return the drift at plant time ``time``, s."""
        value = self._slope * time - self._zero
        for amplitude, frequency, phase in self._waves:
            value += amplitude * math.sin(frequency * time + phase)
        return value
