"""What can be mounted under the load cell: the protocol of a specimen, and those without a membrane.

A specimen answers one question: the carriage now stands here and the syringe has delivered so much; after
``duration`` seconds, what are force and pressure? It keeps nothing between questions: everything is in ``State``,
so that the plant may take a step back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from drivers.emulated.chamber import Chamber


class State(NamedTuple):
    """One instant of a specimen.

    Attributes
    ----------
    force
        N, compression positive, before the slow relaxation of the load train.
    pressure
        Pa gauge in the chamber.
    height
        Of the gripper's rim plane above the apex, the load train's deflection included, m.
    radius
        Of the contact, m; 0 is out of contact.
    speed
        Of the contact line, m/s; positive advances.
    stretch
        An inner variable of the specimen, near which the next solution is sought.
    trend
        Slope of the force over the last step, N/s.
    error
        Estimated error of the last step over what is allowed; above 1 the plant takes a shorter one.
    """

    force: float = 0.0
    pressure: float = 0.0
    height: float = 0.0
    radius: float = 0.0
    speed: float = 0.0
    stretch: float = 0.0
    trend: float = 0.0
    error: float = 0.0


class Surroundings(NamedTuple):
    """What the rest of the rig does to a specimen at one instant.

    Attributes
    ----------
    height
        Of the unloaded gripper above the apex, m.
    delivered
        Volume out of the syringe, m^3.
    amount
        Gas in the chamber over the gas that fills V_0 at room pressure.
    chamber
        The gas law.
    stiffness
        Of the load train, N/m.
    """

    height: float
    delivered: float
    amount: float
    chamber: Chamber
    stiffness: float

    @property
    def closed_pressure(self) -> float:
        """Gas pressure over a specimen that does not give way, Pa gauge."""
        return self.chamber.pressure(self.amount, -self.delivered)


FORCE_TOLERANCE = 5e-4
"""How far (N) a step may leave the straight line of the one before."""


class Specimen(Protocol):
    """Anything the gripper can be brought onto. Immutable."""

    def step(self, state: State, duration: float, around: Surroundings) -> State:
        """Return the state ``duration`` seconds later.

        Parameters
        ----------
        state
            The state before.
        duration
            s.
        around
            What surrounds the specimen at the end of the step.
        """
        ...


def finish(
    before: State,
    duration: float,
    force: float,
    pressure: float,
    height: float,
    radius: float,
    speed: float,
    stretch: float,
    slip: float = 0.0,
) -> State:
    """Complete a step with its trend and error; ``slip`` is the error of the contact radius over its allowance."""
    trend = (force - before.force) / duration
    bend = abs(trend - before.trend) * duration / FORCE_TOLERANCE
    return State(force, pressure, height, radius, speed, stretch, trend, bend if bend > slip else slip)


@dataclass(frozen=True, slots=True)
class ClosedChamber:
    """The gripper's mouth closed by a rigid plate that touches nothing: for leak and volume tests."""

    def step(self, state: State, duration: float, around: Surroundings) -> State:
        """Only the gas answers."""
        return finish(state, duration, 0.0, around.closed_pressure, around.height, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class DeadWeight:
    """A mass (kg) hung on the load cell: tension, so a negative force."""

    mass: float = 0.05
    gravity: float = 9.80665

    def step(self, state: State, duration: float, around: Surroundings) -> State:
        """The weight hangs whatever the stage does."""
        force = -self.mass * self.gravity
        deflected = around.height + force / around.stiffness
        return finish(state, duration, force, around.closed_pressure, deflected, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class RigidStop:
    """A hard anvil of the given stiffness (N/m) under a hard probe: shows the compliance of the load train."""

    stop_stiffness: float = 2e6

    def step(self, state: State, duration: float, around: Surroundings) -> State:
        """Two springs in series while they touch."""
        series = around.stiffness * self.stop_stiffness / (around.stiffness + self.stop_stiffness)
        force = max(0.0, -around.height * series)
        loaded = around.height + force / around.stiffness
        return finish(state, duration, force, around.closed_pressure, loaded, 0.0, 0.0, 0.0)
