"""The path of one pull-off: pinned at r_i, then along the stable stretches of the branch, with jumps between them.

EML Eq. 10 for the contact, Eq. 11 for the force, Eqs. 12-14 for the start.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from model.cone_branch import Branch, Point
from model.cone_terms import Driven
from model.roots import EPSILON, bracketed

PINNED_NODES = 33


@dataclass(frozen=True)
class Stretch:
    """A stable stretch of the branch, from ``first`` to ``last`` as z grows; ``nodes`` of the scan lie between them."""

    first: Point
    last: Point
    nodes: range

    def points(self, branch: Branch) -> list[Point]:
        """Return its ends and the nodes of the scan between them."""
        return [self.first, *branch.nodes(self.nodes), self.last]


@dataclass(frozen=True)
class Pinned:
    """The contact held at r_i from z_0 to the onset, as a curve in the slope t of the cone."""

    first: Point
    last: Point


@dataclass(frozen=True)
class Path:
    """What happens while z grows."""

    pinned: Pinned
    stretches: tuple[Stretch, ...]

    @property
    def onset(self) -> Point:
        """Where the contact line first leaves r_i."""
        return self.stretches[0].first

    @property
    def detachment(self) -> Point:
        """The last stable contact."""
        return self.stretches[-1].last


def trace(branch: Branch, start_slope: float) -> Path:
    """Follow the contact line from z_0 to detachment."""
    onset = branch.onset
    start = _pinned_point(branch, min(start_slope, onset.t))
    return Path(Pinned(start, onset), tuple(_stretches(branch)))


def _stretches(branch: Branch) -> list[Stretch]:
    """Return the stable stretches: z climbs to a maximum, the contact jumps to the next radius that holds at that z."""
    path: list[Stretch] = []
    trough: Point | None = None
    begin = 0
    last = len(branch.radius) - 1
    falls = branch.climb > 0  # z falls as the radius shrinks: unstable
    landed = branch.onset
    turns = np.flatnonzero(falls[1:] != falls[:-1]).tolist()
    for index in ([-1] if falls[0] else []) + turns + ([] if falls[last] else [last]):
        if 0 <= index < last and falls[index]:
            trough, begin = branch.turning(index), index + 1
            continue
        top = branch.turning(index) if 0 <= index < last else branch.onset if index < 0 else branch.node(last)
        if path:
            level = path[-1].last.position
            if top.position <= level or trough is None:
                continue
            landed = branch.where_position_is(level, trough, top)
        inside = np.flatnonzero((branch.radius < landed.radius) & (branch.radius > top.radius))
        inside = inside[inside >= begin]
        path.append(Stretch(landed, top, range(inside[0], inside[-1] + 1) if inside.size else range(0)))
    return path


def _pinned_point(branch: Branch, t: float) -> Point:
    cone = branch.cone
    edge = cone.start_edge
    return Point(cone.start_radius, t, cone.position(edge, t), cone.state(edge, t).force, 0.0)


def pinned_points(branch: Branch, path: Path) -> list[Point]:
    """Return the ends of the pinned part, where the force is monotonic; many points under a measured pressure."""
    first, last = path.pinned.first, path.pinned.last
    if not isinstance(branch.cone.gas, Driven):
        return [first, last]
    edge = branch.cone.start_edge
    knots = (branch.cone.gas.position + edge.drop) / edge.gap if edge.gap > 0 else np.empty(0)
    slopes = np.unique(np.concatenate((np.linspace(first.t, last.t, PINNED_NODES), knots)))
    inner = slopes[(slopes > first.t) & (slopes < last.t)]
    return [first, *(_pinned_point(branch, float(t)) for t in inner), last]


def zero_of_force(branch: Branch, path: Path) -> Point | None:
    """Return where the force first turns from compression to tension; None if it never does."""
    pinned = pinned_points(branch, path)
    if pinned[0].force < 0:
        return pinned[0]
    for before, after in itertools.pairwise(pinned):
        if after.force < 0:
            return _pinned_zero(branch, before, after)
    for stretch in path.stretches:
        if stretch.first.force < 0:
            return stretch.first
        for before, after in itertools.pairwise(stretch.points(branch)):
            if after.force < 0:
                return branch.where_force_vanishes(before, after)
    return None


def _pinned_zero(branch: Branch, before: Point, after: Point) -> Point:
    """Return the zero of the force while the contact is held: Newton's steps, or bisection where they leave."""
    cone, edge = branch.cone, branch.cone.start_edge
    t = after.t
    for _ in range(20):
        state = cone.state(edge, t)
        if not state.force_t < 0:
            break
        step = state.force / state.force_t
        t -= step
        if not before.t <= t <= after.t:
            break
        if abs(step) <= 4 * EPSILON * abs(t):
            return _pinned_point(branch, t)
    t = bracketed(lambda t: cone.state(edge, t).force, before.t, after.t, before.force, after.force)
    return _pinned_point(branch, t)


def strongest_pull(branch: Branch, path: Path) -> Point:
    """Return where the force is most tensile."""
    held = pinned_points(branch, path)
    best = min(reversed(held), key=lambda point: point.force)
    for stretch in path.stretches:
        best = min(_strongest_of(branch, stretch), best, key=lambda point: point.force)
    return best


def _strongest_of(branch: Branch, stretch: Stretch) -> Point:
    """Return the lowest force of a stretch: a node, or the minimum between two whose slopes dF/dr differ in sign."""
    points = stretch.points(branch)
    best = min(points, key=lambda point: point.force)
    for before, after in itertools.pairwise(points):
        if before.force_climb > 0 and (after.force_climb <= 0 or after.force >= before.force):
            beyond = _past_minimum(branch, before, after)
            if beyond.force_climb < 0:
                best = min(best, branch.lowest_force(before, beyond), key=lambda point: point.force)
    return best


def _past_minimum(branch: Branch, before: Point, after: Point) -> Point:
    """Return a point where the force rises again: ``after``, or one nearer if it falls at both ends but not between."""
    for _ in range(30):
        if after.force_climb < 0:
            return after
        middle = branch.point((before.radius + after.radius) / 2)
        if middle.force_climb < 0:
            return middle
        before, after = (middle, after) if middle.force < before.force else (before, middle)
    return after
