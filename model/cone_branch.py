"""The equilibrium branch of the cone model: for every contact radius the largest root in z of dPi/dr = 0 (EML Eq. 10).

Parametrised by the contact radius the branch is single valued, so the folds in z (where the contact jumps or
detaches) are ordinary maxima. The root exists for every radius: where the cone leaves the sphere along its tangent
the pressure has no lever and dPi/dr is negative, and it is positive above a bound given in closed form.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from model.cone_terms import Cone, Driven, Edge, Isothermal, Number, State, Vented
from model.errors import NotConverged
from model.prediction import Array
from model.roots import EPSILON, bracketed

ITERATIONS = 200
FREE_STEPS = 16
QUADRATIC = 1e-9
"""A Newton step this small, and much smaller than the last, leaves an error below rounding."""
COARSE = 1e-5
SETTLED = 3e-7
"""A Newton step this small leaves an error below 1e-12."""
NOISE = 1e-9
"""Steps below this that no longer shrink are rounding noise; the error estimate says how much of it there is."""


def bounds(cone: Cone, edge: Edge) -> tuple[Array, Array]:
    """Return slopes t below and above the largest root, for an array of contact radii.

    dPi/drho >= 2 g(t) + load - b (t + slope) for t >= 0, where g is the stretch energy and b bounds the pressure's
    lever; and the pressure helps no more once it is negative.
    """
    lever = (1 + 2 * edge.radius) * edge.gap
    tangent = np.zeros_like(edge.radius) - edge.slope
    gas = cone.gas
    if isinstance(gas, Isothermal):
        widening = edge.gap * (1 + edge.radius + edge.radius**2)
        level = gas.anchor + gas.offset - edge.cap  # the volume at t = 0
        with np.errstate(divide="ignore", invalid="ignore"):
            empty = -level / widening
            missing = np.maximum(gas.neutral_growth + edge.cap, 0.0)
            neutral = np.where(missing > 0, missing / widening, 0.0)
            highest = np.where(level > 0, gas.at(-edge.cap)[0], np.inf)
            first = _balance(edge, np.maximum(highest, 0.0) * lever)
        second = np.maximum(neutral, _balance(edge, 0.0))
        return np.maximum(tangent, empty), np.where(np.isfinite(first), np.minimum(first, second), second)
    highest = gas.initial if isinstance(gas, Vented) else gas.pressure.max()
    return tangent, _balance(edge, np.maximum(highest, 0.0) * lever)


def _balance(edge: Edge, lever: Number) -> Array:
    """Return t with 2 g(t) >= a + b t: the larger of the solutions of g = a and of g / t >= b."""
    a = np.maximum(lever * edge.slope - edge.load, 0.0)
    from_adhesion = np.sqrt((a + np.sqrt(a * (a + 4))) / 2)
    result: Array = np.maximum(from_adhesion, lever + np.cbrt(lever))
    return result


def largest_slope(cone: Cone, edge: Edge, accuracy: float = QUADRATIC) -> Array:
    """Return the largest root t of dPi/drho = 0 for an array of contact radii.

    Newton's method from the upper bound; kept inside its bracket if free steps lead astray. With ``accuracy`` the
    last step may be as large as that times t: one more step, taken with the derivatives, squares it.
    """
    with np.errstate(all="ignore"):
        low, high = bounds(cone, edge)
        start, low, high = _cold_start(cone, edge, low, high)
        free = _free_newton(cone, edge, start, accuracy)
        if free is not None and ((free >= low) & (free <= high)).all():
            return free
        return _bracketed_newton(cone, edge, np.clip(start, low, high), low, high)


def _free_newton(cone: Cone, edge: Edge, t: Array, accuracy: float) -> Array | None:
    """Return the root, or None unless every element converged quadratically on a rising residual."""
    previous: Array | float = 0.0
    ratio = math.sqrt(accuracy)
    for _ in range(FREE_STEPS):
        value, slope = cone.residual(edge, t)
        step = value / slope
        t = t - step
        step = np.abs(step)
        scale = np.abs(t) + edge.slope
        if ((step <= 8 * EPSILON * scale) | ((step <= accuracy * scale) & (step <= ratio * previous))).all():
            return t if (slope > 0).all() else None
        previous = step
    return None


def settled_state(cone: Cone, edge: Edge, t: Array, held: int) -> tuple[State, Array]:
    """Return state and t from a close start; the first ``held`` points are pinned and keep their t.

    The last Newton step corrects the force to first order.
    """
    with np.errstate(all="ignore"):
        for _ in range(5):
            state = cone.state(edge, t)
            step = state.residual / state.residual_t
            step[:held] = 0.0
            step[state.residual == 0] = 0.0
            t = t - step
            if (np.abs(step) <= SETTLED * (np.abs(t) + edge.slope)).all() and (t + edge.slope >= 0)[held:].all():
                return state._replace(force=state.force - state.force_t * step), t
    t = np.concatenate((t[:held], largest_slope(cone, edge)[held:]))
    return cone.state(edge, t), t


def _bracketed_newton(cone: Cone, edge: Edge, t: Array, low: Array, high: Array) -> Array:
    previous = np.full_like(t, np.inf)
    for _ in range(ITERATIONS):
        value, slope = cone.residual(edge, t)
        proposal = t - value / slope
        low = np.where(value < 0, t, low)
        high = np.where(value > 0, t, high)
        proposal = np.where((proposal >= low) & (proposal <= high), proposal, (low + high) / 2)
        proposal = np.where(value == 0, t, proposal)
        step = np.abs(proposal - t)
        t = proposal
        scale = np.abs(t) + edge.slope
        if ((step <= 8 * EPSILON * scale) | ((step <= NOISE * scale) & (step >= previous))).all():
            return t
        previous = step
    raise NotConverged(f"the equilibrium branch did not settle: largest last step {step.max():.3g} in the cone's slope")


def _cold_start(cone: Cone, edge: Edge, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Start at the upper bound, from where Newton's steps fall monotonically; below t = 0 from the cubic term."""
    if isinstance(cone.gas, Driven):
        low, high = _last_crossing(cone, edge, cone.gas, low, high)
        return high, low, high
    if cone.sphere is None:
        return high, low, high
    reaches = low < 0
    with np.errstate(all="ignore"):
        value, _ = cone.residual(edge, np.where(reaches, 0.0, high))
        cubic = -np.cbrt(value / (4 * (1 + edge.radius) * edge.slope))
    below = reaches & (value > 0)
    start = np.where(below, np.maximum(cubic, low / 2), np.where(reaches, np.minimum(cubic, high), high))
    return start, np.where(reaches & ~below, 0.0, low), np.where(below, 0.0, high)


def _last_crossing(cone: Cone, edge: Edge, gas: Driven, low: Array, high: Array) -> tuple[Array, Array]:
    """Narrow the bracket to the last knot of a measured pressure at which the contact is still held."""
    position = np.unique(np.concatenate((gas.position, np.linspace(gas.position[0], gas.position[-1], 65))))
    column = Edge(*(np.reshape(part, (-1, 1)) if isinstance(part, np.ndarray) else part for part in edge))
    with np.errstate(all="ignore"):
        t = (position + column.drop) / column.gap
    t = np.clip(np.where(np.isfinite(t), t, high[:, None]), low[:, None], high[:, None])
    t = np.concatenate((low[:, None], t, high[:, None]), axis=1)
    held = cone.residual(column, t)[0] < 0
    last = t.shape[1] - 2 - np.argmax(held[:, -2::-1], axis=1)
    rows = np.arange(t.shape[0])
    return t[rows, last], t[rows, last + 1]


def tilt_of(state: State) -> float:
    """Return -dt/drho along the branch; zero where nothing but geometry shapes it (no load, no pressure)."""
    return float(state.residual_radius / state.residual_t) if state.residual_t else 0.0


def tilts(state: State) -> Array:
    """Return ``tilt_of`` for arrays."""
    shaped = state.residual_t != 0
    result: Array = np.where(shaped, state.residual_radius / np.where(shaped, state.residual_t, 1.0), 0.0)
    return result


class Point(NamedTuple):
    """One equilibrium of the branch."""

    radius: float
    t: float
    position: float
    force: float
    force_climb: float
    """dF/drho along the branch; zero where the contact is pinned."""


class Branch:
    """The branch of one scene (floats): scanned once, then evaluated exactly where it matters."""

    def __init__(self, cone: Cone, nodes: int) -> None:
        self.cone = cone
        half = np.sin(np.linspace(np.pi / 2, 0.0, nodes + 1)[:-1]) ** 2
        self.radius = cone.start_radius * half
        self.edge = cone.edge(self.radius)
        t = largest_slope(cone, self.edge, COARSE)
        state = cone.state(self.edge, t)
        step = np.where(state.residual == 0, 0.0, state.residual / np.where(state.residual == 0, 1.0, state.residual_t))
        self.t = t - step
        self.force = state.force - state.force_t * step
        tilt = tilts(state)
        self.position = cone.position(self.edge, self.t)
        self.climb = -(self.t + self.edge.slope) - self.edge.gap * tilt
        self.force_climb = state.force_radius - state.force_t * tilt
        self.slope = -tilt
        self._append_centre()
        self._last = (float(self.radius[0]), float(self.t[0]), float(self.slope[0]))
        self.onset = self.point(float(self.radius[0]))

    def _append_centre(self) -> None:
        """Add the limit r -> 0: the cone of an inflated membrane touching the apex, or no contact at z = 0."""
        t = self._centre()
        edge = self.cone.edge(0.0)
        state = self.cone.state(edge, t)
        slope = -tilt_of(state) if t > 0 else self._slope_at_apex(state.pressure)
        climb = slope - t
        force_climb = state.force_radius + state.force_t * slope if math.isfinite(slope) else -math.inf
        force = 0.0 if t > 0 else state.force
        names = ("radius", "t", "position", "force", "climb", "force_climb", "slope")
        for name, value in zip(names, (0.0, t, t, force, climb, force_climb, slope), strict=True):
            setattr(self, name, np.concatenate((getattr(self, name), (value,))))

    def _slope_at_apex(self, pressure: float) -> float:
        """Return dt/drho as r -> 0 without inflation: omega / |P_a| - 1 / r_b; infinite (rho^(1/4)) without suction."""
        bend = 0.0 if self.cone.sphere is None else 1 / self.cone.sphere
        if self.cone.adhesion == 0:
            return -bend
        return math.inf if pressure == 0 else self.cone.adhesion / -pressure - bend

    def _centre(self) -> float:
        edge = self.cone.edge(0.0)
        start = self.cone.state(edge, 0.0)
        if not start.pressure > 0:
            return 0.0
        high = 1.1 * abs(float(self.t[-1])) + EPSILON
        while (end := self.cone.state(edge, high).force) > 0:
            high *= 2
        return bracketed(lambda t: self.cone.state(edge, t).force, 0.0, high, start.force, end)

    def guess(self, radius: Array) -> Array:
        """Return t between the nodes by Hermite's cubic; linear next to an apex of infinite slope."""
        k = np.clip(np.searchsorted(-self.radius, -radius, side="right") - 1, 0, self.radius.size - 2)
        width = self.radius[k + 1] - self.radius[k]
        x = (radius - self.radius[k]) / width
        t_a, t_b = self.t[k], self.t[k + 1]
        secant = t_b - t_a
        end = self.slope[k + 1] * width
        end = np.where(np.isfinite(end), end, secant)
        a, b = self.slope[k] * width - secant, secant - end
        result: Array = t_a + x * secant + x * (1 - x) * (a * (1 - x) + b * x)
        return result

    def at(self, radius: float) -> tuple[Edge, float]:
        """Return the equilibrium at one radius: Newton from the tangent at the last one, else from scratch."""
        edge = self.cone.edge(radius)
        last_radius, last_t, last_slope = self._last
        t = last_t + last_slope * (radius - last_radius)
        previous = 0.0
        for _ in range(12):
            value, slope = self.cone.residual(edge, t)
            if not slope > 0:
                break
            step = value / slope
            t -= step
            size, scale = abs(step), abs(t) + edge.slope
            if size <= 4 * EPSILON * scale or (size <= QUADRATIC * scale and size <= 1e-3 * previous):
                if t + edge.slope < 0:
                    break
                self._last = (radius, t, last_slope)
                return edge, t
            previous = size
        t = float(largest_slope(self.cone, self.cone.edge(np.array([radius])))[0])
        self._last = (radius, t, last_slope)
        return edge, t

    def climb_at(self, radius: float) -> float:
        """Return dz/drho along the branch; negative where it is stable under displacement control."""
        edge, t = self.at(radius)
        tilt = tilt_of(self.cone.state(edge, t))
        self._last = (radius, t, -tilt)
        return float(-(t + edge.slope) - edge.gap * tilt)

    def force_climb_at(self, radius: float) -> float:
        """Return dF/drho along the branch."""
        return self.point(radius).force_climb

    def point(self, radius: float) -> Point:
        """Return the equilibrium at one radius."""
        if radius == 0.0:
            return self.node(-1)
        edge, t = self.at(radius)
        state = self.cone.state(edge, t)
        tilt = tilt_of(state)
        self._last = (radius, t, -tilt)
        position = self.cone.position(edge, t)
        return Point(radius, t, position, state.force, state.force_radius - state.force_t * tilt)

    def node(self, index: int) -> Point:
        """Return a node of the scan."""
        columns = (self.radius, self.t, self.position, self.force, self.force_climb)
        return Point(*(float(column[index]) for column in columns))

    def nodes(self, indices: range) -> list[Point]:
        """Return several nodes of the scan."""
        part = slice(indices.start, indices.stop)
        columns = (self.radius, self.t, self.position, self.force, self.force_climb)
        return [Point(*row) for row in zip(*(column[part].tolist() for column in columns), strict=True)]

    def turning(self, index: int) -> Point:
        """Return the extremum of z between the nodes ``index`` and ``index + 1``."""
        before, after = self.node(index), self.node(index + 1)
        return self._solve(self.climb_at, before, after, float(self.climb[index]), float(self.climb[index + 1]))

    def lowest_force(self, before: Point, after: Point) -> Point:
        """Return the minimum of the force between two points where dF/drho differs in sign."""
        return self._solve(self.force_climb_at, before, after, before.force_climb, after.force_climb)

    def where_force_vanishes(self, before: Point, after: Point) -> Point:
        """Return the zero of the force between two points of one stretch of the branch.

        Without pressure the branch has an infinite slope dt/drho there, so not the force along the branch is solved
        for zero but the residual along the curve on which the force vanishes.
        """

        def residual(radius: float) -> float:
            edge = self.cone.edge(radius)
            return float(self.cone.residual(edge, self._forceless(edge, before.t, after.t))[0])

        low, high = residual(before.radius), residual(after.radius)
        if not low > 0 > high:
            return self._solve(lambda radius: self.point(radius).force, before, after, before.force, after.force)
        radius = bracketed(residual, before.radius, after.radius, low, high)
        edge = self.cone.edge(radius)
        t = self._forceless(edge, before.t, after.t)
        return Point(radius, t, self.cone.position(edge, t), 0.0, 0.0)

    def _forceless(self, edge: Edge, low: float, high: float) -> float:
        """Return the slope t at which the force vanishes; the force falls with t."""

        def force(t: float) -> float:
            return float(self.cone.state(edge, t).force)

        width = max(high - low, EPSILON)
        floor = self._floor(edge)
        low = max(low, floor)
        while force(low) < 0 and low > floor:
            low = max(low - width, floor)
            width *= 2
        while force(high) > 0:
            high += width
            width *= 2
        return bracketed(force, low, high, force(low), force(high))

    def _floor(self, edge: Edge) -> float:
        """Return the lowest meaningful slope: along the sphere's tangent, or where the chamber is all but empty."""
        gas = self.cone.gas
        if not isinstance(gas, Isothermal):
            return float(-edge.slope)
        level = gas.anchor + gas.offset - edge.cap
        emptied = -level / (edge.gap * (1 + edge.radius + edge.radius**2)) if edge.gap > 0 else -math.inf
        return float(max(-edge.slope, emptied + 1e-9 * abs(emptied)))

    def where_position_is(self, position: float, before: Point, after: Point) -> Point:
        """Return the point at a height between those of two points of one stretch of the branch."""
        return self._solve(
            lambda radius: self.point(radius).position - position,
            before,
            after,
            before.position - position,
            after.position - position,
        )

    def _solve(
        self, function: Callable[[float], float], before: Point, after: Point, value_before: float, value_after: float
    ) -> Point:
        width = before.radius - after.radius
        self._last = (before.radius, before.t, (before.t - after.t) / width if width else 0.0)
        return self.point(bracketed(function, before.radius, after.radius, value_before, value_after))
