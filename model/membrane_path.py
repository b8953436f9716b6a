"""The path of the contact from z_0 to detachment, as Chebyshev series, and the features read off it. Scaled units.

The contact is pinned at r_i until Eq. 10 of EML holds, then follows its largest stable root; F_r is Eq. 11.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import NDArray

from model.errors import NotConverged
from model.membrane_branch import LARGEST_SURPRISE, Counter, Line, pinned_line, pinned_state
from model.membrane_equilibrium import (
    Annulus,
    Closure,
    node_positions,
    relative_size,
    release_slope,
    resample,
    shape,
    solve,
)

Array = NDArray[np.float64]

PANEL_SIZES = (16, 32)
"""Points of a panel, less one. A panel that the larger number does not resolve is halved."""
SHORTEST = 1e-9
"""Rise of a pinned part, relative to the heights it lies between, below which it is left out."""


class Panel(NamedTuple):
    """States at Chebyshev points of a coordinate: ln(R_0 / a) where the contact peels, z where it is pinned.

    ``height``, ``pull`` (over 2 pi), ``pressure`` and contact ``radius`` are series in the coordinate;
    ``tail`` is the size of their last terms relative to the largest.
    """

    coordinate: Array
    width: Array
    state: Array
    height: Chebyshev
    pull: Chebyshev
    pressure: Chebyshev
    radius: Chebyshev
    tail: float
    pinned: bool

    def guess(self, coordinate: Array) -> Array:
        """Return states near the given coordinates."""
        return Line(self.coordinate, self.state).guess(coordinate)


class Piece(NamedTuple):
    """A stable stretch of the path on which the rim rises: a panel between two of its coordinates."""

    panel: Panel
    begin: float
    end: float


class Place(NamedTuple):
    """A point of the path: its piece and the coordinate there."""

    piece: Piece
    coordinate: float

    @property
    def height(self) -> float:
        """Height of the rim."""
        return float(self.piece.panel.height(self.coordinate))

    @property
    def pull(self) -> float:
        """Pull on the substrate, over 2 pi."""
        return float(self.piece.panel.pull(self.coordinate))

    @property
    def radius(self) -> float:
        """Contact radius."""
        return float(self.piece.panel.radius(self.coordinate))

    @property
    def width(self) -> float:
        """ln(R_0 / a)."""
        return float(self.piece.panel.width[0]) if self.piece.panel.pinned else self.coordinate


class Features(NamedTuple):
    """What is read off a path.

    ``zero`` is ``None`` where the force is tensile from the start; ``gap`` is the height that was not solved below it.
    """

    zero: Place | None
    gap: float
    start: Place
    onset: Place
    peak: Place
    detachment: Place
    energy: float

    @property
    def travel(self) -> float:
        """Height from z_0 to detachment."""
        return self.detachment.height - self.start.height


@dataclass(slots=True)
class Memory:
    """The panels of the last scene, from which a neighbouring one is reached at once.

    ``tolerance`` was asked for and ``relative`` reached.
    """

    width: float = np.nan
    peel: list[Panel] = field(default_factory=list)
    pinned: list[Panel] = field(default_factory=list)
    tolerance: float = np.inf
    relative: float = np.inf


class Resolution(NamedTuple):
    """How well to resolve a line: order of the shapes, relative last terms of the series, halvings of a panel."""

    order: int
    tail: float
    deepest: int


class Coarse(NamedTuple):
    """The peeling branch as it was searched, in stretches, with the heights along each."""

    lines: list[Line]
    heights: list[Array]

    @classmethod
    def of(cls, annulus: Annulus, lines: list[Line]) -> Coarse:
        """Work out the heights of a branch."""
        return cls(lines, [shape(annulus, line.coordinate, line.state).height for line in lines])

    @property
    def highest(self) -> int:
        """Which stretch has the highest point."""
        return int(np.argmax([part.max() for part in self.heights]))

    def rises_above(self, floor: float) -> bool:
        """Whether any point lies above a height."""
        return any((part > floor).any() for part in self.heights)


def peel_panels(
    annulus: Annulus, coarse: Coarse, floor: float, resolution: Resolution, counter: Counter
) -> list[Panel]:
    """Return the peeling branch from where it rises above ``floor`` to its highest point."""
    branch, heights, highest = coarse.lines, coarse.heights, coarse.highest
    rising = next(i for i, part in enumerate(heights) if (part > floor).any())
    panels = []
    for i in range(rising, highest + 1):
        coordinate, height = branch[i].coordinate, heights[i]
        first = max(int(np.argmax(height > floor)) - 1, 0) if i == rising else 0
        last = min(int(np.argmax(height)) + 1, height.size - 1) if i == highest else height.size - 1
        ends = float(coordinate[first]), float(coordinate[last])
        panels += _panels(annulus, branch[i], ends, None, resolution, counter, resolution.deepest)
    return panels


def pinned_panels(annulus: Annulus, peel: Panel, floor: float, resolution: Resolution, counter: Counter) -> list[Panel]:
    """Return the states at the widest contact from ``floor`` up to where it peels; none if it peels at once.

    Where the membrane goes slack on the way, its states are followed from both ends and a gap stays between.
    """
    width, top = float(peel.coordinate[0]), float(peel.height(peel.coordinate[0]))
    if top - floor <= SHORTEST * (1 + abs(floor)):
        return []
    upper = pinned_line(annulus, width, peel.state[:1], top, floor, counter)
    lines = [upper]
    reached = float(upper.coordinate[0])
    if reached > floor:
        bottom = pinned_state(annulus, width, floor, counter).state
        if bottom is not None:
            lines = [pinned_line(annulus, width, bottom, floor, reached, counter), upper]
    return [
        panel
        for line in lines
        if line.coordinate.size > 1
        for panel in _panels(annulus, line, _ends(line), width, resolution, counter, resolution.deepest // 3)
    ]


def _ends(line: Line) -> tuple[float, float]:
    return float(line.coordinate[0]), float(line.coordinate[-1])


def _panels(
    annulus: Annulus,
    line: Line,
    ends: tuple[float, float],
    width: float | None,
    resolution: Resolution,
    counter: Counter,
    depth: int,
) -> list[Panel]:
    """Cover a line with panels whose series end; a pinned line may keep gaps where it is slack."""
    panel, coarse = None, line
    for size in PANEL_SIZES:
        finer = _panel(annulus, line, ends, width, resolution.order, size, counter)
        if finer is None:
            break
        panel = finer
        line = Line(panel.coordinate, panel.state)
        if panel.tail < resolution.tail:
            return [panel]
    if depth == 0:
        if panel is None and width is None:
            raise NotConverged("membrane: the branch was found but its refinement did not converge")
        return [] if panel is None else [panel]
    if panel is not None and width is None:
        line = _upper_roots(annulus, panel, coarse)
    middle = (ends[0] + ends[1]) / 2
    return [
        half
        for part in ((ends[0], middle), (middle, ends[1]))
        for half in _panels(annulus, line, part, width, resolution, counter, depth - 1)
    ]


def _upper_roots(annulus: Annulus, panel: Panel, coarse: Line) -> Line:
    """Return the states of a panel without those that fell on the lower root, or the line it was guessed from."""
    upper = release_slope(annulus, panel.width, panel.state) > 0
    if not upper[0] or not upper[-1]:
        return coarse
    return Line(panel.coordinate[upper], panel.state[upper])


def _panel(
    annulus: Annulus,
    line: Line,
    ends: tuple[float, float],
    width: float | None,
    order: int,
    size: int,
    counter: Counter,
) -> Panel | None:
    """Solve states at Chebyshev points between the ends; ``None`` if one of them does not converge."""
    low, high = ends
    places = low + (high - low) * node_positions(size)
    widths = places if width is None else np.full(places.size, width)
    closure = Closure.RELEASE if width is None else Closure.HEIGHT
    guess = resample(line.guess(places), order)
    solved = counter.note(solve(annulus, widths, guess, closure=closure, target=places))
    if not solved.converged.all() or (solved.state[:, -2] <= -annulus.gas.atmosphere).any():
        return None
    return _as_panel(annulus, places, widths, solved.state, pinned=width is not None)


def _as_panel(annulus: Annulus, places: Array, widths: Array, state: Array, *, pinned: bool) -> Panel:
    low, high = map(float, places[[0, -1]])
    height = places if pinned else shape(annulus, widths, state).height
    radius = annulus.contact.radius(annulus.surface, np.exp(-widths), state[:, 0])
    rise, pull, pressure, edge = (_series(values, low, high) for values in (height, state[:, -1], state[:, -2], radius))
    return Panel(places, widths, state, rise, pull, pressure, edge, max(_tail(rise), _tail(pull)), pinned)


def neighbour(
    annulus: Annulus, memory: Memory, width: float, floor: float, counter: Counter
) -> tuple[list[Panel], list[Panel]] | None:
    """Return peeling and pinned panels of a scene next to the one remembered; ``None`` if it is too far."""
    if memory.width != width:
        return None
    peel = _moved(annulus, memory.peel, [panel.coordinate for panel in memory.peel], counter)
    if not peel or peel[-1].height.deriv()(peel[-1].coordinate[-1]) >= 0:
        return None
    begin = float(peel[0].height(peel[0].coordinate[0]))
    if peel[0].coordinate[0] != width:
        return (peel, []) if begin <= floor else None
    rises = begin - floor > SHORTEST * (1 + abs(floor))
    if rises != bool(memory.pinned):
        return None
    if not rises:
        return peel, []
    low, high = memory.pinned[0].coordinate[0], memory.pinned[-1].coordinate[-1]
    stretched = [floor + (begin - floor) * ((panel.coordinate - low) / (high - low)) for panel in memory.pinned]
    pinned = _moved(annulus, memory.pinned, stretched, counter)
    return None if pinned is None else (peel, pinned)


def _moved(annulus: Annulus, known: list[Panel], places: list[Array], counter: Counter) -> list[Panel] | None:
    """Solve known panels in another scene, all states at once; ``None`` where one is not near."""
    pinned = known[0].pinned
    coordinate = np.concatenate(places)
    widths = np.concatenate([panel.width for panel in known])
    guess = np.concatenate([panel.state for panel in known])
    closure = Closure.HEIGHT if pinned else Closure.RELEASE
    solved = counter.note(solve(annulus, widths, guess, closure=closure, target=coordinate, iterations=6))
    near = relative_size(solved.state, solved.state - guess, widths) < LARGEST_SURPRISE
    if not (solved.converged & near).all():
        return None
    parts = np.cumsum([panel.width.size for panel in known])[:-1]
    states = np.split(solved.state, parts)
    return [
        _as_panel(annulus, place, panel.width, state, pinned=pinned)
        for panel, place, state in zip(known, places, states, strict=True)
    ]


def _series(values: Array, low: float, high: float) -> Chebyshev:
    """Return the series through values at the Chebyshev points of [low, high]."""
    size = values.size - 1
    angles = np.pi * np.arange(size + 1) / size
    weights = np.cos(np.outer(np.arange(size + 1), np.pi - angles)) * (2 / size)
    weights[:, [0, -1]] /= 2
    coefficients = weights @ values
    coefficients[[0, -1]] /= 2
    return Chebyshev(coefficients, domain=[low, high])


def _tail(series: Chebyshev) -> float:
    size = np.abs(series.coef)
    return float(size[-3:].max() / max(size.max(), 1e-300))


def roots(series: Chebyshev, low: float, high: float) -> list[float]:
    """Return the real roots of a series in [low, high], rising."""
    found = series.roots()
    slack = 1e-9 * (high - low)
    real = found.real[np.abs(found.imag) < 1e-7 * (series.domain[1] - series.domain[0])]
    return sorted(float(np.clip(x, low, high)) for x in real if low - slack <= x <= high + slack)


def path(peel: list[Panel], pinned: list[Panel], floor: float) -> list[Piece]:
    """Return the stable stretches in the order in which a rising rim passes them."""
    pieces = [Piece(panel, *map(float, panel.coordinate[[0, -1]])) for panel in pinned]
    reached = float(peel[0].height(peel[0].coordinate[0])) if pinned else floor
    rounding = 1e-11 * (1 + abs(reached))
    for panel in peel:
        low, high = map(float, panel.coordinate[[0, -1]])
        for begin, end in pairwise([low, *roots(panel.height.deriv(), low, high), high]):
            bottom, top = float(panel.height(begin)), float(panel.height(end))
            if top <= max(bottom, reached):
                continue
            crossing = roots(panel.height - reached, begin, end) if bottom < reached - rounding else []
            pieces.append(Piece(panel, crossing[0] if crossing else begin, end))
            reached = top
    return pieces


def features(pieces: list[Piece], floor: float) -> Features:
    """Read zero of force, onset of peeling, greatest pull, detachment and adhesion energy off a path from ``floor``."""
    start = Place(pieces[0], pieces[0].begin)
    zero = None if start.pull >= 0 else _first_zero(pieces)
    peel = next((piece for piece in pieces if not piece.panel.pinned), pieces[-1])
    candidates = [Place(piece, x) for piece in pieces for x in _pull_extremes(piece)]
    begin = start if zero is None else zero
    return Features(
        zero=zero,
        gap=_unsolved_below(begin, pieces, floor),
        start=start,
        onset=Place(peel, peel.begin),
        peak=max(candidates, key=lambda place: place.pull),
        detachment=Place(pieces[-1], pieces[-1].end),
        energy=_energy(pieces, begin),
    )


def _unsolved_below(place: Place, pieces: list[Piece], floor: float) -> float:
    """Return the height between a place at the beginning of a piece and what was solved below it."""
    if place.coordinate != place.piece.begin:
        return 0.0
    index = next(i for i, piece in enumerate(pieces) if piece is place.piece)
    below = floor if index == 0 else Place(pieces[index - 1], pieces[index - 1].end).height
    return max(place.height - below, 0.0)


def _first_zero(pieces: list[Piece]) -> Place | None:
    """Return where the pull turns positive: on a stretch, or at a jump."""
    for piece in pieces:
        if float(piece.panel.pull(piece.begin)) >= 0:
            return Place(piece, piece.begin)
        crossings = roots(piece.panel.pull, piece.begin, piece.end)
        if crossings:
            return Place(piece, crossings[0])
    return None


def _pull_extremes(piece: Piece) -> list[float]:
    return [piece.begin, *roots(piece.panel.pull.deriv(), piece.begin, piece.end), piece.end]


def _energy(pieces: list[Piece], begin: Place) -> float:
    """Integrate the pull (over 2 pi) over the height from ``begin`` to detachment."""
    total, running = 0.0, False
    for piece in pieces:
        running = running or piece is begin.piece
        if running:
            work = (piece.panel.pull * piece.panel.height.deriv()).integ()
            total += float(work(piece.end) - work(begin.coordinate if piece is begin.piece else piece.begin))
    return total
