"""Following equilibrium states of the membrane: to a scene, along the peeling branch, along the pinned part.

Every curve is followed by its natural coordinate (load fraction, width ln(R_0 / a) of the annulus, height of the rim),
with a secant predictor and a step that adapts; only the pull-off fold is a maximum of height and no fold in the width.
The branch is EML Eq. 10, solved for z at each contact radius.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.errors import NotConverged
from model.membrane_contact import Surface, frozen
from model.membrane_equilibrium import (
    Annulus,
    Closure,
    Gas,
    Solved,
    relative_size,
    release_slope,
    shape,
    solve,
    straight,
    strip,
)
from model.parameters import ContactStretch

Array = NDArray[np.float64]

COARSE_ORDER = 10
COARSE = 1e-4
"""Newton's last step on a coarse line, which serves as a guess."""
SMALLEST_CONTACT = 3.9
"""Width ln(R_0 / a) to which a branch is followed at first, a = 0.02 R_0."""
LAST_WIDTH = 14.0
STARTS = np.array([0.0, 0.25, 0.7, 1.4, 2.4, 4.0, 6.0])
"""Widths, beyond the widest contact's, at which a branch is looked for."""
NARROW_STRIP = 0.05
"""Width at which the closed form of the strip starts every solution."""
FOLD_SLOPE = 0.25
"""Rise of the release rate with the rim, relative to that without load, below which it counts as vanishing."""
PRESTRETCH = 0.1
"""Prestretch from which the states with a held contact line are reached."""
SLACK = 1e-8
"""Part of it that may be left where the membrane goes slack without it."""
FAINTEST = math.log(1e-12)
"""Logarithm of the pressure, in tensions over R_0, from which a held pressure is raised."""
HALVINGS = 40
"""How often the step of the pressure is halved within which a chamber's gas is met."""
LEAST_BORNE = 0.1
"""Part of the pressure below which two contacts in a row settle that no smaller one bears it all."""
WIDE_ANNULUS = 1.0
"""Width at which a sliding contact is entered."""
FOLD_RATE = 5.0
"""Logarithmic rate of change at which a line that ends counts as turned: O(1) on a smooth one, unbounded at a fold."""
LARGEST_SURPRISE = 0.5
"""How far a state may lie from its prediction before the step counts as a leap to another solution."""


class Line(NamedTuple):
    """Solved states (n, m) along a rising coordinate (n,)."""

    coordinate: Array
    state: Array

    def guess(self, coordinate: Array) -> Array:
        """Return states interpolated linearly, as Newton's first guess."""
        after = np.clip(np.searchsorted(self.coordinate, coordinate), 1, self.coordinate.size - 1)
        low, high = self.coordinate[after - 1], self.coordinate[after]
        fraction = ((coordinate - low) / (high - low))[:, None]
        return (1 - fraction) * self.state[after - 1] + fraction * self.state[after]


class Counter:
    """Counts evaluated states."""

    def __init__(self) -> None:
        self.states = 0

    def note(self, solved: Solved) -> Solved:
        """Add the cost of one solution and hand it on."""
        self.states += solved.evaluations
        return solved


SolveAt = Callable[[float, Array], Array | None]


def follow(
    solve_at: SolveAt,
    start: float,
    state: Array,
    stop: float,
    *,
    step: float,
    smallest: float,
    relative: float = 0.0,
    until: Callable[[Array], bool] | None = None,
) -> Line:
    """Follow a solution from ``start`` towards ``stop``; the line ends early where no step succeeds.

    Steps shrink to ``smallest``, and to the part ``relative`` of the place. ``solve_at`` returns the state at a place
    from its prediction, or ``None``. The line also ends at the first state for which ``until`` holds.
    """
    direction = 1.0 if stop > start else -1.0
    places, states = [start], [state]
    while (stop - places[-1]) * direction > 0 and step > max(smallest, relative * abs(places[-1])):
        place = places[-1] + direction * min(step, abs(stop - places[-1]))
        solved = solve_at(place, _predict(places, states, place))
        if solved is None:
            step /= 2.5
        else:
            places.append(place)
            states.append(solved)
            step *= 1.5
            if until is not None and until(solved):
                break
    order = slice(None, None, 1 if direction > 0 else -1)
    return Line(np.array(places)[order], np.concatenate(states)[order])


def _predict(places: list[float], states: list[Array], place: float) -> Array:
    if len(places) == 1:
        return states[-1]
    fraction = (place - places[-1]) / (places[-1] - places[-2])
    return states[-1] + fraction * (states[-1] - states[-2])


class Start(NamedTuple):
    """The end of raising a scene's load: its state (1, m), or ``None`` with the reason.

    ``turned``: the solution turned back before the full load, beyond which there is no equilibrium of this kind.
    ``borne`` is the part of the pressure it bore.
    """

    state: Array | None
    turned: bool = False
    borne: float = 1.0


def release_state(annulus: Annulus, width: float, counter: Counter, order: int = COARSE_ORDER) -> Start:
    """Return the state that peels at the given width, reached from a strip by raising curvature, then pressure."""
    flat = _at_fraction(annulus, 0.0)
    rest = _flat_state(flat, width, counter, order)
    if rest is None:
        return Start(None)
    vented = replace(flat, gas=replace(flat.gas, measured=None))
    curved = _raised(vented, lambda part: replace(vented, surface=_curved(annulus, part)), width, rest, counter)
    if curved.state is None or _without_load(annulus.gas):
        return curved
    if np.isfinite(annulus.gas.volume) and annulus.gas.measured is None:
        return _filled(annulus, width, curved.state, counter)
    eased = replace(annulus, gas=_at_fraction(annulus, 0.0).gas)
    return _raised(
        eased, lambda part: replace(annulus, gas=_at_fraction(annulus, part).gas), width, curved.state, counter
    )


def _curved(annulus: Annulus, part: float) -> Surface:
    return Surface(annulus.surface.curvature * part)


def _without_load(gas: Gas) -> bool:
    return gas.held and gas.pressure == 0


def _raised(
    eased: Annulus, scene_at: Callable[[float], Annulus], width: float, state: Array, counter: Counter
) -> Start:
    """Follow a peeling state from the ``eased`` scene to the whole load."""
    widths = np.array([width])

    def solve_at(part: float, guess: Array) -> Array | None:
        return _accepted(scene_at(part), widths, guess, Closure.RELEASE, 0.0, counter)

    line = follow(solve_at, 0.0, state, 1.0, step=0.5, smallest=1e-15, relative=1e-6)
    if line.coordinate[-1] == 1.0:
        return Start(line.state[-1:])
    first = release_slope(eased, widths, state)[0]
    last = release_slope(scene_at(float(line.coordinate[-1])), widths, line.state[-1:])[0]
    turned = _turned(line, widths) or bool(last < FOLD_SLOPE * first)
    return Start(None, turned, float(line.coordinate[-1]))


def _filled(annulus: Annulus, width: float, state: Array, counter: Counter) -> Start:
    """Return the peeling state whose pressure is that of its chamber's gas, given the one without pressure.

    Where it is not near, the states are followed in a held pressure until the gas law is met.
    """
    widths = np.array([width])
    near = _accepted(annulus, widths, state, Closure.RELEASE, 0.0, counter)
    if near is not None:
        return Start(near)
    needed = _gas_pressure(annulus, widths, state)
    sign = math.copysign(1.0, needed)

    def held_at(logarithm: float) -> Annulus:
        return replace(annulus, gas=replace(annulus.gas, pressure=sign * math.exp(logarithm), volume=np.inf))

    def solve_at(place: float, guess: Array) -> Array | None:
        return _accepted(held_at(place), widths, guess, Closure.RELEASE, 0.0, counter)

    def bears(state: Array) -> bool:
        return sign * (float(state[0, -2]) - _gas_pressure(annulus, widths, state)) >= 0

    most = math.log(annulus.gas.atmosphere + abs(needed)) + 1
    line = follow(solve_at, FAINTEST, state, most, step=2.0, smallest=1e-4, until=bears)
    if bears(line.state[-1:]):
        return Start(_where_gas_is_met(annulus, widths, line, solve_at, bears, counter))
    borne = sign * math.exp(line.coordinate[-1]) / _gas_pressure(annulus, widths, line.state[-1:])
    first, last = (release_slope(held_at(FAINTEST), widths, one)[0] for one in (state, line.state[-1:]))
    return Start(None, _turned(line, widths) or bool(last < FOLD_SLOPE * first), float(borne))


def _where_gas_is_met(
    annulus: Annulus, widths: Array, line: Line, solve_at: SolveAt, bears: Callable[[Array], bool], counter: Counter
) -> Array | None:
    """Halve the last step of a rising held pressure until the state with the gas is near."""
    (low, high), (below, above) = line.coordinate[-2:], (line.state[-2:-1], line.state[-1:])
    for _ in range(HALVINGS):
        for guess in (above, below):
            met = _accepted(annulus, widths, guess, Closure.RELEASE, 0.0, counter)
            if met is not None:
                return met
        middle = (low + high) / 2
        between = solve_at(middle, (below + above) / 2)
        if between is None:
            return None
        if bears(between):
            high, above = middle, between
        else:
            low, below = middle, between
    return None


def _gas_pressure(annulus: Annulus, widths: Array, state: Array) -> float:
    """Return the pressure the chamber's gas has at the volume of a state; unbounded where there is none."""
    gas = annulus.gas
    volume = gas.free_volume + float(shape(annulus, widths, state).volume_change[0])
    return (gas.atmosphere + gas.pressure) * gas.volume / volume - gas.atmosphere if volume > 0 else math.inf


def pinned_state(annulus: Annulus, width: float, height: float, counter: Counter, order: int = COARSE_ORDER) -> Start:
    """Return the state with the contact line held at the given width and the rim at ``height``.

    It is reached from a prestretched membrane without pressure, which is taut at any height.
    """
    widths = np.array([width])
    taut = _prestretched(annulus, 0.0)
    guess = straight(taut, width, height, order)
    solved = counter.note(solve(taut, widths, guess, closure=Closure.HEIGHT, target=height, iterations=40))
    if not solved.converged[0]:
        return Start(None)

    def solve_at(fraction: float, guess: Array) -> Array | None:
        return _accepted(_prestretched(annulus, fraction), widths, guess, Closure.HEIGHT, height, counter)

    line = follow(solve_at, 0.0, solved.state, 1.0, step=0.3, smallest=1e-11)
    if line.coordinate[-1] > 1 - SLACK:
        return Start(line.state[-1:])
    return Start(None, _turned(line, widths))


def _prestretched(annulus: Annulus, fraction: float) -> Annulus:
    """Return the scene at a part of its gas load, the rim prestretched by the rest."""
    eased = replace(annulus, gas=_at_fraction(annulus, fraction).gas)
    return replace(eased, prestretch=annulus.prestretch + PRESTRETCH * (1 - fraction))


def _flat_state(flat: Annulus, width: float, counter: Counter, order: int) -> Array | None:
    """Return the peeling state on a flat without pressure, reached from a narrow strip.

    A contact that slides is entered at a wide annulus: it gives way more than a narrow one can.
    """
    stuck = replace(flat, contact=frozen(ContactStretch.UNSTRETCHED))
    narrow = min(width, NARROW_STRIP)
    solved = counter.note(solve(stuck, np.array([narrow]), strip(flat.work, order), iterations=20))
    if not solved.converged[0]:
        return None
    if flat.contact.sticks:
        return _to_width(stuck, narrow, solved.state, width, counter)
    wide = max(width, WIDE_ANNULUS)
    state = _to_width(stuck, narrow, solved.state, wide, counter)
    if state is None:
        return None
    solved = counter.note(solve(flat, np.array([wide]), state, iterations=30))
    return _to_width(flat, wide, solved.state, width, counter) if solved.converged[0] else None


def _to_width(flat: Annulus, start: float, state: Array, width: float, counter: Counter) -> Array | None:
    """Follow the peeling state from one width to another; ``None`` where it ends before."""
    if start == width:
        return state

    def solve_at(place: float, guess: Array) -> Array | None:
        return _accepted(flat, np.array([place]), guess, Closure.RELEASE, 0.0, counter)

    line = follow(solve_at, start, state, width, step=0.2, smallest=1e-4)
    if line.coordinate[-1 if width > start else 0] != width:
        return None
    return line.state[-1:] if width > start else line.state[:1]


def _turned(line: Line, widths: Array) -> bool:
    """Whether a line ended at a fold, where its state changes without bound by the load."""
    if line.coordinate.size < 3:
        return False
    gained = line.coordinate[-1] - line.coordinate[-2]
    change = relative_size(line.state[-1:], line.state[-1:] - line.state[-2:-1], widths)[0]
    return bool(change * line.coordinate[-1] > FOLD_RATE * gained)


def _at_fraction(annulus: Annulus, fraction: float) -> Annulus:
    """Return the scene with curvature, pressure and gas stiffness scaled: from a vented flat to the whole."""
    if fraction == 1.0:
        return annulus
    gas = annulus.gas
    measured = None if gas.measured is None else (gas.measured[0], fraction * gas.measured[1])
    eased = replace(gas, pressure=gas.pressure * fraction, measured=measured)
    if fraction == 0.0:
        eased = replace(eased, volume=np.inf)
    elif np.isfinite(gas.volume):  # V / V_start = 1 + fraction times what it is in the whole scene
        volume = gas.volume / fraction
        eased = replace(eased, volume=volume, free_volume=volume + gas.free_volume - gas.volume)
    return replace(annulus, surface=Surface(annulus.surface.curvature * fraction), gas=eased)


def _accepted(
    annulus: Annulus,
    widths: Array,
    guess: Array,
    closure: Closure,
    target: float,
    counter: Counter,
    *,
    surprise: float = LARGEST_SURPRISE,
) -> Array | None:
    solved = counter.note(solve(annulus, widths, guess, closure=closure, target=target, iterations=9, precision=COARSE))
    if not solved.converged[0]:
        return None
    if relative_size(solved.state, solved.state - guess, widths)[0] > surprise:
        return None
    if np.isfinite(annulus.gas.volume) and solved.state[0, -2] <= -annulus.gas.atmosphere:
        return None  # the gas law has a second root, at a negative volume
    if closure is Closure.RELEASE and not release_slope(annulus, widths, solved.state)[0] > 0:
        return None  # a lower root: z_eq is the largest
    return solved.state


def release_branch(
    annulus: Annulus, width: float, height: float, counter: Counter, order: int = COARSE_ORDER
) -> list[Line]:
    """Return the peeling branch from the widest contact, ``width`` = ln(R_0 / r_i), to beyond its highest point.

    Stored stretch, inflation or suction may peel a wide contact at any height, and at the contact whose stored stretch
    just peels it the rim rises through slack states: so the branch is looked for at smaller and smaller contacts, each
    followed both ways, until its highest point is passed. The lines are its parts, by rising width; none: no contact
    holds. ``height`` is z_0.

    Raises
    ------
    NotConverged
        No state was found, and nothing says that there is none.
    """
    lines: list[Line] = []
    borne: list[float] = []
    for start in map(float, width + STARTS):
        if lines and (lines[-1].coordinate[-1] >= start or _passed(annulus, lines)):
            continue
        found = release_state(annulus, start, counter, order)
        if found.state is not None:
            reached = float(lines[-1].coordinate[-1]) if lines else width
            lines.append(_both_ways(annulus, start, found.state, reached, counter))
        elif found.turned:
            borne.append(found.borne)
            if len(borne) > 1 and max(borne[-2:]) < LEAST_BORNE:
                break
    explained = bool(borne)
    if not lines and (not explained or np.isfinite(annulus.gas.volume)):
        state, place, peels = _released_from_rest(annulus, width, height, counter, order)
        if state is not None:
            lines = [_both_ways(annulus, place, state, width, counter)]
        explained = explained or peels
    if not explained and not (lines and _passed(annulus, lines)):
        raise NotConverged("membrane: no peeling state could be solved; the scene is too extreme for the solver")
    return [line for line in lines if line.coordinate.size > 1]


def _passed(annulus: Annulus, lines: list[Line]) -> bool:
    """Whether the branch was followed to a small contact and beyond its highest point."""
    return bool(lines[-1].coordinate[-1] >= SMALLEST_CONTACT) and not _still_rising(annulus, lines)


def _released_from_rest(
    annulus: Annulus, width: float, height: float, counter: Counter, order: int
) -> tuple[Array | None, float, bool]:
    """Return a state that peels, found by raising the rim of a held contact, and its width; or whether all peel."""
    peels = False
    for start in map(float, width + STARTS):
        pinned = pinned_state(annulus, start, height, counter, order)
        if pinned.state is None:
            peels = peels or pinned.turned
            continue
        state, at_once = _lift_until_release(annulus, start, pinned.state, height, counter)
        if state is not None:
            return state, start, False
        peels = peels or at_once
    return None, width, peels


def _lift_until_release(
    annulus: Annulus, width: float, state: Array, height: float, counter: Counter
) -> tuple[Array | None, bool]:
    """Raise the rim of a pinned state until it peels; also say whether it peels at once."""
    line = pinned_line(annulus, width, state, height, height + 1.0, counter)
    widths = np.full(line.coordinate.size, width)
    lifted = shape(annulus, widths, line.state)
    holds = (lifted.release < annulus.work) | (lifted.peel_angle <= 0)
    if not holds[0] or holds.all():
        return None, not holds[0]
    guess = line.state[[int(np.argmin(holds))]]
    return _accepted(annulus, widths[:1], guess, Closure.RELEASE, 0.0, counter, surprise=np.inf), False


def _both_ways(annulus: Annulus, start: float, state: Array, width: float, counter: Counter) -> Line:
    def solve_at(place: float, guess: Array) -> Array | None:
        return _accepted(annulus, np.array([place]), guess, Closure.RELEASE, 0.0, counter)

    line = follow(solve_at, start, state, max(SMALLEST_CONTACT, start + 1), step=0.1, smallest=1e-5)
    if start > width:
        line = _join(follow(solve_at, start, state, width, step=0.05, smallest=2e-4), line)
    while _still_rising(annulus, [line]) and line.coordinate[-1] < LAST_WIDTH:
        end = line.coordinate[-1]
        further = follow(solve_at, end, line.state[-1:], end + 2, step=0.2, smallest=2e-3)
        if further.coordinate.size == 1:
            break
        line = _join(line, further)
    return line


def _join(first: Line, second: Line) -> Line:
    return Line(
        np.concatenate([first.coordinate[:-1], second.coordinate]), np.concatenate([first.state[:-1], second.state])
    )


def _still_rising(annulus: Annulus, lines: list[Line]) -> bool:
    heights = [shape(annulus, line.coordinate, line.state).height for line in lines]
    return bool(heights[-1][-1] >= max(part.max() for part in heights))


def pinned_line(annulus: Annulus, width: float, state: Array, top: float, bottom: float, counter: Counter) -> Line:
    """Return the pinned states from the rim height ``top`` of a known state down (or up) to ``bottom``."""
    widths = np.array([width])

    def solve_at(height: float, guess: Array) -> Array | None:
        return _accepted(annulus, widths, guess, Closure.HEIGHT, height, counter)

    span = abs(top - bottom)
    return follow(solve_at, top, state, bottom, step=span / 6, smallest=1e-4 * span)
