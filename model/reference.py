"""An independent solution of the cone model to thirty digits: the yardstick of the accuracy report.

It shares nothing with ``model.cone``: the energy is written as printed (EML Eqs. 1-9, SI units), every derivative is
taken numerically (complex steps, then differences in high precision), and the contact is followed in steps of the
height z rather than of the radius. What the march brackets is then polished by Newton's method in mpmath.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mpmath
import numpy as np

from model.errors import NotConverged
from model.parameters import GasAnchor, Parameters
from model.prediction import Array

DIGITS = 30
HEIGHTS = 700
RADII = 1500


@dataclass(frozen=True)
class Reference:
    """The features to ``digits`` digits, as mpmath numbers; SI units."""

    pull_off_force: Any
    pull_off_distance: Any
    retraction_at_pull_off: Any
    zero_force_position: Any
    detachment_position: Any
    detachment_radius: Any
    adhesion_energy: Any
    """nan where the contact has jumped."""
    jumps: int
    digits: int


@dataclass(frozen=True)
class Energy:
    """The potential energy of EML Eq. 1 as printed; ``functions`` is numpy or mpmath."""

    parameters: Parameters
    contact_stretch: bool
    functions: Any
    convert: Callable[[float], Any]

    def __call__(self, r: Any, z: Any) -> Any:
        """Return Pi(r, z) in J."""
        c, xp = self.convert, self.functions
        scene = self.parameters
        R_0, h_0 = c(scene.gripper.radius), c(scene.membrane.thickness)
        E_m, omega = c(scene.membrane.youngs_modulus), c(scene.membrane.work_of_adhesion)
        pi = +mpmath.pi if xp is mpmath else np.pi
        h = self.height(r)
        detached = 1 + ((z + h) / (R_0 - r)) ** 2
        energy = pi * (R_0**2 - r**2) * h_0 * E_m / 6 * (detached + 1 / detached - 2)
        if scene.substrate.shape == "sphere" and self.contact_stretch:
            r_b = c(scene.substrate.radius)
            touching = (r_b / r * (xp.asin if xp is mpmath else np.arcsin)(r / r_b)) ** 2
            energy += pi * r**2 * h_0 * E_m / 6 * (touching + 1 / touching - 2)
        return energy - pi * r**2 * omega + self.pressure_work(r, z, h, pi)

    def height(self, r: Any) -> Any:
        """Return h, EML Eq. 9; the printed difference would cancel on a wide sphere."""
        if self.parameters.substrate.shape == "flat":
            return 0 * r
        r_b = self.convert(self.parameters.substrate.radius)
        return r**2 / (r_b + self.functions.sqrt(r_b**2 - r**2))

    def pressure_work(self, r: Any, z: Any, h: Any, pi: Any) -> Any:
        """Return U_p, EML Eqs. 6-8."""
        c, xp = self.convert, self.functions
        gas, R_0 = self.parameters.gas, c(self.parameters.gripper.radius)
        growth = pi / 3 * (z + h) * (R_0**2 + r**2 + R_0 * r) - pi * h / 6 * (3 * r**2 + h**2)
        P_0, P_atm = c(gas.initial_pressure), c(gas.atmospheric_pressure)
        if gas.anchor is GasAnchor.VENTED:
            return -P_0 * growth
        anchor = c(self.parameters.gripper.chamber_volume) + self.anchor_growth(pi)
        volume = c(self.parameters.gripper.chamber_volume) + growth
        return P_atm * (volume - anchor) - (P_atm + P_0) * anchor * xp.log(volume / anchor)

    def anchor_growth(self, pi: Any) -> Any:
        """Return V - V_0 where P_0 holds."""
        if self.parameters.gas.anchor is GasAnchor.FREE:
            return self.convert(0.0)
        R_0 = self.convert(self.parameters.gripper.radius)
        z, r = start(self.parameters, self.convert, self.functions.sqrt)
        h = self.height(r)
        return pi / 3 * (z + h) * (R_0**2 + r**2 + R_0 * r) - pi * h / 6 * (3 * r**2 + h**2)


def start(parameters: Parameters, convert: Callable[[float], Any], sqrt: Callable[[Any], Any]) -> tuple[Any, Any]:
    """Return z_0 and r_i as printed in EML Eqs. 12-14."""
    substrate, R_0, r_e = parameters.substrate, convert(parameters.gripper.radius), parameters.gripper.effective_radius
    r_e = convert(r_e)
    if substrate.shape == "flat":
        return convert(0.0), r_e if substrate.diameter is None else min(convert(substrate.diameter) / 2, r_e)
    r_b = convert(substrate.radius)
    if r_b <= R_0:
        return -r_b, min(r_b**2 / R_0, r_e)
    return -(R_0**2) / (r_b + sqrt(r_b**2 - R_0**2)), r_e


class March:
    """The contact radius followed in steps of z in double precision, derivatives by complex steps."""

    STEP = 1e-30

    def __init__(self, parameters: Parameters, contact_stretch: bool) -> None:
        self.energy = Energy(parameters, contact_stretch, np, float)
        z_0, r_i = start(parameters, float, np.sqrt)
        self.start, self.r_i = float(z_0), float(r_i)
        self.radii = self.r_i * np.sin(np.linspace(0, np.pi / 2, RADII + 1)[1:]) ** 2
        if self.r_i == parameters.gripper.radius:
            self.radii[-1] *= 1 - 1e-9

    def slope(self, r: Array | float, z: Array | float) -> Array:
        """Return dPi/dr."""
        with np.errstate(all="ignore"):
            slope: Array = np.imag(self.energy(np.asarray(r) + 1j * self.STEP, z + 0j)) / self.STEP
        return slope

    def force(self, r: Array, z: Array) -> Array:
        """Return F_r = -dPi/dz."""
        with np.errstate(all="ignore"):
            force: Array = -np.imag(self.energy(np.asarray(r) + 0j, z + 1j * self.STEP)) / self.STEP
        return force

    def held(self, z: float, widest: float) -> float:
        """Return the largest radius up to ``widest`` at which the contact is held at z; nan if there is none."""
        slope = self.slope(self.radii, z)
        inside = np.flatnonzero((slope < 0) & (self.radii <= widest * (1 + 1e-12)))
        return float(self.radii[inside[-1]]) if inside.size else float("nan")

    def ceiling(self) -> float:
        """Return a height at which nothing is held any more."""
        height = max(abs(self.start), 1e-6)
        while not np.isnan(self.held(self.start + height, self.r_i)):
            height *= 2
        low, high = 0.0, height
        for _ in range(12):
            middle = (low + high) / 2
            low, high = (low, middle) if np.isnan(self.held(self.start + middle, self.r_i)) else (middle, high)
        return self.start + high

    def heights(self, radii: Array, ceiling: float) -> Array:
        """Return for each radius z in equilibrium by bisection, from the tangent cone (held) up to ``ceiling``."""
        scene = self.energy.parameters
        r_b, R_0 = scene.substrate.radius, scene.gripper.radius
        drop = self.energy.height(radii)
        low = -drop - (R_0 - radii) * (0.0 if np.isinf(r_b) else radii / np.sqrt(r_b**2 - radii**2))
        high = np.full_like(radii, ceiling + 1e-6 * self.r_i)
        closed = scene.gas.anchor is not GasAnchor.VENTED
        for _ in range(70):
            middle = (low + high) / 2
            growth = np.pi / 3 * (middle + drop) * (R_0**2 + R_0 * radii + radii**2)
            volume = scene.gripper.chamber_volume + growth - np.pi * drop / 6 * (3 * radii**2 + drop**2)
            held = (self.slope(radii, middle) < 0) | (closed & (volume <= 0))
            low, high = np.where(held, middle, low), np.where(held, high, middle)
        result: Array = (low + high) / 2
        return result

    def path(self) -> tuple[Array, Array]:
        """Return z and r from the last moment the contact is held at r_i, jumps included."""
        heights = np.linspace(self.start, self.ceiling(), HEIGHTS)
        pinned = np.flatnonzero(self.slope(self.radii[-1], heights) < 0)
        first = pinned[-1] if pinned.size else 0
        z, r = [heights[first]], [self.radii[-1]]
        for height in heights[first + 1 :]:
            radius = self.held(height, r[-1])
            if np.isnan(radius):
                break
            z.append(height)
            r.append(radius)
        return np.array(z), np.array(r)


def solve(parameters: Parameters, *, contact_stretch: bool = True, digits: int = DIGITS) -> Reference:
    """Return the features of one pull-off to ``digits`` digits.

    Raises
    ------
    NotConverged
        Newton's method left the bracket of the march.
    """
    march = March(parameters, contact_stretch)
    z, r = march.path()
    # The printed energy excludes r = R_0: stay short of it by less than the digits asked for, with as many to spare.
    at_rim = march.r_i == parameters.gripper.radius
    with mpmath.workdps(5 * digits if at_rim else digits + 10):
        return _Polish(parameters, contact_stretch, march, z, r, digits).reference()


class _Polish:
    def __init__(
        self, parameters: Parameters, contact_stretch: bool, march: March, z: Array, r: Array, digits: int
    ) -> None:
        self.digits, self.march, self.z, self.r = digits, march, z, r
        self.energy = Energy(parameters, contact_stretch, mpmath, mpmath.mpf)
        self.z_0, self.r_i = start(parameters, mpmath.mpf, mpmath.sqrt)
        if self.r_i == mpmath.mpf(parameters.gripper.radius):
            self.r_i *= 1 - mpmath.mpf(10) ** -(digits + 6)

    def derivative(self, r: Any, z: Any, of_r: int, of_z: int) -> Any:
        return mpmath.diff(self.energy, (r, z), (of_r, of_z))

    def reference(self) -> Reference:
        onset = self.onset()
        jumps, detachment = self.detachment(onset)
        zero_radius, zero = self.zero(onset)
        peak_force, peak_z = self.peak(onset, detachment)
        return Reference(
            pull_off_force=-peak_force,
            pull_off_distance=detachment[1] - zero,
            retraction_at_pull_off=peak_z - zero,
            zero_force_position=zero,
            detachment_position=detachment[1],
            detachment_radius=detachment[0],
            adhesion_energy=mpmath.nan if jumps else self.work((zero_radius, zero), detachment),
            jumps=jumps,
            digits=self.digits,
        )

    def work(self, first: tuple[Any, Any], last: tuple[Any, Any]) -> Any:
        """Return the work between two equilibria on one smooth path: nothing but the potential's difference."""
        least = self.r_i * mpmath.mpf(10) ** -self.digits
        return self.energy(max(last[0], least), last[1]) - self.energy(*first)

    def force(self, r: Any, z: Any) -> Any:
        return -self.derivative(r, z, 0, 1)

    def onset(self) -> Any:
        """Return the largest z at which the contact is held at r_i."""
        above = self.z[0] + (self.z[1] - self.z[0] if self.z.size > 1 else 1e-3 * abs(self.z[0]) + 1e-9)
        step = above - self.z[0]
        for _ in range(20):
            if self.derivative(self.r_i, mpmath.mpf(above), 1, 0) > 0:
                break
            step *= 2
            above += step
        return self.root(lambda z: self.derivative(self.r_i, z, 1, 0), self.onset_below(), above)

    def onset_below(self) -> Any:
        held = mpmath.mpf(float(self.z[0]))
        return held if self.derivative(self.r_i, held, 1, 0) < 0 else self.z_0

    def root(self, function: Callable[[Any], Any], low: Any, high: Any, halvings: int = 0) -> Any:
        """Bisect until Newton-like steps are safe, then take secant steps."""
        low, high = mpmath.mpf(low), mpmath.mpf(high)
        rising = function(high) > 0
        if not (function(low) > 0) != rising:
            raise NotConverged(f"reference: no change of sign between z = {float(low):g} m and {float(high):g} m")
        for _ in range(halvings or 40 + 4 * max(mpmath.mp.dps - self.digits - 10, 0)):
            middle = (low + high) / 2
            if (function(middle) > 0) == rising:
                high = middle
            else:
                low = middle
        return mpmath.findroot(function, (low, high), solver="secant", tol=0, maxsteps=12, verify=False)

    def detachment(self, onset: Any) -> tuple[int, tuple[Any, Any]]:
        """Return the number of jumps and (r, z) of the last stable contact."""
        steps = -np.diff(self.r)
        jumps = 0
        if self.z.size > 2:
            jumps = int(
                np.sum((steps[1:-1] > 8 * np.maximum(steps[:-2], steps[2:])) & (steps[1:-1] > 0.02 * self.march.r_i))
            )
        low, widest = float(self.z[-1]), float(self.r[-1])
        high = low + (self.z[-1] - self.z[-2] if self.z.size > 1 else 1e-3 * abs(low) + 1e-9)
        for _ in range(40):
            middle = (low + high) / 2
            radius = self.march.held(middle, widest)
            if np.isnan(radius):
                high = middle
            else:
                low, widest = middle, radius
        return jumps, self.fold(widest, low, onset)

    def fold(self, radius: float, height: float, onset: Any) -> tuple[Any, Any]:
        if radius <= self.march.radii[0] * 1.001:
            return mpmath.mpf(0), self.apex(mpmath.mpf(self.march.r_i) * mpmath.mpf(10) ** -self.digits, height)
        if radius >= self.march.radii[-3] and self.derivative(self.r_i, onset, 2, 0) < 0:
            return self.r_i, onset

        def system(r: Any, z: Any) -> tuple[Any, Any]:
            return self.derivative(r, z, 1, 0), self.derivative(r, z, 2, 0)

        r, z = self.newton(system, radius, height)
        return r, z

    def apex(self, radius: Any, height: float) -> Any:
        """Return z at which an inflated cone lets go of the apex without force; 0 without inflation."""
        if not self.force(radius, mpmath.mpf(0)) > 0:
            return mpmath.mpf(0)
        return self.root(lambda z: self.force(radius, z), 0.5 * height, 2 * height)

    def newton(self, system: Callable[[Any, Any], tuple[Any, Any]], r: float, z: float) -> tuple[Any, Any]:
        """Newton's method in two unknowns with a differenced Jacobian."""
        r, z = mpmath.mpf(r), mpmath.mpf(z)
        delta = mpmath.mpf(10) ** (-mpmath.mp.dps // 3) * self.march.r_i
        for _ in range(60):
            f, g = system(r, z)
            fr, gr = ((b - a) / (2 * delta) for a, b in zip(system(r - delta, z), system(r + delta, z), strict=True))
            fz, gz = ((b - a) / (2 * delta) for a, b in zip(system(r, z - delta), system(r, z + delta), strict=True))
            determinant = fr * gz - fz * gr
            dr, dz = (f * gz - g * fz) / determinant, (g * fr - f * gr) / determinant
            shrink = min(mpmath.mpf(1), r / (4 * abs(dr))) if dr else mpmath.mpf(1)
            r, z = r - shrink * dr, z - shrink * dz
            if abs(dr) + abs(dz) < self.march.r_i * mpmath.mpf(10) ** (-mpmath.mp.dps + 14):
                return r, z
        raise NotConverged(f"reference: Newton's method did not settle near r = {float(r):g} m, z = {float(z):g} m")

    def zero(self, onset: Any) -> tuple[Any, Any]:
        """Return (r, z) where the force first turns tensile."""
        if self.force(self.r_i, self.z_0) <= 0:
            return self.r_i, self.z_0
        if self.force(self.r_i, onset) < 0:
            return self.r_i, self.root(lambda z: self.force(self.r_i, z), self.z_0, onset)
        tensile = np.flatnonzero(self.march.force(self.r, self.z) < 0)
        if not tensile.size:
            raise NotConverged("reference: the force never becomes tensile")
        k = int(tensile[0])
        z_low, z_high = (self.z[k - 1], self.z[k]) if k else (float(onset), self.z[0])
        r_low, r_high = self.r[k], self.r[k - 1] if k else self.march.r_i
        margin = r_high - r_low + 1e-3 * self.march.r_i

        def forceless(r: Any) -> Any:
            return self.root(lambda z: self.force(r, z), z_low - 4 * margin, z_high + 4 * margin, 24)

        def residual(r: Any) -> Any:
            return self.derivative(r, forceless(r), 1, 0)

        low, high = mpmath.mpf(r_low - margin), min(self.r_i, mpmath.mpf(r_high + margin))
        for _ in range(8):
            if (residual(low) < 0) != (residual(high) < 0):
                break
            margin *= 1.5
            low, high = mpmath.mpf(r_low - margin), min(self.r_i, mpmath.mpf(r_high + margin))
        radius = self.root(residual, low, high, 24)
        return radius, forceless(radius)

    def peak(self, onset: Any, detachment: tuple[Any, Any]) -> tuple[Any, Any]:
        """Return the most tensile force and its z."""
        candidates = [(self.force(self.r_i, onset), onset)]
        if detachment[0] == self.r_i:
            return candidates[0]
        apex = mpmath.mpf(self.march.r_i) * mpmath.mpf(10) ** (-self.digits)
        candidates.append((self.force(max(detachment[0], apex), detachment[1]), detachment[1]))

        def system(r: Any, z: Any) -> tuple[Any, Any]:
            rr, zz, rz = self.derivative(r, z, 2, 0), self.derivative(r, z, 0, 2), self.derivative(r, z, 1, 1)
            return self.derivative(r, z, 1, 0), rr * zz - rz**2

        radii = float(detachment[0]) + (self.march.r_i - float(detachment[0])) * np.linspace(0, 1, 802)[1:-1] ** 2
        heights = self.march.heights(radii, float(detachment[1]))
        k = int(np.nanargmin(self.march.force(radii, heights)))
        if 0 < k < radii.size - 1:
            r, z = self.newton(system, float(radii[k]), float(heights[k]))
            if not (detachment[0] < r < self.r_i and onset < z <= detachment[1]):
                raise NotConverged(f"reference: the peak force bracketed at r = {radii[k]:g} m was not confirmed")
            candidates.append((self.force(r, z), z))
        return min(candidates, key=lambda pair: pair[0])
