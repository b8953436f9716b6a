"""Run times as the median and the quartiles of repeats.

CPU time of this process where its clock is fine enough, so that other work on the machine does not enter the ratios.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

Result = TypeVar("Result")
clock = time.process_time if time.get_clock_info("process_time").resolution <= 1e-6 else time.perf_counter


class Timing(NamedTuple):
    """Seconds: the first call, and median and quartiles of the warm repeats."""

    first: float
    median: float
    lower: float
    upper: float

    def columns(self) -> dict[str, float]:
        """Return the seconds by the columns of a work-precision table."""
        return {f"{name}_s": seconds for name, seconds in self._asdict().items()}


def timed(function: Callable[[], Result], repeats: int) -> tuple[Result, Timing]:
    """Return the result and how long it took, first call and ``repeats`` warm ones apart."""
    begin = clock()
    result = function()
    first = clock() - begin
    seconds = [first]
    if repeats > 1:
        seconds = []
        for _ in range(repeats):
            begin = clock()
            function()
            seconds.append(clock() - begin)
    lower, median, upper = np.quantile(seconds, (0.25, 0.5, 0.75))
    return result, Timing(first, float(median), float(lower), float(upper))
