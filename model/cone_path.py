"""The path of one pull-off: pinned at r_i, then along the stable stretches of the branch, with jumps between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.cone_branch import Branch, Point
from model.cone_terms import Driven
from model.roots import bracketed

PINNED_NODES = 33


@dataclass(frozen=True)
class Stretch:
    """A stable stretch of the branch, from ``first`` to ``last`` as z grows; ``nodes`` of the scan lie between them."""

    first: Point
    last: Point
    nodes: range


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
    onset = branch.node(0)
    start = _pinned_point(branch, min(start_slope, onset.t))
    return Path(Pinned(start, onset), tuple(_stretches(branch)))


def _stretches(branch: Branch) -> list[Stretch]:
    """Return the stable stretches: z climbs to a maximum, the contact jumps to the next radius that holds at that z."""
    path: list[Stretch] = []
    trough: Point | None = None
    begin = 0
    last = len(branch.radius) - 1
    falls = branch.climb > 0  # z falls as the radius shrinks: unstable
    landed: Point | None = branch.node(0)
    for index in range(last + 1):
        if index < last and not falls[index] and falls[index + 1]:
            top, end = branch.turning(index), index
        elif (index == 0 and falls[0]) or (index == last and not falls[last]):
            top, end = branch.node(index), index - 1
        elif index < last and falls[index] and not falls[index + 1]:
            trough, begin = branch.turning(index), index + 1
            continue
        else:
            continue
        if path:
            level = path[-1].last.position
            if top.position <= level or trough is None:
                continue
            landed = branch.where_position_is(level, trough, top)
        assert landed is not None
        inside = [k for k in range(begin, end + 1) if top.radius < branch.radius[k] < landed.radius]
        path.append(Stretch(landed, top, range(inside[0], inside[-1] + 1) if inside else range(0)))
    return path


def _pinned_point(branch: Branch, t: float) -> Point:
    cone = branch.cone
    edge = cone.edge(cone.start_radius)
    return Point(cone.start_radius, t, cone.position(edge, t), cone.state(edge, t).force)


def pinned_points(branch: Branch, path: Path) -> list[Point]:
    """Return points of the pinned part among which the force is monotonic: its ends, or many under a measured pressure."""
    first, last = path.pinned.first, path.pinned.last
    if not isinstance(branch.cone.gas, Driven):
        return [first, last]
    edge = branch.cone.edge(branch.cone.start_radius)
    knots = (branch.cone.gas.position + edge.drop) / edge.gap if edge.gap > 0 else np.empty(0)
    slopes = np.unique(np.concatenate((np.linspace(first.t, last.t, PINNED_NODES), knots)))
    inner = slopes[(slopes > first.t) & (slopes < last.t)]
    return [first, *(_pinned_point(branch, float(t)) for t in inner), last]


def zero_of_force(branch: Branch, path: Path) -> Point | None:
    """Return where the force first turns from compression to tension; None if it never does."""
    pinned = pinned_points(branch, path)
    if pinned[0].force < 0:
        return pinned[0]
    for before, after in zip(pinned, pinned[1:], strict=False):
        if after.force < 0:
            return _pinned_zero(branch, before, after)
    for stretch in path.stretches:
        points = [stretch.first, *(branch.node(k) for k in stretch.nodes), stretch.last]
        if points[0].force < 0:
            return points[0]
        for before, after in zip(points, points[1:], strict=False):
            if after.force < 0:
                return branch.where_force_vanishes(before, after)
    return None


def _pinned_zero(branch: Branch, before: Point, after: Point) -> Point:
    cone = branch.cone
    edge = cone.edge(cone.start_radius)
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
    points = [stretch.first, *(branch.node(k) for k in stretch.nodes), stretch.last]
    lowest = min(range(len(points)), key=lambda k: points[k].force)
    around = range(max(lowest - 1, 0), min(lowest + 1, len(points) - 1) + 1)
    slopes = {k: branch.force_climb_at(points[k].radius) for k in around}
    best = points[lowest]
    for k in around[:-1]:
        if slopes[k] > 0 > slopes[k + 1]:
            inner = branch.lowest_force(points[k], points[k + 1], slopes[k], slopes[k + 1])
            best = min(best, inner, key=lambda point: point.force)
    return best
