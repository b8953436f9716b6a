"""The plant: one simulated world behind every emulated instrument.

Time moves only in ``advance``. The plant keeps its own adaptive grid of knots: a knot is the state of the world at
one instant, sensors are straight lines between knots. The grid begins anew whenever a command changes the motion of
stage or pump, and depends on nothing else; so a run does not depend on how the samples are cut into frames.
"""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.emulated.faults import Faults
from drivers.emulated.motion import Carriage, Plunger
from drivers.emulated.noise import Drift, NoiseStream
from drivers.emulated.specimens import Specimen, State, Surroundings
from drivers.emulated.truth import Truth
from drivers.emulated.world import Axis, Syringe

Array = NDArray[np.float64]

LONGEST_STEP = 0.02
"""s; also how far a quiet world is computed ahead."""

SHORTEST_STEP = LONGEST_STEP / 2**12
"""s; a step this short is accepted whatever its error: the world has jumped."""

ROUND_OFF = 1e-6
"""Knots closer than this are one, s."""

FAULTS: Mapping[str, Mapping[str, str]] = {
    "stage": {"blocked": "the carriage is held fast while the trajectory runs on"},
    "pressure": {"leak": "the chamber leaks with a time constant of `value` seconds"},
}
"""Faults of the world itself."""


class Knot(NamedTuple):
    """The world at one instant, and what the sensors make of it but for noise."""

    time: float
    state: State
    amount: float
    relaxed: float
    sensed: float
    output: Array
    """Force, pressure, supply; shape (3, 1)."""


SIGNALS = 3


class Plant:
    """The world; see ``drivers.emulated.world.World``.

    Parameters
    ----------
    truth
        What the world is made of.
    seed
        Chooses noise and drift.
    faults
        The fault script being played.
    """

    def __init__(self, truth: Truth, *, seed: int = 0, faults: Faults | None = None) -> None:
        self.truth = truth
        self.lock = threading.RLock()
        self.faults = Faults() if faults is None else faults
        disturbance = truth.disturbance
        drifts = np.random.default_rng([seed, 1])
        self._force_drift = Drift(drifts, disturbance.force_drift, disturbance.force_wander)
        self._pressure_drift = Drift(drifts, disturbance.pressure_drift, disturbance.pressure_wander)
        self._supply_drift = Drift(drifts, 0.0, disturbance.supply_wander)
        self._noise = NoiseStream(seed, (disturbance.force_noise, disturbance.pressure_noise, disturbance.supply_noise))
        self._specimen = truth.specimen
        self._chamber = truth.chamber
        self._time = 0.0
        self._sample = 0
        self._rate = 0.0
        self._epoch = 0.0
        self._epoch_sample = 0
        self._step = LONGEST_STEP
        self._ones = np.arange(0)
        self._knots: list[Knot] = []
        self._carriage = Carriage(self._now, truth.train.start_position, truth.train.servo_lag, self._settle)
        self._plunger = Plunger(self._now, truth.chamber.syringe_diameter, self._pressure, self._settle)
        self.axis: Axis = self._carriage
        self.syringe: Syringe = self._plunger
        self._knots = [self._first_knot()]

    @property
    def time(self) -> float:
        """Plant time, s."""
        return self._time

    @property
    def sample(self) -> int:
        """Number of samples produced so far."""
        return self._sample

    @property
    def specimen(self) -> Specimen:
        """What is mounted."""
        return self._specimen

    def mount(self, specimen: Specimen) -> None:
        """Change the specimen, as the operator's hands do between tests; the new one is out of contact."""
        with self.lock:
            self._settle()
            self._specimen = specimen
            last = self._knots[-1]
            state = State(pressure=last.state.pressure, height=last.state.height)
            self._knots[-1] = last._replace(state=state, relaxed=0.0)

    @property
    def state(self) -> State:
        """The specimen now (truth, for tests and displays)."""
        with self.lock:
            self._extend(self._time)
            last = next(knot for knot in reversed(self._knots) if knot.time <= self._time)
            return last.state if self._time - last.time < ROUND_OFF else self._after(last, self._time).state

    def advance(self, samples: int, rate: float) -> dict[str, Array]:
        """Move time on by ``samples / rate``; see ``World.advance``.

        The last of the samples is taken at the new present time.
        """
        if samples < 0 or not rate > 0.0:
            raise ValueError(f"samples = {samples}, rate = {rate}: must be >= 0 and > 0 Hz")
        with self.lock:
            self._play_faults()
            if rate != self._rate:
                self._rate, self._epoch, self._epoch_sample = rate, self._time, self._sample
            start, stop = self._sample, self._sample + samples
            times = self._epoch + (self._counting(samples) + (start - self._epoch_sample)) / rate
            if samples:
                self._time = float(times[-1])
                self._sample = stop
                self._extend(self._time)
            self.faults.advance(stop)
            force, pressure, supply = self._between_knots(times) + self._noise.take(start, stop)
            self._forget()
            return {"force": force, "pressure": pressure, "supply": supply}

    def _counting(self, samples: int) -> NDArray[np.int64]:
        """1, 2, ... samples; frames are mostly of one length."""
        if self._ones.size != samples:
            self._ones = np.arange(1, samples + 1)
        return self._ones

    def _between_knots(self, times: Array) -> Array:
        """Straight lines between the knots at the given times, shape (signals, times)."""
        pieces = [np.empty((SIGNALS, 0))]
        done = 0
        for before, after in itertools.pairwise(self._knots):
            if done == times.size:
                break
            end = after.time + ROUND_OFF
            stop = times.size if times[-1] <= end else int(np.searchsorted(times, end, side="right"))
            if stop > done:
                slopes = (after.output - before.output) / (after.time - before.time)
                pieces.append(slopes * (times[done:stop] - before.time) + before.output)
                done = stop
        return pieces[1] if len(pieces) == 2 else np.concatenate(pieces, axis=1)

    def _now(self) -> float:
        return self._time

    def _first_knot(self) -> Knot:
        train = self.truth.train
        height = self.axis.position - train.contact_position
        still = State(height=height)
        state = self._specimen.step(still, LONGEST_STEP, Surroundings(height, 0.0, 1.0, self._chamber, train.stiffness))
        return self._knot(0.0, state._replace(trend=0.0, error=0.0), 1.0, 0.0, 0.0)

    def _extend(self, until: float) -> None:
        """Compute the world up to ``until``, and to the end of the step that reaches it."""
        while self._knots[-1].time < until - ROUND_OFF:
            self._take_step()

    def _take_step(self) -> None:
        last = self._knots[-1]
        step = self._step
        knot = self._after(last, last.time + step)
        while knot.state.error > 1.0 and step > SHORTEST_STEP:
            step = max(step / 4 if knot.state.error > 10.0 else step / 2, SHORTEST_STEP)
            knot = self._after(last, last.time + step)
        self._knots.append(knot)
        self._step = min(2 * step, LONGEST_STEP) if knot.state.error < 0.3 else step

    def _after(self, last: Knot, time: float) -> Knot:
        """The world at ``time``, one step after a knot."""
        duration = time - last.time
        train, chamber = self.truth.train, self._chamber
        amount = chamber.leaked(last.amount, last.state.pressure, duration)
        height = self._carriage.position_at(time) - train.contact_position
        delivered = self._plunger.delivered_at(time)
        around = Surroundings(height, delivered, amount, chamber, train.stiffness)
        state = self._specimen.step(last.state, duration, around)
        pushed = state.force if state.force > 0.0 else 0.0
        relaxed = pushed + (last.relaxed - pushed) * math.exp(-duration / train.relaxation_time)
        sensed = chamber.sensed(last.sensed, last.state.pressure, state.pressure, duration)
        return self._knot(time, state, amount, relaxed, sensed)

    def _knot(self, time: float, state: State, amount: float, relaxed: float, sensed: float) -> Knot:
        """Add to a state what the sensors make of it."""
        output = (
            (state.force - self.truth.train.relaxing * relaxed + self._force_drift.at(time),),
            (sensed + self._pressure_drift.at(time),),
            (self.truth.disturbance.supply + self._supply_drift.at(time),),
        )
        return Knot(time, state, amount, relaxed, sensed, np.array(output))

    def _settle(self) -> None:
        """Make now a knot and forget what was computed beyond: a command is about to change the future."""
        self._extend(self._time)
        knots = self._knots
        while knots[-1].time > self._time + ROUND_OFF:
            knots.pop()
        last = knots[-1]
        if abs(self._time - last.time) < ROUND_OFF:
            knots[-1] = last._replace(time=self._time)
        else:
            knots.append(self._after(last, self._time))

    def _pressure(self) -> float:
        """Gas pressure now, Pa gauge."""
        self._extend(self._time)
        grid = [knot.time for knot in self._knots]
        return float(np.interp(self._time, grid, [knot.state.pressure for knot in self._knots]))

    def _forget(self) -> None:
        """Drop the knots that no later sample can see."""
        knots = self._knots
        keep = len(knots) - 1
        while keep > 0 and knots[keep].time > self._time:
            keep -= 1
        del knots[:keep]

    def _play_faults(self) -> None:
        """Let the faults of the world begin or end now."""
        self._carriage.block(self.faults.active("stage", "blocked") is not None)
        leak = self.faults.active("pressure", "leak")
        chamber = self.truth.chamber if leak is None else replace(self.truth.chamber, leak_time=leak.value or 1.0)
        if chamber != self._chamber:
            self._settle()
            self._chamber = chamber
