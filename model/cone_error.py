"""Rounding error of the cone model's features, propagated from the terms of the equations to first order.

The features are roots and extrema of closed-form functions solved until the steps no longer shrink, so what remains
is rounding: each term contributes its magnitude times the machine epsilon, divided by the slope of what was solved.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from model.cone_branch import Branch, Point, tilt_of
from model.cone_terms import Cone, Driven, Edge, Isothermal, Number, contact_energy, stretch_energy
from model.prediction import Array
from model.roots import EPSILON

SAFETY = 8.0
"""Rounding errors per term allowed for."""


class Uncertainty(NamedTuple):
    """Absolute errors at one equilibrium, dimensionless."""

    position: float
    force: float


def rounding(cone: Cone, edge: Edge, t: Number) -> tuple[Number, Number, Number]:
    """Return the summed magnitudes of the terms of residual, force and position."""
    energy, energy_t, _ = stretch_energy(t)
    tau = abs(t) + edge.slope
    pressure = pressure_terms(cone, edge, t)
    radius = edge.radius
    load = cone.adhesion * radius + abs(edge.load + cone.adhesion * radius)
    residual = (1 + radius) * tau * abs(energy_t) + 2 * radius * energy + load
    residual += pressure * (1 + 2 * radius) * edge.gap * tau
    force = (1 + radius) * abs(energy_t) + pressure * (1 + radius + radius**2)
    # The rounding of r / r_b, of which h has the derivative `slope`, is all that matters near the equator.
    return residual, force, edge.gap * abs(t) + edge.drop + edge.slope * radius


def pressure_terms(cone: Cone, edge: Edge, t: Number) -> Number:
    """Return the summed magnitudes of the terms of the gauge pressure."""
    gas = cone.gas
    if not isinstance(gas, Isothermal):
        return abs(gas.at(cone.position(edge, t))[0] if isinstance(gas, Driven) else gas.initial)
    change = cone.growth(edge, t) + gas.offset
    terms = edge.gap * abs(t) * (1 + edge.radius + edge.radius**2) + edge.cap + abs(gas.offset)
    return (abs(gas.initial) * gas.anchor + gas.atmosphere * terms) / (gas.anchor + change)


def on_branch(branch: Branch, point: Point) -> Uncertainty:
    """Return the errors of z and F_r at one contact radius."""
    cone = branch.cone
    edge = cone.edge(point.radius)
    residual, force, position = rounding(cone, edge, point.t)
    state = cone.state(edge, point.t)
    slope = residual / state.residual_t if state.residual_t > 0 else abs(point.t)
    unit = SAFETY * EPSILON
    return Uncertainty(unit * (position + edge.gap * slope), unit * (force + abs(state.force_t) * slope))


def when_pinned(branch: Branch, point: Point) -> Uncertainty:
    """Return the errors of z and F_r at one slope of the cone, the contact held at r_i."""
    cone = branch.cone
    _, force, position = rounding(cone, cone.edge(point.radius), point.t)
    return Uncertainty(SAFETY * EPSILON * position, SAFETY * EPSILON * force)


def of_features(branch: Branch, zero: Point, peak: Point, detachment: Point) -> dict[str, float]:
    """Return the absolute error of each feature, dimensionless."""
    at_zero, at_peak, at_end = (_anywhere(branch, point) for point in (zero, peak, detachment))
    zero_position = at_zero.position + at_zero.force * _yield(branch, zero)
    return {
        "pull_off_force": at_peak.force,
        "pull_off_distance": at_end.position + zero_position,
        "retraction_at_pull_off": at_peak.position
        + zero_position
        + _radius_at_peak(branch, peak) * _steepness(branch, peak),
        "zero_force_position": zero_position,
        "onset_position": on_branch(branch, branch.onset).position,
        "detachment_position": at_end.position,
        "detachment_radius": _radius_at_fold(branch, detachment),
    }


def of_energy(branch: Branch, ends: list[Point]) -> float:
    """Return the error of a sum of differences of the potential between these points, dimensionless."""
    return sum(_error_of_potential(branch, point) for point in ends)


def _error_of_potential(branch: Branch, point: Point) -> float:
    cone = branch.cone
    edge = cone.edge(point.radius)
    terms = (1 + point.radius) * edge.gap * stretch_energy(point.t)[0] + cone.adhesion * point.radius**2
    if cone.sphere is not None and cone.contact_stretch and point.radius > 0:
        terms += contact_energy(point.radius, cone.sphere)
    gas = cone.gas
    level = abs(gas.initial) + gas.atmosphere if isinstance(gas, Isothermal) else pressure_terms(cone, edge, point.t)
    terms += level * (edge.gap * edge.area * abs(point.t) + edge.cap)
    moved = abs(cone.state(edge, point.t).force) * _anywhere(branch, point).position
    return float(SAFETY * EPSILON * terms + moved)


def _anywhere(branch: Branch, point: Point) -> Uncertainty:
    return (when_pinned if _is_pinned(branch, point) else on_branch)(branch, point)


def _is_pinned(branch: Branch, point: Point) -> bool:
    return bool(point.radius == branch.cone.start_radius and point.t < branch.onset.t)


def _yield(branch: Branch, point: Point) -> float:
    """Return |dz/dF| along the path, by which an error of the force shifts a zero of the force."""
    cone = branch.cone
    edge = cone.edge(point.radius)
    state = cone.state(edge, point.t)
    if _is_pinned(branch, point):
        return abs(edge.gap / state.force_t) if state.force_t else 0.0
    tilt = state.residual_radius / state.residual_t if state.residual_t else 0.0
    climb = point.t + edge.slope + edge.gap * tilt
    force_climb = state.force_radius - state.force_t * tilt
    return abs(climb / force_climb) if force_climb else 0.0


def _radius_at_fold(branch: Branch, fold: Point) -> float:
    """Return the error of the radius where dz/drho vanishes; none where an end of the branch is the fold."""
    if _is_end(branch, fold):
        return 0.0
    edge, tilt = _edge_and_tilt(branch, fold)
    terms = float(abs(fold.t) + edge.slope + edge.gap * abs(tilt))
    return SAFETY * EPSILON * (fold.radius + terms / _bend(branch, branch.climb, fold.radius))


def _radius_at_peak(branch: Branch, peak: Point) -> float:
    """Return the error of the radius where dF/drho vanishes; none at the onset."""
    if _is_end(branch, peak) or _is_pinned(branch, peak):
        return 0.0
    edge, tilt = _edge_and_tilt(branch, peak)
    state = branch.cone.state(edge, peak.t)
    terms = float(abs(state.force_radius) + abs(state.force_t * tilt))
    return SAFETY * EPSILON * (peak.radius + terms / _bend(branch, branch.force_climb, peak.radius))


def _is_end(branch: Branch, point: Point) -> bool:
    return point.radius in (0.0, branch.cone.start_radius)


def _edge_and_tilt(branch: Branch, point: Point) -> tuple[Edge, float]:
    edge = branch.cone.edge(point.radius)
    return edge, tilt_of(branch.cone.state(edge, point.t))


def _steepness(branch: Branch, point: Point) -> float:
    """Return |dz/drho| along the branch."""
    edge, tilt = _edge_and_tilt(branch, point)
    return float(abs(point.t + edge.slope + edge.gap * tilt))


def _bend(branch: Branch, slopes: Array, radius: float) -> float:
    """Return the magnitude of the derivative of a slope between the two nodes around a radius."""
    k = min(int(np.searchsorted(-branch.radius, -radius)), branch.radius.size - 1)
    bend = abs(slopes[k] - slopes[k - 1]) / (branch.radius[k - 1] - branch.radius[k])
    return float(bend) if np.isfinite(bend) and bend > 0 else 1.0
