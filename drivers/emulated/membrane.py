"""The true membrane of the emulated world: it bulges, sticks, peels at a rate, and is not the overlay's cone.

Between contact line and rim the meridian is a straight line plus a parabolic bulge in equilibrium with the gas
(a two-parameter Ritz shape); the material is neo-Hookean without hoop stretch. The energy release rate is the
derivative of that potential with respect to the contact area. The contact line recedes, stays pinned or advances
as ``ContactLine`` says; where the film would enter the substrate it advances.

Beside the contact, the film-covered rim of the gripper touches the substrate, slightly tilted, and takes the preload.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, field

from drivers.emulated.chamber import ATMOSPHERE
from drivers.emulated.line import ContactLine, line_error
from drivers.emulated.specimens import State, Surroundings, finish

FREE_DEFLECTION = 0.59488
"""Pole of a clamped, inflated membrane over R_0 (p R_0 / E h)^(1/3), Poisson's ratio 1/2 (Hencky)."""

FREE_VOLUME = 0.965163
"""Its volume over R_0^3 (p R_0 / E h)^(1/3)."""

FIBER = 60e-6
"""A contact begins and ends with about one fibre, m."""

PRESSURE_STEP = 5.0
"""Newton's correction (Pa) below which the remaining error is far under the sensor's noise."""

HEIGHT_STEP = 5e-8
"""The same for the height, m."""

ITERATIONS = 60


class NoEquilibrium(ArithmeticError):
    """Film, gas and load train cannot balance at this contact radius."""


@dataclass(frozen=True, slots=True)
class AdhesiveMembrane:
    """A fibrillar adhesive membrane on a rigid gripper above a sphere, a flat, or a flat disk.

    Attributes
    ----------
    substrate_diameter
        Of the sphere, m; ``None`` is a flat.
    disk_diameter
        Of a flat disk, m; ``None`` is wider than the gripper.
    radius, effective_radius
        R_0 and the largest contact radius misalignment and imperfections allow, m.
    youngs_modulus, thickness, prestretch
        Pa, m, strain the film was mounted with.
    line
        How the contact line moves.
    contact_strain
        The film laid on a sphere stores E h a^4 / (contact_strain r_b^4) per area.
    rim_stiffness, tilt
        N/m of the fully seated rim; angle between rim and substrate, rad.
    largest_radius, smallest_radius
        Of a contact, m (derived).
    seat
        Height at which the untilted rim touches, m; far below everything where it never does (derived).
    """

    substrate_diameter: float | None = 60e-3
    disk_diameter: float | None = None
    radius: float = 8e-3
    effective_radius: float = 7.3e-3
    youngs_modulus: float = 2.08e6
    thickness: float = 196e-6
    prestretch: float = 2e-3
    line: ContactLine = field(default_factory=ContactLine)
    contact_strain: float = 270.0
    rim_stiffness: float = 60e3
    tilt: float = 1e-3
    largest_radius: float = field(init=False, repr=False, compare=False)
    smallest_radius: float = field(init=False, repr=False, compare=False)
    seat: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "largest_radius", self._largest_radius())
        object.__setattr__(self, "smallest_radius", min(FIBER, 0.1 * self.largest_radius))
        object.__setattr__(self, "seat", self._seat())

    def step(self, state: State, duration: float, around: Surroundings) -> State:
        """Move the contact line, then balance film, gas and load train; without a balance the film is drawn off."""
        radius = min(state.radius + state.speed * duration, self.largest_radius)
        if radius < self.smallest_radius:
            return self._step_free(state, duration, around)
        try:
            return self._step_in_contact(state, duration, radius, around)
        except NoEquilibrium:
            return self._step_free(state, duration, around)

    def _step_in_contact(self, state: State, duration: float, radius: float, around: Surroundings) -> State:
        """Balance at the predicted radius, and again at the corrected one where they differ."""
        after = self._balance(state, radius, around)
        slip = 0.0
        if after[4] != state.speed:
            better = min(state.radius + 0.5 * (state.speed + after[4]) * duration, self.largest_radius)
            slip = line_error(better - radius, radius - state.radius)
            if slip > 0.1 and better > self.smallest_radius:
                after = self._balance(state, better, around)
        return finish(state, duration, *after, slip)

    def _largest_radius(self) -> float:
        if self.disk_diameter is not None:
            return min(self.effective_radius, self.disk_diameter / 2)
        if self.substrate_diameter is not None:
            return min(self.effective_radius, 0.49 * self.substrate_diameter)
        return self.effective_radius

    def _seat(self) -> float:
        if self.substrate_diameter is not None:
            sphere = self.substrate_diameter / 2
            if sphere <= self.radius:
                return -2 * sphere
            return -sphere + math.sqrt(sphere**2 - self.radius**2)
        return -math.inf if self.disk_diameter is not None and self.disk_diameter < 2 * self.radius else 0.0

    def rim(self, height: float) -> tuple[float, float]:
        """Force (N) of the rim on the substrate and its stiffness (N/m): a tilted ring touches on one side first."""
        depth = self.seat - height
        lift = self.tilt * self.radius
        if depth <= -lift:
            return 0.0, 0.0
        if depth >= lift:
            return self.rim_stiffness * depth, self.rim_stiffness
        seated = math.acos(-depth / lift)
        force = self.rim_stiffness * (math.sqrt(lift * lift - depth * depth) + depth * seated) / math.pi
        return force, self.rim_stiffness * seated / math.pi

    def _step_free(self, state: State, duration: float, around: Surroundings) -> State:
        """Out of contact the film is a clamped membrane inflated by the gas; it may touch at the end."""
        height = around.height
        inflation = 0.0 if around.chamber.vented else self._inflate(state, around)
        pressure = 0.0 if around.chamber.vented else self._film / self.radius * inflation**3
        if height < FREE_DEFLECTION * self.radius * inflation:
            begun = State(pressure=pressure, height=height)
            with contextlib.suppress(NoEquilibrium):  # then it does not hold yet
                touching = self._balance(begun, self.smallest_radius, around)
                if touching[4] >= 0.0:
                    return finish(state, duration, *touching)
        force, height = self._seated(height, around.stiffness)
        return finish(state, duration, force, pressure, height, 0.0, 0.0, inflation)

    def _inflate(self, state: State, around: Surroundings) -> float:
        """Cube root of p R_0 / (E h) of the free film with this much gas behind it."""
        _, delivered, amount, chamber, _ = around
        film = self._film / self.radius
        swept = FREE_VOLUME * self.radius**3
        inflation = state.stretch if state.radius == 0.0 else math.cbrt(state.pressure / film)
        for _ in range(ITERATIONS):
            change = swept * inflation - delivered
            pressure = chamber.pressure(amount, change)
            slope = 3 * film * inflation * inflation + (pressure + ATMOSPHERE) / (chamber.volume + change) * swept
            correction = (pressure - film * inflation**3) / slope
            inflation += correction
            if abs(correction) < 1e-9:
                return inflation
        raise ArithmeticError(f"free membrane: no equilibrium with {delivered:g} m^3 delivered, amount {amount:g}")

    def _seated(self, height: float, stiffness: float) -> tuple[float, float]:
        """Force and height when only the rim may touch."""
        force = 0.0
        loaded = height
        for _ in range(ITERATIONS):
            force, slope = self.rim(loaded)
            correction = (height + force / stiffness - loaded) / (1 + slope / stiffness)
            loaded += correction
            if abs(correction) < HEIGHT_STEP:
                break
        return force, loaded

    @property
    def _film(self) -> float:
        return self.youngs_modulus * self.thickness

    def _laid_on(self, a: float) -> tuple[float, float, float, float]:
        """Height, edge slope and volume of the cap of radius ``a``, and the energy (J/m^2) of laying film there."""
        if self.substrate_diameter is None:
            return 0.0, 0.0, 0.0, 0.0
        sphere = 0.5 * self.substrate_diameter
        below = math.sqrt(sphere * sphere - a * a)
        cap = a * a / (sphere + below)
        laid = 3 * self._film * (a / sphere) ** 4 / self.contact_strain
        return cap, a / below, math.pi * cap / 6 * (3 * a * a + cap * cap), laid

    def _balance(
        self, state: State, radius: float, around: Surroundings
    ) -> tuple[float, float, float, float, float, float]:
        """Balance film, gas and load train at a given contact radius (Newton in height and pressure).

        Returns force, pressure, height, radius, speed of the line, stretch.
        """
        pi = math.pi
        height, delivered, amount, chamber, stiffness = around
        a, R = radius, self.radius
        film = self._film
        cap, cap_slope, cap_volume, laid = self._laid_on(a)
        L = R - a
        ring = pi * (R * R - a * a)
        cone = pi / 3 * (R * R + a * a + R * a)
        energy = film / 6
        base = self.prestretch * (2 + self.prestretch)
        vented = chamber.vented
        y, z, p = state.stretch if state.radius else base, state.height, state.pressure
        for _ in range(ITERATIONS):
            d = z + cap
            inclined = base + (d / L) ** 2
            load = p * L / film
            swelling = 0.75 * load * load
            y, x, xy = _stretch(y, inclined, swelling)
            b = -0.375 * load * L / x
            give = x * x + 2 * (y - inclined) * x * xy
            b_p = -0.375 * L * L / (film * x) * (1 - 2 * xy * swelling / (x * give))
            force_z = -ring * energy * 2 / (L * L) * (x + 2 * xy * d * d / (L * L))
            rim, rim_stiffness = self.rim(z)
            force = p * cone - ring * energy * x * 2 * d / (L * L) + rim
            change = cone * d - cap_volume - 2 / 3 * ring * b - delivered
            r_z = height + force / stiffness - z
            if vented:
                dp = 0.0
                dz = r_z / (1 - (force_z - rim_stiffness) / stiffness)
            else:
                gas = chamber.pressure(amount, change)
                kappa = (gas + ATMOSPHERE) / (chamber.volume + change)
                m11 = 1 - kappa * 2 / 3 * ring * b_p
                m12 = kappa * cone
                m21 = -cone / stiffness
                m22 = 1 - (force_z - rim_stiffness) / stiffness
                r_p = gas - p
                determinant = m11 * m22 - m12 * m21
                dp = (r_p * m22 - m12 * r_z) / determinant
                dz = (m11 * r_z - m21 * r_p) / determinant
            z += dz
            p += dp
            if -HEIGHT_STEP < dz < HEIGHT_STEP and -PRESSURE_STEP < dp < PRESSURE_STEP:
                break
        else:
            raise NoEquilibrium(f"membrane: no equilibrium at a = {a:g} m, height {height:g} m, pressure {p:g} Pa")
        opened = d * d + 16 / 3 * b * b
        release = (
            energy * (x * (R + a) / (a * L) * (d * cap_slope + opened / L) - (_density(y) - _density(base)))
            + laid
            - p * ((cap_slope * cone + pi / 3 * d * (2 * a + R)) / (2 * pi * a) - 0.5 * a * cap_slope + 2 / 3 * b)
        )
        angle = (d + 4 * b) / L + cap_slope
        zipping = energy * x * math.sqrt(1 + y) * angle * abs(angle)
        speed = self.line.speed(release, zipping, movable=a < self.largest_radius)
        return stiffness * (z - height), p, z, a, speed, y


def _density(y: float) -> float:
    """Neo-Hookean energy over E / 6 at a squared stretch of 1 + y, no hoop stretch."""
    return y * y / (1 + y)


def _stretch(y: float, inclined: float, swelling: float) -> tuple[float, float, float]:
    """Solve (y - inclined) x(y)^2 = swelling for the squared stretch 1 + y of a bulged film, x = 1 - (1 + y)^-2.

    Returns y, x and dx/dy.
    """
    if y <= inclined:
        y = inclined + math.cbrt(swelling)
    while True:
        u = 1 / (1 + y)
        x = 1 - u * u
        xy = 2 * u * u * u
        correction = (swelling - (y - inclined) * x * x) / (x * (x + 2 * (y - inclined) * xy))
        y += correction
        y = max(y, inclined)
        if -1e-9 < correction < 1e-9:
            return y, x, xy
