"""A glass sphere pressed into the film on its glass plate (PNAS SI S4): JKR mechanics with adhesion hysteresis."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from drivers.emulated.line import ContactLine, line_error
from drivers.emulated.specimens import State, Surroundings, finish

SEED_RADIUS = 20e-6
"""A contact begins and ends at this radius, m."""


@dataclass(frozen=True, slots=True)
class Indentation:
    """A sphere on a half space.

    Attributes
    ----------
    sphere_radius
        R, m.
    modulus
        Contact modulus E* of the film on its plate, Pa.
    line
        How the contact line moves.
    """

    sphere_radius: float = 4e-3
    modulus: float = 2.0e6
    line: ContactLine = field(
        default_factory=lambda: ContactLine(receding=3.9, advancing=0.3, line_speed=1.0, rate_exponent=0.35)
    )

    def step(self, state: State, duration: float, around: Surroundings) -> State:
        """Move the contact line, then balance contact and load train (linear at a fixed radius)."""
        pressure, height, stiffness = around.closed_pressure, around.height, around.stiffness
        radius = state.radius + state.speed * duration
        if radius < SEED_RADIUS:
            if height > 0.0 or state.radius > 0.0:
                return finish(state, duration, 0.0, pressure, height, 0.0, 0.0, 0.0)
            radius = SEED_RADIUS
        force, speed = self._balance(radius, height, stiffness)
        slip = 0.0
        if speed != state.speed and state.radius > 0.0:
            better = max(state.radius + 0.5 * (state.speed + speed) * duration, SEED_RADIUS)
            slip = line_error(better - radius, radius - state.radius)
            radius = better
            force, speed = self._balance(radius, height, stiffness)
        return finish(state, duration, force, pressure, height + force / stiffness, radius, speed, 0.0, slip)

    def _balance(self, radius: float, height: float, stiffness: float) -> tuple[float, float]:
        """Force (N) and speed of the line (m/s) at a contact radius.

        At an indentation d, F = E* (2 a d - 2 a^3 / 3 R) and G = E* (d - a^2 / R)^2 / (2 pi a) (Johnson 1971).
        """
        a, R = radius, self.sphere_radius
        force = -self.modulus * (2 * a * height + 2 * a**3 / (3 * R)) / (1 + 2 * a * self.modulus / stiffness)
        opening = a * a / R + height + force / stiffness
        release = self.modulus * opening * abs(opening) / (2 * math.pi * a)
        return force, self.line.speed(release, release)
