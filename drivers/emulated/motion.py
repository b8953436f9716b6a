"""Motion in closed form: the trapezoidal trajectory of a stage and the plunger of a syringe pump.

Nothing here is stepped: every quantity can be asked at any time, so that the plant may choose its own grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from drivers.interfaces import Clock


class Segment(NamedTuple):
    """A stretch of constant acceleration from ``start`` on (s, m, m/s, m/s^2)."""

    start: float
    position: float
    velocity: float
    acceleration: float

    def at(self, time: float) -> tuple[float, float]:
        """Position and velocity at ``time``."""
        elapsed = time - self.start
        velocity = self.velocity + self.acceleration * elapsed
        return self.position + 0.5 * (self.velocity + velocity) * elapsed, velocity


NOWHERE = 1e-15
"""A shorter way is none, m."""

Trajectory = tuple[Segment, ...]
"""Segments in order of time; the last one is rest."""


def rest(time: float, position: float) -> Trajectory:
    """Stand still."""
    return (Segment(time, position, 0.0, 0.0),)


def brake(time: float, position: float, velocity: float, deceleration: float) -> Trajectory:
    """Come to rest with the given deceleration (m/s^2); infinite stops dead."""
    if velocity == 0.0 or math.isinf(deceleration):
        return rest(time, position)
    duration = abs(velocity) / deceleration
    braking = Segment(time, position, velocity, -math.copysign(deceleration, velocity))
    return (braking, *rest(time + duration, position + 0.5 * velocity * duration))


def trapezoid(
    time: float,
    position: float,
    velocity: float,
    target: float,
    speed: float,
    acceleration: float,
    deceleration: float,
) -> Trajectory:
    """Go to ``target`` from any state of motion, without a jump in velocity.

    A move that cannot stop in time, or that heads the wrong way, brakes to rest first and then comes back.
    A move that is too fast brakes to ``speed``.
    """
    direction = 1.0 if target >= position else -1.0
    forward = velocity * direction
    distance = abs(target - position)
    stopping = forward * forward / (2 * deceleration)
    if forward < 0.0 or (forward > 0.0 and stopping > distance * (1 + 1e-12)):
        first = brake(time, position, velocity, deceleration)
        end = first[-1]
        return first[:-1] + trapezoid(end.start, end.position, 0.0, target, speed, acceleration, deceleration)
    if distance < NOWHERE:
        return rest(time, target)
    if forward > speed:
        top, ramp = speed, -deceleration
    else:
        peak = (2 * acceleration * distance + forward * forward) * deceleration / (acceleration + deceleration)
        top, ramp = min(speed, math.sqrt(peak)), acceleration
    return _profile(time, position, forward, target, direction, top, ramp, deceleration)


def _profile(
    time: float,
    position: float,
    forward: float,
    target: float,
    direction: float,
    top: float,
    ramp: float,
    deceleration: float,
) -> Trajectory:
    """Ramp to ``top``, cruise, brake; stretches without duration are left out."""
    reaching = (top - forward) / ramp
    slowing = top / deceleration
    distance = abs(target - position)
    travelled = 0.5 * (forward + top) * reaching
    cruising = max(0.0, (distance - travelled - 0.5 * top * slowing) / top)
    segments = []
    if reaching > 0.0:
        segments.append(Segment(time, position, forward * direction, ramp * direction))
    if cruising > 0.0:
        segments.append(Segment(time + reaching, position + travelled * direction, top * direction, 0.0))
    braking_from = target - 0.5 * top * slowing * direction
    slow_start = time + reaching + cruising
    segments.append(Segment(slow_start, braking_from, top * direction, -deceleration * direction))
    segments.append(Segment(slow_start + slowing, target, 0.0, 0.0))
    return tuple(segments)


FORGOTTEN = 50.0
"""After so many time constants nothing is left of a lag."""


class Carriage:
    """The carriage of a stage: a commanded trajectory and a position that follows it with a first-order lag.

    Parameters
    ----------
    clock
        Plant time, s.
    position
        Where it stands at the start, m.
    lag
        Time constant of the servo, s.
    before_change
        Called just before a command changes the trajectory.
    """

    def __init__(self, clock: Clock, position: float, lag: float, before_change: Callable[[], None]) -> None:
        self._clock = clock
        self._lag = lag
        self._before_change = before_change
        self._trajectory = rest(clock(), position)
        self._blocked: float | None = None
        self._seen = (math.nan, math.nan)
        self._offsets = self._follow(position)

    @property
    def position(self) -> float:
        """True position now, m."""
        now = self._clock()
        if self._seen[0] != now:
            self._seen = now, self.position_at(now)
        return self._seen[1]

    @property
    def commanded(self) -> float:
        """Where the trajectory generator stands now, m."""
        now = self._clock()
        return self._trajectory[self._index(now)].at(now)[0]

    @property
    def target(self) -> float:
        """Where the present or last move ends, m."""
        return self._trajectory[-1].position

    @property
    def velocity(self) -> float:
        """Commanded velocity now, m/s."""
        now = self._clock()
        return self._trajectory[self._index(now)].at(now)[1]

    @property
    def moving(self) -> bool:
        """Whether the trajectory is still running."""
        return self._clock() < self._trajectory[-1].start

    def move(self, target: float, speed: float, acceleration: float, deceleration: float) -> None:
        """Start a trapezoidal move, or redirect a running one without a jump in velocity."""
        if not (speed > 0.0 and acceleration > 0.0 and deceleration > 0.0):
            raise ValueError(f"speed {speed}, acceleration {acceleration}, deceleration {deceleration}: must be > 0")
        now, position, velocity = self._now()
        self._change(trapezoid(now, position, velocity, target, speed, acceleration, deceleration))

    def halt(self, deceleration: float) -> None:
        """Brake with the given deceleration (m/s^2); infinite stops dead."""
        if not deceleration > 0.0:
            raise ValueError(f"deceleration {deceleration}: must be > 0")
        self._change(brake(*self._now(), deceleration))

    def block(self, blocked: bool) -> None:
        """Hold the carriage fast (the trajectory runs on), or let it go again."""
        if blocked == (self._blocked is not None):
            return
        self._before_change()
        held = self.position
        self._blocked = held if blocked else None
        self._trajectory = self._cut(self._clock())
        self._offsets = self._follow(held)

    def position_at(self, time: float) -> float:
        """True position at a time from the last command on, m."""
        if self._blocked is not None:
            return self._blocked
        if time >= self._still_from:
            return self._trajectory[-1].position
        index = self._index(time)
        segment = self._trajectory[index]
        commanded, velocity = segment.at(time)
        lag = self._lag
        offset = self._offsets[index]
        elapsed = time - segment.start
        if offset and elapsed < FORGOTTEN * lag:
            commanded += offset * math.exp(-elapsed / lag)
        return commanded - lag * (velocity - lag * segment.acceleration)

    def _now(self) -> tuple[float, float, float]:
        now = self._clock()
        position, velocity = self._trajectory[self._index(now)].at(now)
        return now, position, velocity

    def _change(self, trajectory: Trajectory) -> None:
        self._before_change()
        position = self.position
        self._trajectory = trajectory
        self._offsets = self._follow(position)

    def _cut(self, now: float) -> Trajectory:
        """The rest of the present trajectory, begun anew now."""
        index = self._index(now)
        segment = self._trajectory[index]
        position, velocity = segment.at(now)
        return (Segment(now, position, velocity, segment.acceleration), *self._trajectory[index + 1 :])

    def _follow(self, position: float) -> tuple[float, ...]:
        """The decaying part of the lagging position at the start of each segment, from its present value."""
        offsets = []
        lag = self._lag
        self._seen = (math.nan, math.nan)
        self._still_from = self._trajectory[-1].start + FORGOTTEN * lag
        following = self._trajectory[1:]
        for index, segment in enumerate(self._trajectory):
            offset = position - segment.position + lag * (segment.velocity - lag * segment.acceleration)
            offsets.append(offset)
            if index < len(following):
                end = following[index].start
                commanded, velocity = segment.at(end)
                position = (
                    commanded
                    - lag * (velocity - lag * segment.acceleration)
                    + offset * math.exp(-(end - segment.start) / lag)
                )
        return tuple(offsets)

    def _index(self, time: float) -> int:
        trajectory = self._trajectory
        index = len(trajectory) - 1
        while index > 0 and time < trajectory[index].start:
            index -= 1
        return index


class Plunger:
    """The plunger of the pump; volumes as the pump counts them, and as they really are.

    Parameters
    ----------
    clock
        Plant time, s.
    diameter
        The true inner diameter of the syringe, m.
    pressure
        Returns the gas pressure on the plunger, Pa gauge.
    before_change
        Called just before a command changes the flow.
    """

    def __init__(
        self,
        clock: Clock,
        diameter: float,
        pressure: Callable[[], float],
        before_change: Callable[[], None],
    ) -> None:
        self._clock = clock
        self._diameter = diameter
        self._pressure = pressure
        self._before_change = before_change
        self._scale = 1.0
        self._start = clock()
        self._end = self._start
        self._rate = 0.0
        self._counted = 0.0
        self._delivered = 0.0

    @property
    def volume(self) -> float:
        """Net volume displaced since the start as the pump counts it, m^3."""
        return self._counted + self._run_until(self._clock())

    @property
    def rate(self) -> float:
        """Present rate, m^3/s, signed; zero when still."""
        return self._rate if self._clock() < self._end else 0.0

    @property
    def force_on_plunger(self) -> float:
        """Force the gas puts on the plunger, N."""
        return self._pressure() * math.pi * self._diameter**2 / 4

    def run(self, rate: float, target_volume: float | None) -> None:
        """Run at a signed rate until so much more has been displaced (a magnitude, m^3), or without end."""
        duration = math.inf if target_volume is None else abs(target_volume / rate) if rate else 0.0
        self._change(rate, duration)

    def stop(self) -> None:
        """Stop at once."""
        self._change(0.0, 0.0)

    def set_diameter(self, diameter: float) -> None:
        """The diameter the pump was told, m: it turns volumes into steps with it."""
        if not diameter > 0.0:
            raise ValueError(f"diameter {diameter}: must be > 0")
        self._change(self.rate, self._end - self._clock() if self.rate else 0.0)
        self._scale = (self._diameter / diameter) ** 2

    def delivered_at(self, time: float) -> float:
        """Net volume truly pushed out of the syringe at a time from the last command on, m^3."""
        return self._delivered + self._scale * self._run_until(time)

    def _run_until(self, time: float) -> float:
        return self._rate * (min(time, self._end) - self._start) if self._rate else 0.0

    def _change(self, rate: float, duration: float) -> None:
        self._before_change()
        now = self._clock()
        run = self._run_until(now)
        self._counted += run
        self._delivered += self._scale * run
        self._start, self._rate, self._end = now, rate, now + duration
