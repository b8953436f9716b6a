"""A growing signal with the least and greatest value of every block: any stretch is drawn in constant time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FANOUT = 4
"""Each level has a quarter of the blocks of the one below."""
_FIRST = 4096


class _Growing:
    """An array that grows by doubling."""

    def __init__(self, rows: int) -> None:
        self._held: Array = np.empty((rows, _FIRST))
        self.size = 0

    def extend(self, values: Array) -> None:
        needed = self.size + values.shape[1]
        if needed > self._held.shape[1]:
            grown = np.empty((self._held.shape[0], max(needed, 2 * self._held.shape[1])))
            grown[:, : self.size] = self._held[:, : self.size]
            self._held = grown
        self._held[:, self.size : needed] = values
        self.size = needed

    @property
    def values(self) -> Array:
        return self._held[:, : self.size]


class Pyramid:
    """An append-only signal.

    ``extend`` costs time in proportion to what is new, ``view`` in proportion to what is asked for, neither to what is
    held. Level 0 is the signal; level k holds (least, greatest) of blocks of ``FANOUT**k`` samples, complete ones only.
    """

    def __init__(self) -> None:
        self._signal = _Growing(1)
        self._levels: list[_Growing] = []

    def __len__(self) -> int:
        return self._signal.size

    @property
    def values(self) -> Array:
        """(n,), the signal; a view, valid until the next ``extend``."""
        values: Array = self._signal.values[0]
        return values

    def extend(self, values: Array) -> None:
        """Append samples."""
        self._signal.extend(np.asarray(values, dtype=np.float64)[np.newaxis])
        below, level = self._signal, 0
        while below.size >= FANOUT:
            if level == len(self._levels):
                self._levels.append(_Growing(2))
            here = self._levels[level]
            complete = below.size // FANOUT
            if complete == here.size:
                return
            fresh = below.values[:, here.size * FANOUT : complete * FANOUT]
            blocks = fresh.reshape(fresh.shape[0], -1, FANOUT)
            here.extend(np.stack([blocks[0].min(axis=1), blocks[-1].max(axis=1)]))
            below, level = here, level + 1

    def view(self, start: int, stop: int, blocks: int) -> tuple[Array, Array, Array]:
        """Return index (of each block's middle), least and greatest value of ``start`` to ``stop``.

        At most about ``FANOUT * blocks`` blocks are returned. While the stretch holds no more samples than that, they
        are the samples themselves. The stretch is widened to whole blocks; what is newer than the last complete block
        is one block of its own.
        """
        start, stop = max(0, start), min(len(self), stop)
        if stop <= start:
            return np.empty(0), np.empty(0), np.empty(0)
        level = 0
        while level < len(self._levels) and (stop - start) // FANOUT**level > FANOUT * blocks:
            level += 1
        if level == 0:
            signal = self.values[start:stop]
            return np.arange(start, stop, dtype=np.float64), signal, signal
        size = FANOUT**level
        first, last = start // size, min(-(-stop // size), self._levels[level - 1].size)
        least, greatest = self._levels[level - 1].values[:, first:last]
        index = (np.arange(first, last) + 0.5) * size
        tail = self.values[last * size : stop]
        if tail.size:
            index = np.append(index, last * size + tail.size / 2)
            least, greatest = np.append(least, tail.min()), np.append(greatest, tail.max())
        return index, least, greatest


def polyline(x: Array, least: Array, greatest: Array) -> tuple[Array, Array]:
    """Return a zigzag through the least and greatest value of each block: the same pixels, few points."""
    if least is greatest:
        return x, least
    y = np.empty(2 * x.size)
    y[0::4], y[1::4] = least[0::2], greatest[0::2]
    y[2::4], y[3::4] = greatest[1::2], least[1::2]
    return np.repeat(x, 2), y
