"""Trajectories and the plunger in closed form: nothing is stepped, so everything must hold at any time."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.emulated.motion import Carriage, Plunger, Trajectory, brake, trapezoid

position = st.floats(-5e-3, 5e-3)
velocity = st.floats(-0.02, 0.02)
speed = st.floats(1e-6, 0.02)
acceleration = st.floats(1e-3, 1.0)


def states(trajectory: Trajectory, until: float) -> tuple[np.ndarray, np.ndarray]:
    times = np.linspace(trajectory[0].start, until, 400)
    found = [next(s for s in reversed(trajectory) if s.start <= time).at(time) for time in times]
    places, speeds = np.array(found).T
    return places, speeds


@given(position, velocity, position, speed, acceleration, acceleration)
@settings(max_examples=300, deadline=None)
def test_a_move_ends_on_target_without_a_jump(x, v, target, fastest, up, down):
    trajectory = trapezoid(1.0, x, v, target, fastest, up, down)
    assert trajectory[-1].position == target
    assert trajectory[-1].velocity == trajectory[-1].acceleration == 0.0
    for before, after in itertools.pairwise(trajectory):
        assert after.start >= before.start
        place, pace = before.at(after.start)
        assert place == pytest.approx(after.position, abs=1e-9)
        assert pace == pytest.approx(after.velocity, abs=1e-7)
    first = trajectory[0]
    if len(trajectory) > 1:
        assert (first.position, first.velocity) == (x, pytest.approx(v, abs=1e-12))


@given(position, velocity, position, speed, acceleration, acceleration)
@settings(max_examples=200, deadline=None)
def test_speed_and_acceleration_stay_within_bounds(x, v, target, fastest, up, down):
    trajectory = trapezoid(0.0, x, v, target, fastest, up, down)
    _, speeds = states(trajectory, trajectory[-1].start + 1e-3)
    assert np.all(np.abs(speeds) <= max(abs(v), fastest) * (1 + 1e-9))
    assert all(abs(s.acceleration) in (0.0, up, down) for s in trajectory)


def test_a_redirected_move_overshoots_only_by_its_braking_distance():
    trajectory = trapezoid(0.0, 0.0, 1e-2, 1e-5, 1e-2, 0.1, 0.1)
    places, _ = states(trajectory, trajectory[-1].start)
    assert places.max() == pytest.approx(1e-2**2 / 2 / 0.1, rel=1e-3)
    assert trajectory[-1].position == 1e-5


def test_braking():
    end = brake(2.0, 1e-3, -4e-3, 0.1)[-1]
    assert end.start == pytest.approx(2.04)
    assert end.position == pytest.approx(1e-3 - 4e-3**2 / 0.2)
    assert brake(2.0, 1e-3, -4e-3, math.inf) == ((2.0, 1e-3, 0.0, 0.0),)


class Clock:
    time = 0.0

    def __call__(self) -> float:
        return self.time


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_the_carriage_lags_and_arrives(clock):
    carriage = Carriage(clock, 0.0, 3e-3, lambda: None)
    carriage.move(1e-3, 1e-3, 0.1, 0.1)
    clock.time = 0.5
    assert carriage.commanded - carriage.position == pytest.approx(3e-6, rel=1e-6)
    assert carriage.moving
    clock.time = 3.0
    assert carriage.position == carriage.target == 1e-3
    assert not carriage.moving
    assert carriage.velocity == 0.0


def test_the_true_position_never_jumps(clock):
    """Moves, redirections, halts and a block: the lagging position is continuous through all of them."""
    carriage = Carriage(clock, 0.0, 3e-3, lambda: None)
    commands = {
        100: lambda: carriage.move(5e-3, 5e-3, 0.1, 0.1),
        400: lambda: carriage.move(-1e-3, 2e-3, 0.1, 0.05),
        700: lambda: carriage.halt(math.inf),
        800: lambda: carriage.move(4e-3, 5e-3, 0.1, 0.1),
        900: lambda: carriage.block(True),
        1000: lambda: carriage.block(False),
        1300: lambda: carriage.halt(0.02),
    }
    places = []
    for step in range(2000):
        clock.time = step * 1e-3
        before = carriage.position
        if step in commands:
            commands[step]()
        assert carriage.position == pytest.approx(before, abs=1e-12)
        places.append(carriage.position)
    pace = np.abs(np.diff(places)) / 1e-3
    assert pace[:900].max() <= 5e-3 * 1.01
    assert np.ptp(places[900:1000]) == 0.0


def test_a_blocked_carriage_stays_while_the_trajectory_runs_on(clock):
    carriage = Carriage(clock, 0.0, 3e-3, lambda: None)
    carriage.move(5e-3, 5e-3, 0.1, 0.1)
    clock.time = 0.2
    held = carriage.position
    carriage.block(True)
    clock.time = 0.6
    assert carriage.position == held
    assert carriage.commanded - held > 1e-3


@pytest.mark.parametrize("move", [(0.0, 0.1, 0.1), (1e-3, 0.0, 0.1), (1e-3, 0.1, -1.0)])
def test_impossible_moves_are_refused(clock, move):
    with pytest.raises(ValueError, match="must be > 0"):
        Carriage(clock, 0.0, 1e-3, lambda: None).move(1e-3, *move)


def test_the_plunger_stops_at_its_target(clock):
    plunger = Plunger(clock, 14.43e-3, lambda: 0.0, lambda: None)
    plunger.run(-1e-7, 2e-7)
    clock.time = 1.0
    assert plunger.rate == -1e-7
    assert plunger.volume == pytest.approx(-1e-7)
    clock.time = 5.0
    assert plunger.rate == 0.0
    assert plunger.volume == pytest.approx(-2e-7)
    plunger.run(1e-7, None)
    clock.time = 6.0
    plunger.stop()
    clock.time = 9.0
    assert plunger.volume == pytest.approx(-1e-7)


def test_a_wrong_diameter_counts_wrong_and_delivers_by_the_true_one(clock):
    plunger = Plunger(clock, 14e-3, lambda: 0.0, lambda: None)
    plunger.set_diameter(7e-3)
    plunger.run(1e-8, None)
    clock.time = 1.0
    assert plunger.volume == pytest.approx(1e-8)
    assert plunger.delivered_at(1.0) == pytest.approx(4e-8)


def test_gas_pushes_on_the_plunger(clock):
    plunger = Plunger(clock, 20e-3, lambda: 50e3, lambda: None)
    assert plunger.force_on_plunger == pytest.approx(50e3 * math.pi * 1e-4)
