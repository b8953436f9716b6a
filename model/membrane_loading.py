"""The stretch that loading freezes into a sticking contact.

While the rim comes down on the sphere, the chamber vented and without adhesion, the membrane touches the next ring of
the sphere at no angle and with continuous stretch; friction then holds it. So the radius r at which the reference
radius a sticks obeys dr/da = lambda_1 cos(slope) of the free membrane at the line: a Volterra equation, since that
stretch depends on the radii already frozen. It is iterated on Chebyshev points of a.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import NDArray

from model.errors import NotConverged
from model.membrane_branch import Counter, follow
from model.membrane_contact import Frozen, Line, Surface, flat_line, frozen
from model.membrane_equilibrium import Annulus, Closure, Gas, node_positions, relative_size, resample, solve
from model.membrane_material import energy, respond
from model.parameters import ContactStretch

Array = NDArray[np.float64]

ORDER = 14
POINTS = 18
ITERATIONS = 60
FLATTEST = 1e-3
"""Slope at the widest contact below which the strains of loading, its square, are lost in rounding."""
EXCESS_DEGREE = 9
RELAXATION = 0.5
"""Share of the new radii in each iteration: a wider ring is stretched less, so that full steps would alternate."""
SMALLEST = 0.2
"""Smallest contact that is solved, relative to the widest; below it the series is continued."""
SETTLED = 1e-8


@lru_cache(maxsize=256)
def loading_contact(surface: Surface, width: float) -> Frozen:
    """Return the contact that loading up to the line at ``width`` = ln(R_0 / a) leaves behind.

    It depends on the geometry alone, so that scenes of one geometry share it.

    Raises
    ------
    NotConverged
        No loading state was found, or the frozen radii did not settle.
    """
    if surface.curvature * np.exp(-width) < FLATTEST:
        return frozen(ContactStretch.PROJECTED)
    counter = Counter()
    widest = float(np.exp(-width))
    places = widest * (SMALLEST + (1 - SMALLEST) * node_positions(POINTS))
    widths = -np.log(places)
    radius = Chebyshev([widest / 2, widest / 2], domain=[0, widest])
    states = _first_states(surface, widths, counter)
    for _ in range(ITERATIONS):
        annulus = _annulus(surface, radius)
        solved = counter.note(solve(annulus, widths, states, closure=Closure.TANGENT))
        if not solved.converged.all():
            raise NotConverged("membrane: a loading state could not be solved; choose another contact stretch")
        states = solved.state
        better = _integrated(places, _rate(annulus, widths, states))
        change = np.abs(better(places) - radius(places)).max()
        radius = radius.convert(domain=better.domain) * (1 - RELAXATION) + better * RELAXATION
        if change < SETTLED:
            return _frozen(radius)
    raise NotConverged("membrane: the stretch frozen by loading did not settle; choose another contact stretch")


def _integrated(places: Array, rates: Array) -> Chebyshev:
    """Return the radius from its rates, which differ from one by the square of the reference radius times a series."""
    widest = float(places[-1])
    excess = Chebyshev.fit(places**2, (rates - 1) / places**2, EXCESS_DEGREE, domain=[0.0, widest**2])
    even = Chebyshev.interpolate(lambda a: 1 + a**2 * excess(a**2), 2 * EXCESS_DEGREE + 2, domain=[0.0, widest])
    return even.integ(lbnd=0.0)


def _annulus(surface: Surface, radius: Chebyshev) -> Annulus:
    vented = Gas(pressure=0.0, atmosphere=1.0, volume=np.inf, free_volume=1.0)
    return Annulus(surface, vented, work=0.0, contact=_frozen(radius))


def _frozen(radius: Chebyshev) -> Frozen:
    rate = radius.deriv()

    def line(surface: Surface, a: Array) -> Line:
        if surface.curvature == 0:
            return flat_line(a)
        place, speed = radius(a), rate(a)
        cosine = surface.cosine(place)
        released = energy(speed / cosine, place / a)
        return Line(place, surface.height(place), speed, speed * surface.gradient(place), released)

    return Frozen(line)


def _rate(annulus: Annulus, widths: Array, states: Array) -> Array:
    """Return dr/da of the ring that is touched next."""
    a = np.exp(-widths)
    line = annulus.contact.radius(annulus.surface, a, states[:, 0])
    P = 0.5 * states[:, -2] * line**2 + states[:, -1]
    Q = states[:, (states.shape[1] - 2) // 2]
    stretch = respond(np.hypot(Q, P) / a, line / a).stretch
    return np.asarray(stretch * annulus.surface.cosine(line))


def _first_states(surface: Surface, widths: Array, counter: Counter) -> Array:
    """Return states (n, m) that leave an unstretched contact at no angle, from the widest contact inwards."""
    narrow = float(widths[-1])
    state = _straight(surface, narrow)
    identity = Chebyshev([0.5, 0.5], domain=[0, 1])
    annulus = _annulus(surface, identity)

    def solve_at(place: float, guess: Array) -> Array | None:
        at = np.array([place])
        solved = counter.note(solve(annulus, at, guess, closure=Closure.TANGENT, iterations=20))
        leap = relative_size(solved.state, solved.state - guess, at)[0] > 1.0
        return solved.state if solved.converged[0] and not leap else None

    begin = counter.note(solve(annulus, widths[-1:], state, closure=Closure.TANGENT, iterations=30))
    if not begin.converged[0]:
        raise NotConverged("membrane: no loading state at the widest contact; choose another contact stretch")
    line = follow(solve_at, narrow, begin.state, float(widths[0]), step=0.1, smallest=1e-4)
    if line.coordinate[-1] != widths[0]:
        raise NotConverged("membrane: loading could not be followed to a small contact; choose another contact stretch")
    return resample(line.guess(widths), ORDER)


def _straight(surface: Surface, width: float) -> Array:
    """Return a guess (1, m): the annulus straight along the substrate's slope at the line."""
    a = np.exp(-np.array([width]))
    cosine = surface.cosine(a)[0]
    slope = float(surface.gradient(a)[0])
    stretch = 1 / cosine
    tension = stretch - stretch**-3
    state = np.zeros((1, 2 * ORDER + 4))
    R = np.exp(-width * (1 - node_positions(ORDER)))
    state[0, ORDER + 1 : 2 * ORDER + 2] = R * tension * cosine
    state[0, -1] = a[0] * tension * cosine * slope
    return state
