"""Samples against the computer's clock: late data are seen, drifting clocks are not taken for it."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.interfaces import StageStatus
from rig.timebase import TimeBase

RATE = 1000.0
FRAME = 20
SPEED = 100e-6
"""m/s, of the stage in these tests."""


def poll(moment: float, delay: float = 1e-3) -> StageStatus:
    """Return what a stage that moves with constant speed answers."""
    return StageStatus(moment, moment + 2 * delay, SPEED * (moment + delay), True, False, True, False, False)


def lags(arrivals: np.ndarray) -> np.ndarray:
    """Return how late each of the frames is found to be that come in at these moments, s."""
    timebase = TimeBase(RATE)
    found = []
    for number, arrived in enumerate(arrivals.tolist()):
        timebase.arrive((number + 1) * FRAME, FRAME, arrived)
        found.append(timebase.age((number + 1) * FRAME, arrived))
    return np.array(found)


def due(frames: int, clock_error: float = 0.0) -> np.ndarray:
    """Return when the frames are ready by the computer's clock."""
    return 5.0 + np.arange(1, frames + 1) * FRAME / RATE * (1 + clock_error)


@pytest.mark.parametrize("excess", [1e-3, 0.1, 1.0])
def test_a_program_that_falls_behind_steadily_is_found_late_by_all_it_is_behind(excess: float) -> None:
    frames = 5000
    behind = excess * np.arange(frames) * FRAME / RATE
    assert lags(due(frames) + behind) == pytest.approx(behind, rel=0.25, abs=1e-9)


@pytest.mark.parametrize("clock_error", [-1e-4, 1e-4])
def test_clocks_that_drift_apart_for_an_hour_do_not_look_late(clock_error: float) -> None:
    delays = np.random.default_rng(1).exponential(2e-3, 180_000)
    late = lags(due(delays.size, clock_error) + delays) - delays
    assert np.abs(late).max() < 5e-3


def test_one_late_frame_is_late_and_the_next_in_time_is_not() -> None:
    arrivals = due(200)
    arrivals[100] += 0.3
    late = lags(arrivals)
    assert late[100] == pytest.approx(0.3, abs=1e-4)
    assert np.abs(np.delete(late, 100)).max() < 1e-4


def test_the_stage_is_placed_where_it_was_at_the_sample_even_if_the_frame_came_late() -> None:
    timebase = TimeBase(RATE)
    late = np.r_[np.zeros(50), np.linspace(0.0, 0.4, 50), np.full(50, 0.4)]
    arrivals = due(150) + late
    heights = []
    for number, arrived in enumerate(arrivals.tolist()):
        timebase.arrive((number + 1) * FRAME, FRAME, arrived)
        heights.append(timebase.place(number * FRAME, FRAME, poll(arrived)))
    true = SPEED * (5.0 + np.arange(FRAME, 150 * FRAME) / RATE)
    assert np.concatenate(heights[1:]) == pytest.approx(true, abs=SPEED * 2e-3)
