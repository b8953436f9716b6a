"""How long the loop takes to act on a frame: counted in a histogram, so that a run of days costs no memory."""

from __future__ import annotations

import math

_SHORTEST = 1e-6
_PER_OCTAVE = 8
_BINS = 30 * _PER_OCTAVE


class Latencies:
    """Durations by size; a quantile is exact to a twelfth (an eighth of an octave)."""

    def __init__(self) -> None:
        self._counts = [0] * _BINS
        self.count = 0
        self.worst = 0.0

    def add(self, seconds: float) -> None:
        """Count one."""
        octaves = math.log2(max(seconds, _SHORTEST) / _SHORTEST)
        self._counts[min(int(octaves * _PER_OCTAVE), _BINS - 1)] += 1
        self.count += 1
        self.worst = max(self.worst, seconds)

    def quantile(self, share: float) -> float:
        """Return a duration that this share of all does not exceed, s; 0 if nothing has been counted."""
        left = math.ceil(share * self.count)
        for number, count in enumerate(self._counts):
            left -= count
            if left <= 0:
                return min(_SHORTEST * 2 ** ((number + 1) / _PER_OCTAVE), self.worst)
        return self.worst

    def describe(self) -> str:
        """Return median, 99 % and worst in ms."""
        return f"p50 {self.quantile(0.5) * 1e3:.2f}, p99 {self.quantile(0.99) * 1e3:.2f}, max {self.worst * 1e3:.2f} ms"
