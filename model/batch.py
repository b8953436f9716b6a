"""Many scenes of the cone model in one vectorised call: for sweeps, campaigns and fits.

The equations and the scan are those of ``model.cone``; only the refinement runs on all scenes at once. The few scenes
whose contact jumps between several stable stretches are handed to the scalar solver.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from model import cone
from model.cone_branch import COARSE, bounds, largest_slope, tilts
from model.cone_error import SAFETY, rounding
from model.cone_terms import Cone, Edge, Isothermal, Vented
from model.errors import NotConverged
from model.parameters import GasAnchor, Parameters
from model.prediction import Array, Outcome
from model.roots import EPSILON, bracketed_many
from model.start import check, start_position, start_radius

if TYPE_CHECKING:
    import pandas as pd

NODES = 24
STEPS = 8
SETTLED = 1e-7
"""A Newton step this small leaves an error of its square."""
TOLERANCE = 1e-11
"""Relative width of the bracket of a contact radius; z and F_r are extremal there, or vary with it linearly."""
BLOCK = 4096
"""Scenes per vectorised block; fixed, so that results do not depend on how a sweep is distributed."""

ERRORS = ("pull_off_force", "pull_off_distance")
FEATURES = (
    "pull_off_force",
    "pull_off_distance",
    "retraction_at_pull_off",
    "zero_force_position",
    "onset_position",
    "detachment_position",
    "detachment_radius",
)


@dataclass(frozen=True)
class Batch:
    """Features of many scenes, arrays in the order of the scenes; SI units, ``nan`` where undefined."""

    model: str
    outcome: NDArray[np.object_]
    pull_off_force: Array
    pull_off_distance: Array
    retraction_at_pull_off: Array
    zero_force_position: Array
    onset_position: Array
    detachment_position: Array
    detachment_radius: Array
    numerical_error: dict[str, Array]
    """Absolute errors of F_p and D_p."""
    runtime_s: float
    scalar_scenes: int
    """Scenes solved one by one because their contact jumps or their chamber is special."""
    evaluations: int
    """Evaluations of the elastic energy."""

    def frame(self) -> pd.DataFrame:
        """Return the features as a DataFrame with units in the column names."""
        import pandas as pd

        units = {name: "N" if name.endswith("force") else "m" for name in FEATURES}
        columns = {f"{name}_{unit}": getattr(self, name) for name, unit in units.items()}
        columns |= {f"{name}_error_{units[name]}": self.numerical_error[name] for name in ERRORS}
        return pd.DataFrame({"outcome": [str(outcome) for outcome in self.outcome], **columns})


def solve_many(scenes: Sequence[Parameters], *, contact_stretch: bool = True, nodes: int = NODES) -> Batch:
    """Predict the features of many scenes.

    Parameters
    ----------
    scenes
        The scenes, SI units; of any kind and in any order.
    contact_stretch
        As in ``model.cone.solve``.
    nodes
        Radii of the scan; the features are refined to convergence from it.

    Raises
    ------
    InvalidParameter
        A parameter of a scene lies outside its physical range.
    """
    begin = time.perf_counter()
    for scene in scenes:
        check(scene)
    features = {name: np.full(len(scenes), np.nan) for name in FEATURES}
    errors = {name: np.full(len(scenes), np.nan) for name in ERRORS}
    outcome = np.full(len(scenes), Outcome.PULL_OFF, dtype=object)
    alone = [k for k, scene in enumerate(scenes) if not _is_regular(scene)]
    kinds: dict[tuple[bool, bool], list[int]] = {}
    irregular = set(alone)
    evaluations = 0
    for k, scene in enumerate(scenes):
        if k not in irregular:
            kind = (scene.substrate.shape == "sphere", scene.gas.anchor is GasAnchor.VENTED)
            kinds.setdefault(kind, []).append(k)
    for members in kinds.values():
        for first in range(0, len(members), BLOCK):
            block = members[first : first + BLOCK]
            values, solved, count = _solve_block([scenes[k] for k in block], contact_stretch, nodes)
            evaluations += count
            for name in FEATURES:
                features[name][block] = values[name]
            for name in ERRORS:
                errors[name][block] = values[name + " error"]
            alone += [k for k, fine in zip(block, solved, strict=True) if not fine]
    for k in alone:
        prediction = cone.solve(scenes[k], contact_stretch=contact_stretch, points=16)
        outcome[k] = prediction.outcome
        evaluations += prediction.evaluations.get("elastic energy", 0)
        for name in FEATURES:
            features[name][k] = getattr(prediction, name)
        for name in ERRORS:
            errors[name][k] = prediction.numerical_error.get(name, np.nan)
    return Batch(
        model="cone" if contact_stretch else "cone-2017",
        outcome=outcome,
        runtime_s=time.perf_counter() - begin,
        numerical_error=errors,
        scalar_scenes=len(alone),
        evaluations=evaluations,
        **features,
    )


def _is_regular(scene: Parameters) -> bool:
    """Whether the scene needs none of the limits only the scalar solver treats."""
    return (
        scene.gas.anchor is not GasAnchor.MEASURED
        and scene.membrane.work_of_adhesion > 0
        and start_radius(scene.substrate, scene.gripper) < scene.gripper.radius
    )


def _solve_block(
    scenes: Sequence[Parameters], contact_stretch: bool, nodes: int
) -> tuple[dict[str, Array], NDArray[np.bool_], int]:
    """Return the features of scenes of one kind, which of them are solved, and evaluations of the energy."""
    solved = np.zeros(len(scenes), dtype=bool)
    names = (*FEATURES, *(name + " error" for name in ERRORS))
    values = {name: np.full(len(scenes), np.nan) for name in names}
    columns = _columns(scenes, contact_stretch)
    opened = np.flatnonzero(_start_volume(columns.cone) > 0).tolist()
    if not opened:
        return values, solved, 0
    if len(opened) < len(scenes):
        columns = _columns([scenes[k] for k in opened], contact_stretch)
    try:
        with np.errstate(all="ignore"):
            features, fine = _Refinement(columns, nodes).features()
    except NotConverged:
        return values, solved, columns.cone.evaluations.get("elastic energy", 0)
    solved[opened] = fine
    for name in names:
        values[name][opened] = features[name]
    return values, solved, columns.cone.evaluations["elastic energy"]


def _start_volume(columns: Cone) -> Array:
    if not isinstance(columns.gas, Isothermal):
        return np.ones(np.shape(columns.start_radius)[0])
    volume: Array = (columns.gas.anchor + columns.gas.offset + cone.start_growth(columns))[:, 0]
    return volume


@dataclass
class _Block:
    """A block of scenes of one kind as columns, and their scales."""

    cone: Cone
    length: Array
    force: Array


def _columns(scenes: Sequence[Parameters], contact_stretch: bool) -> _Block:
    """Return the dimensionless scenes with one column per quantity."""
    R_0, stiffness, adhesion, r_b, r_i, z_0, V_0, P_0, P_atm = np.array(
        [
            (
                scene.gripper.radius,
                scene.membrane.youngs_modulus * scene.membrane.thickness,
                scene.membrane.work_of_adhesion,
                scene.substrate.radius,
                start_radius(scene.substrate, scene.gripper),
                start_position(scene.substrate, scene.gripper),
                scene.gripper.chamber_volume,
                scene.gas.initial_pressure,
                scene.gas.atmospheric_pressure,
            )
            for scene in scenes
        ]
    ).T[:, :, None]
    pressure = stiffness / (2 * R_0)
    first = scenes[0]
    columns = Cone(
        adhesion=12 * adhesion / stiffness,
        sphere=None if first.substrate.shape == "flat" else r_b / R_0,
        start_radius=r_i / R_0,
        start_position=z_0 / R_0,
        gas=Vented(P_0 / pressure),
        contact_stretch=contact_stretch,
    )
    if first.gas.anchor is not GasAnchor.VENTED:
        at_start = np.array([[scene.gas.anchor is GasAnchor.START] for scene in scenes])
        growth = np.where(at_start, cone.start_growth(columns), 0.0)
        chamber = V_0 / (np.pi * R_0**3 / 3)
        columns.gas = Isothermal(P_0 / pressure, P_atm / pressure, chamber + growth, -growth)
    return _Block(columns, R_0, np.pi * stiffness * R_0 / 6)


def column(values: Array) -> Array:
    """Return the only column of a matrix."""
    return values[:, 0]


class _Refinement:
    """The scan of a block of scenes and the refinement of its features, one row per scene."""

    def __init__(self, block: _Block, nodes: int) -> None:
        self.block, self.cone = block, block.cone
        half = np.sin(np.linspace(np.pi / 2, 0.0, nodes + 1)[:-1]) ** 2
        self.radius = self.cone.start_radius * half
        edge = self.cone.edge(self.radius)
        self.t = largest_slope(self.cone, edge, COARSE)
        value, slope = self.cone.residual(edge, self.t)
        self.t = self.t - np.where(value == 0, 0.0, value / slope)
        self.start_edge = Edge(*(part[:, :1] if isinstance(part, np.ndarray) else part for part in edge))
        self.position = self.cone.position(edge, self.t)
        self.force, self.climb, self.force_climb = self._slopes(edge, self.t)
        self.rows = np.arange(self.radius.shape[0])
        self.fine = np.ones(self.rows.size, dtype=bool)
        self._append_apex()

    def _slopes(self, edge: Edge, t: Array) -> tuple[Array, Array, Array]:
        """Return the force and the slopes dz/drho and dF/drho of the branch."""
        state = self.cone.state(edge, t)
        tilt = tilts(state)
        return (
            state.force + np.zeros_like(t),
            -(t + edge.slope) - edge.gap * tilt,
            state.force_radius - state.force_t * tilt,
        )

    def _append_apex(self) -> None:
        """Add the limit r -> 0 as the last column, as ``Branch`` does."""
        zero = np.zeros_like(self.radius[:, :1])
        edge = self.cone.edge(zero)
        pressure = self.cone.state(edge, zero).pressure + zero
        inflated = pressure > 0
        t = np.where(inflated, self._inflated(edge, zero, inflated), 0.0)
        state = self.cone.state(edge, t)
        bend = 0.0 if self.cone.sphere is None else 1 / self.cone.sphere
        suction = pressure < 0
        slope = np.where(suction, self.cone.adhesion / -np.where(suction, pressure, -1.0) - bend, np.inf)
        slope = np.where(inflated, -tilts(state), slope)
        columns = {
            "radius": zero,
            "t": t,
            "position": t,
            "force": np.where(inflated, 0.0, state.force),
            "climb": slope - t,
            "force_climb": np.where(np.isfinite(slope), state.force_radius + state.force_t * slope, -np.inf),
        }
        for name, column in columns.items():
            setattr(self, name, np.concatenate((getattr(self, name), column), axis=1))

    def _inflated(self, edge: Edge, zero: Array, inflated: NDArray[np.bool_]) -> Array:
        """Return the slope of the inflated cone without contact, where the force vanishes."""
        t: Array = bounds(self.cone, Edge(*(part + zero for part in edge)))[1]
        for _ in range(60):
            state = self.cone.state(edge, t)
            step = np.where(inflated, state.force / np.where(inflated, state.force_t, 1.0), 0.0)
            t = np.maximum(t - step, 0.0)
            if (np.abs(step) <= 1e-12 * t)[inflated].all():
                break
        return t

    def features(self) -> tuple[dict[str, Array], NDArray[np.bool_]]:
        """Return the features in SI units and which rows are solved."""
        top = self._fold()
        self._end_at_fold(top)
        peak_force, peak_position, peak = self._peak(top)
        zero, crossing = self._zero(top)
        end = top + 1
        detachment, radius = self.position[self.rows, end], self.radius[self.rows, end]
        force_error = self._rounding(*peak)[0]
        position_error = self._rounding(radius, self.t[self.rows, end])[1] + crossing
        length, force = self.block.length[:, 0], self.block.force[:, 0]
        self.fine &= np.isfinite(detachment + zero + peak_force)
        return {
            "pull_off_force": -peak_force * force,
            "pull_off_distance": (detachment - zero) * length,
            "retraction_at_pull_off": (peak_position - zero) * length,
            "zero_force_position": zero * length,
            "onset_position": self.position[:, 0] * length,
            "detachment_position": detachment * length,
            "detachment_radius": radius * length,
            "pull_off_force error": force_error * force,
            "pull_off_distance error": position_error * length,
        }, self.fine

    def _rounding(self, radius: Array, t: Array) -> tuple[Array, Array]:
        """Return the rounding errors of F_r and z on the branch, as ``cone_error`` does for one scene."""
        edge, t = self.cone.edge(radius[:, None]), t[:, None]
        residual, force, position = rounding(self.cone, edge, t)
        state = self.cone.state(edge, t)
        slope = np.where(state.residual_t > 0, residual / state.residual_t, np.abs(t))
        unit = SAFETY * EPSILON
        return (
            column(unit * (force + np.abs(state.force_t) * slope)),
            column(unit * (position + edge.gap * slope) + np.zeros_like(t)),
        )

    def _fold(self) -> Array:
        """Return the last node before the contact detaches; rows that may jump are left to the scalar solver."""
        falls = self.climb > 0
        top = np.where(falls.any(axis=1), np.argmax(falls, axis=1), falls.shape[1]) - 1
        later = np.arange(falls.shape[1]) > top[:, None]
        self.fine &= ~(later & ~falls).any(axis=1)
        last: Array = np.minimum(top, falls.shape[1] - 2)
        return last

    def _end_at_fold(self, top: Array) -> None:
        """Replace the node after the last stable one by the fold, or by the onset where that is the fold."""
        corner = top < 0
        before, after = np.maximum(top, 0), top + 1
        turning = ~corner & (self.climb[self.rows, after] > 0)
        radius, t = self.radius[self.rows, after], self.t[self.rows, after]
        found = self._root(1, before, np.maximum(after, 1), turning)
        radius, t = np.where(turning, found[0], radius), np.where(turning, found[1], t)
        edge = self.cone.edge(radius[:, None])
        force, _, force_climb = self._slopes(edge, t[:, None])
        keep = (radius == 0) | corner
        for name, column in (("radius", radius), ("t", t), ("position", self.cone.position(edge, t[:, None])[:, 0])):
            values = getattr(self, name)
            values[self.rows, after] = np.where(keep, values[self.rows, after], column)
        self.force[self.rows, after] = np.where(keep, self.force[self.rows, after], force[:, 0])
        self.force_climb[self.rows, after] = np.where(keep, self.force_climb[self.rows, after], force_climb[:, 0])

    def _peak(self, top: Array) -> tuple[Array, Array, tuple[Array, Array]]:
        """Return the lowest force up to the fold, its z, and its radius and t."""
        index = np.arange(self.force.shape[1])
        force = np.where(index <= (top + 1)[:, None], self.force, np.inf)
        k = np.argmin(force, axis=1)
        last = top + 1
        left, right = np.maximum(k - 1, 0), np.minimum(k + 1, last)
        here = self.force_climb[self.rows, k]
        on_left = (self.force_climb[self.rows, left] > 0) & (here < 0) & (left < k)
        on_right = (here > 0) & (self.force_climb[self.rows, right] < 0) & (right > k)
        inner = on_left | on_right
        self.fine &= ~self._hides_minimum(last)
        radius, t = self._root(2, np.where(on_left, left, k), np.where(on_left, k, right), inner)
        edge = self.cone.edge(radius[:, None])
        refined = self.cone.state(edge, t[:, None]).force[:, 0]
        self.fine &= ~inner | self._resolved(np.where(on_left, left, k), np.where(on_left, k, right), radius, refined)
        inner &= refined <= force[self.rows, k]
        return (
            np.where(inner, refined, force[self.rows, k]),
            np.where(inner, self.cone.position(edge, t[:, None])[:, 0], self.position[self.rows, k]),
            (np.where(inner, radius, self.radius[self.rows, k]), np.where(inner, t, self.t[self.rows, k])),
        )

    def _resolved(self, before: Array, after: Array, radius: Array, force: Array) -> NDArray[np.bool_]:
        """Whether Hermite's cubic between two nodes foretells the minimum found between them: no second one hides."""
        depth = np.maximum(self.force[self.rows, before], self.force[self.rows, after]) - force
        resolved: NDArray[np.bool_] = np.abs(self._foretold(before, after, radius) - force) <= 0.5 * depth
        return resolved

    def _foretold(self, before: Array, after: Array, radius: Array) -> Array:
        """Return the force between two nodes by Hermite's cubic."""
        rows = self.rows
        width = self.radius[rows, after] - self.radius[rows, before]
        x = (radius - self.radius[rows, before]) / width
        rise = self.force[rows, after] - self.force[rows, before]
        a = self.force_climb[rows, before] * width - rise
        b = rise - self.force_climb[rows, after] * width
        force: Array = self.force[rows, before] + x * rise + x * (1 - x) * (a * (1 - x) + b * x)
        return force

    def _hides_minimum(self, last: Array) -> NDArray[np.bool_]:
        """Whether the force has several minima, or rises between two nodes at both of which it falls or the reverse."""
        falls = self.force_climb > 0
        rising = np.diff(self.force, axis=1) > 0
        inside = np.arange(1, self.force.shape[1]) <= last[:, None]
        inconsistent = (inside & (falls[:, 1:] == falls[:, :-1]) & (rising == falls[:, 1:])).any(axis=1)
        minima = (inside & falls[:, :-1] & ~falls[:, 1:]).sum(axis=1)
        hides: NDArray[np.bool_] = inconsistent | (minima > 1)
        return hides

    def _zero(self, top: Array) -> tuple[Array, Array]:
        """Return z where the force first turns tensile (at the start, pinned or on the branch) and its error."""
        edge, start = self.start_edge, self.cone.start_position[:, 0]
        t_0 = (self.cone.start_position + edge.drop) / edge.gap
        first = (self.cone.state(edge, t_0).force + np.zeros_like(t_0))[:, 0]
        last = self.force[:, 0]
        tensile = np.arange(self.force.shape[1]) <= (top + 1)[:, None]
        tensile &= self.force < 0
        self.fine &= tensile.any(axis=1)
        at_start, pinned = first <= 0, (first > 0) & (last < 0)
        held = bracketed_many(
            lambda t: column(self.cone.state(edge, t[:, None]).force + np.zeros_like(t_0)),
            np.where(pinned, t_0[:, 0], 0.0),
            np.where(pinned, self.t[:, 0], 0.0),
            first,
            last,
            TOLERANCE,
        )
        zero: Array = np.where(at_start, start, self.cone.position(edge, held[:, None])[:, 0])
        moving = ~at_start & ~pinned
        error = TOLERANCE * np.abs(self.cone.position(edge, held[:, None])[:, 0] - start)
        error = np.where(pinned, error, 0.0)
        if not moving.any():
            return zero, error
        k = np.maximum(np.argmax(tensile, axis=1), 1)
        radius, t = self._root(0, k - 1, k, moving)
        step = np.abs(self._foretold(k - 1, k, radius))
        self.fine &= ~moving | (step <= 0.1 * np.abs(self.force[self.rows, k - 1] - self.force[self.rows, k]))
        free_edge = self.cone.edge(radius[:, None])
        free = self.cone.position(free_edge, t[:, None])[:, 0]
        zero[moving] = free[moving]
        climb = column(self._slopes(free_edge, t[:, None])[1])
        error[moving] = (TOLERANCE * radius * np.abs(climb) + self._rounding(radius, t)[1])[moving]
        return zero, error

    def _root(self, which: int, before: Array, after: Array, wanted: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return radius and t where force (0), dz/drho (1) or dF/drho (2) vanishes between two nodes of each row."""
        values = (self.force, self.climb, self.force_climb)[which]
        rows = self.rows
        radius_a, radius_b = self.radius[rows, before], self.radius[rows, after]
        t_a, t_b = self.t[rows, before], self.t[rows, after]
        memory = [radius_a, t_a, (t_b - t_a) / np.where(radius_b == radius_a, 1.0, radius_b - radius_a)]

        def function(radius: Array) -> Array:
            edge = self.cone.edge(radius[:, None])
            t, settled = self._equilibrium(edge, memory[1] + memory[2] * (radius - memory[0]), wanted)
            self.fine &= settled
            memory[0], memory[1] = radius, t[:, 0]
            value: Array = self._slopes(edge, t)[which][:, 0]
            return value

        radius = bracketed_many(
            function,
            np.where(wanted, radius_a, radius_b),
            radius_b,
            np.where(wanted, values[rows, before], 1.0),
            np.where(wanted, values[rows, after], -1.0),
            TOLERANCE,
        )
        edge = self.cone.edge(radius[:, None])
        t, settled = self._equilibrium(edge, memory[1] + memory[2] * (radius - memory[0]), wanted)
        self.fine &= settled
        return radius, t[:, 0]

    def _equilibrium(self, edge: Edge, start: Array, wanted: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
        """Return t after Newton's steps from a close start, and which rows are settled or not wanted."""
        t = start[:, None]
        for _ in range(STEPS):
            value, slope = self.cone.residual(edge, t)
            step = value / slope
            t = t - step
            settled = (np.abs(step) <= SETTLED * (np.abs(t) + edge.slope))[:, 0] | ~wanted
            if settled.all():
                break
        on_branch = ((slope > 0) & (t + edge.slope >= 0))[:, 0] | ~wanted
        return t, settled & on_branch
