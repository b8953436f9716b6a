"""Where in a run the operator looks: at its end while it is live, anywhere in a replay."""

from __future__ import annotations

import math


class Playhead:
    """A place in a run, in samples. It moves by wall time times ``speed`` while it plays."""

    def __init__(self, *, live: bool) -> None:
        self.live = live
        self.playing = not live
        self.speed = 1.0
        self._place = 0.0

    @property
    def sample(self) -> int:
        """Index one past the last sample that is seen."""
        return int(self._place)

    def advance(self, elapsed: float, rate: float, end: int) -> int:
        """Let ``elapsed`` seconds of wall time pass and return the place; a live one is always at the end."""
        if self.live or (self.playing and math.isinf(self.speed)):
            self._place = end
        elif self.playing:
            self._place = min(self._place + elapsed * rate * self.speed, end)
        return self.sample

    def jump(self, sample: float, end: int) -> None:
        """Go to a sample."""
        self._place = min(max(0.0, sample), end)

    def step(self, samples: int, end: int) -> None:
        """Pause and go so many samples on, or back."""
        self.playing = False
        self.jump(self.sample + samples, end)
