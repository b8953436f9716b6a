"""The membrane-adhesion model of both papers: a truncated cone between rim and contact edge.

``cone`` is EML 2020 Eqs. 1-14, ``cone-2017`` the same without the energy stored in the contact (PNAS 2017 SI, S3-S12).
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.cone_branch import Branch, Point, settled_state
from model.cone_error import of_energy, of_features
from model.cone_path import Path, strongest_pull, trace, zero_of_force
from model.cone_terms import Cone, Driven, Gas, Isothermal, Number, Vented
from model.parameters import GasAnchor, Parameters
from model.prediction import Array, Jump, Outcome, Prediction
from model.start import check, start_position, start_radius

NODES = 64
"""Radii at which the branch is scanned for folds; the features themselves are solved to machine precision."""


class Equilibria(NamedTuple):
    """The whole branch of equilibria, unstable ones included, from r_i down to the apex; SI units."""

    contact_radius: Array
    position: Array
    force: Array
    stable: NDArray[np.bool_]
    """Under displacement control: d2Pi/dr2 > 0."""


DIGITS_LOST = 1e-10
"""Relative rounding error of F_p from which on a prediction warns."""


class Scales(NamedTuple):
    """What the dimensionless quantities are multiplied with, SI."""

    length: float
    force: float
    pressure: float

    @property
    def energy(self) -> float:
        """J."""
        return self.force * self.length


def solve(parameters: Parameters, *, contact_stretch: bool = True, points: int = 200, nodes: int = NODES) -> Prediction:
    """Predict one pull-off test with the cone model.

    Parameters
    ----------
    parameters
        The scene, SI units.
    contact_stretch
        Whether the stretch of the membrane in contact stores energy (EML's W_2) or not (PNAS 2017).
    points
        Number of points of the profile; the features do not depend on it.
    nodes
        Radii of the scan that brackets folds, peaks and crossings.

    Raises
    ------
    InvalidParameter
        A parameter lies outside its physical range.
    NotConverged
        The equilibrium could not be solved.
    """
    begin = time.perf_counter()
    check(parameters)
    cone, scales = nondimensional(parameters, contact_stretch)
    name = "cone" if contact_stretch else "cone-2017"
    assumptions = {
        "shape": "truncated cone",
        "gas anchor": str(parameters.gas.anchor),
        "contact stretch": "uniform (EML Eq. 5)" if contact_stretch and cone.sphere is not None else "none",
    }

    def without_features(outcome: Outcome) -> Prediction:
        return Prediction(
            name, outcome, assumptions, evaluations=cone.evaluations, runtime_s=time.perf_counter() - begin
        )

    edge = cone.start_edge
    height = cone.start_position + edge.drop
    if isinstance(cone.gas, Isothermal) and cone.gas.anchor + cone.gas.offset + start_growth(cone) <= 0:
        return without_features(Outcome.CHAMBER_CLOSED)
    if cone.adhesion == 0 and cone.sphere is None and not cone.state(edge, 0.0).pressure > 0:
        suction = cone.state(edge, 0.0).pressure < 0
        return without_features(Outcome.NO_EQUILIBRIUM if suction else Outcome.NO_ADHESION)
    branch = Branch(cone, nodes)
    path = trace(branch, height / edge.gap if edge.gap > 0 else -edge.slope)
    zero = zero_of_force(branch, path)
    if zero is None:
        return without_features(Outcome.NO_ADHESION)
    peak = strongest_pull(branch, path)
    profile = sample(branch, path, (zero, peak), points)
    detachment = path.detachment
    length, force = scales.length, scales.force
    energy, energy_error = adhesion_energy(branch, path, zero, profile)
    errors = of_features(branch, zero, peak, detachment) | {"adhesion_energy": energy_error}
    units = {"pull_off_force": force, "adhesion_energy": scales.energy}
    return Prediction(
        name,
        Outcome.PULL_OFF,
        assumptions,
        pull_off_force=-peak.force * force,
        pull_off_distance=(detachment.position - zero.position) * length,
        retraction_at_pull_off=(peak.position - zero.position) * length,
        zero_force_position=zero.position * length,
        onset_position=path.onset.position * length,
        detachment_position=detachment.position * length,
        detachment_radius=detachment.radius * length,
        adhesion_energy=energy * scales.energy,
        position=profile.position * length,
        retraction=(profile.position - zero.position) * length,
        force=profile.force * force,
        pressure=profile.pressure * scales.pressure,
        contact_radius=profile.radius * length,
        stable=np.ones(len(profile.radius), dtype=bool),
        jumps=tuple(_jumps(path, scales)),
        numerical_error={name: error * units.get(name, length) for name, error in errors.items()},
        runtime_s=time.perf_counter() - begin,
        evaluations=cone.evaluations,
        warnings=_warnings(cone, height, errors["pull_off_force"] / -peak.force),
    )


def equilibria(parameters: Parameters, *, contact_stretch: bool = True, nodes: int = 200) -> Equilibria:
    """Return the branch dPi/dr = 0 that ``solve`` follows, at ``nodes`` contact radii.

    Raises
    ------
    InvalidParameter
        A parameter lies outside its physical range.
    NotConverged
        The equilibrium could not be solved.
    """
    check(parameters)
    cone, scales = nondimensional(parameters, contact_stretch)
    branch = Branch(cone, nodes)
    return Equilibria(
        branch.radius * scales.length,
        branch.position * scales.length,
        branch.force * scales.force,
        branch.climb <= 0,
    )


def _warnings(cone: Cone, height: float, relative_error: float) -> tuple[str, ...]:
    """Return what the reader of a prediction ought to know."""
    warnings = []
    edge = cone.start_edge
    if cone.sphere is not None and edge.gap > 0 and cone.residual(edge, height / edge.gap)[0] > 0:
        warnings.append(
            "at z_0 the cone would cut into the sphere; the contact is taken as held at r_i until it clears"
        )
    if relative_error > DIGITS_LOST:
        warnings.append(f"F_p is a small difference of large forces: relative rounding error {relative_error:.1e}")
    return tuple(warnings)


def nondimensional(parameters: Parameters, contact_stretch: bool) -> tuple[Cone, Scales]:
    """Return the dimensionless scene and its scales."""
    substrate, gripper, membrane = parameters.substrate, parameters.gripper, parameters.membrane
    length = gripper.radius
    stiffness = membrane.youngs_modulus * membrane.thickness  # N/m
    scales = Scales(length, math.pi * stiffness * length / 6, stiffness / (2 * length))
    cone = Cone(
        adhesion=12 * membrane.work_of_adhesion / stiffness,
        sphere=None if substrate.shape == "flat" else substrate.radius / length,
        start_radius=start_radius(substrate, gripper) / length,
        start_position=start_position(substrate, gripper) / length,
        gas=Vented(0.0),
        contact_stretch=contact_stretch,
    )
    cone.gas = _gas(parameters, scales, cone)
    return cone, scales


def _gas(parameters: Parameters, scales: Scales, cone: Cone) -> Gas:
    gas = parameters.gas
    initial, atmosphere = gas.initial_pressure / scales.pressure, gas.atmospheric_pressure / scales.pressure
    if gas.anchor is GasAnchor.VENTED:
        return Vented(initial)
    if gas.anchor is GasAnchor.MEASURED:
        assert gas.measured is not None
        position, pressure = (np.asarray(values, dtype=float) for values in gas.measured)
        return Driven(position / scales.length, pressure / scales.pressure)
    chamber = parameters.gripper.chamber_volume / (math.pi * scales.length**3 / 3)
    if gas.anchor is GasAnchor.START:
        growth = start_growth(cone)
        return Isothermal(initial, atmosphere, chamber + growth, -growth)
    return Isothermal(initial, atmosphere, chamber)


def start_growth(cone: Cone) -> Number:
    """Return V(z_0, r_i) - V_0, regular also where the contact reaches the rim."""
    edge, radius = cone.start_edge, cone.start_radius
    return (cone.start_position + edge.drop) * (1 + radius + radius**2) - edge.cap


def adhesion_energy(branch: Branch, path: Path, zero: Point, profile: Profile) -> tuple[float, float]:
    """Return the work of the force from its zero to detachment, and its error.

    It is the sum of the potential's differences between the jumps; where the pressure was measured there is no
    potential, and the force is integrated by trapezoids, whose error is told by those of twice the width.
    """
    if isinstance(branch.cone.gas, Driven):
        after = np.flatnonzero(profile.position >= zero.position)
        work, coarse = (
            float(-np.trapezoid(profile.force[kept], profile.position[kept]))
            for kept in (after, np.union1d(after[::2], after[-1:]))
        )
        return work, abs(work - coarse)
    pieces = list(_tense_pieces(path, zero))
    work = sum(_potential(branch.cone, last) - _potential(branch.cone, begin) for begin, last in pieces)
    return work, of_energy(branch, [point for piece in pieces for point in piece])


def _tense_pieces(path: Path, zero: Point) -> Iterator[tuple[Point, Point]]:
    """Yield where each stretch between two jumps begins and ends, from the zero of force on."""
    pieces = [(path.pinned.first, path.pinned.last), *((stretch.first, stretch.last) for stretch in path.stretches)]
    for first, last in pieces:
        begin = zero if first.position < zero.position <= last.position else first
        if begin.position >= zero.position and begin.position < last.position:
            yield begin, last


def _potential(cone: Cone, point: Point) -> float:
    return cone.potential(cone.edge(point.radius), point.t)


class Profile(NamedTuple):
    """Arrays along the path, dimensionless."""

    radius: Array
    position: Array
    force: Array
    pressure: Array


def sample(branch: Branch, path: Path, marks: tuple[Point, ...], points: int) -> Profile:
    """Return the path at about evenly spread points, the marked ones among them."""
    cone = branch.cone
    pinned, stretches = path.pinned, path.stretches
    whole = path.detachment.position - pinned.first.position
    share = (pinned.last.position - pinned.first.position) / whole if whole > 0 else 0.0
    inner = points - len(marks)
    held = max(2, round(inner * min(share, 0.5)))
    ends = np.linspace(held, inner, len(stretches) + 1).astype(int)
    radius, t = np.empty(inner), np.empty(inner)
    radius[:held] = cone.start_radius
    t[:held] = np.linspace(pinned.first.t, pinned.last.t, held + 1)[:-1]
    for stretch, first, last in zip(stretches, ends, ends[1:], strict=False):
        radius[first:last] = np.linspace(stretch.first.radius, stretch.last.radius, last - first)
    t[held:] = branch.guess(radius[held:])
    edge = cone.edge(radius)
    state, t = settled_state(cone, edge, t, held)
    position = cone.position(edge, t)
    keys = [
        np.searchsorted(t[:held], mark.t)
        if mark.t < pinned.last.t and mark.radius == cone.start_radius
        else held + np.searchsorted(-radius[held:], -mark.radius)
        for mark in marks
    ]
    order = np.argsort(np.concatenate((np.arange(inner), np.array(keys) - 0.5)), kind="stable")
    marked = [(mark.radius, mark.position, mark.force, cone.pressure(cone.edge(mark.radius), mark.t)) for mark in marks]
    columns = (radius, position, state.force, state.pressure + np.zeros(inner))
    return Profile(
        *(
            np.concatenate((column, extra))[order]
            for column, extra in zip(columns, zip(*marked, strict=True), strict=True)
        )
    )


def _jumps(path: Path, scales: Scales) -> list[Jump]:
    return [
        Jump(
            before.last.position * scales.length,
            before.last.radius * scales.length,
            after.first.radius * scales.length,
            before.last.force * scales.force,
            after.first.force * scales.force,
        )
        for before, after in zip(path.stretches, path.stretches[1:], strict=False)
    ]
