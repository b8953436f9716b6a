"""Equilibrium of the free annulus between contact line and rim: Gauss collocation, Newton on many states at once.

Canonical form: with the nominal meridional tension w_1 and the slope psi, Q = R w_1 cos(psi) and P = R w_1 sin(psi)
obey r' = lambda_1 Q / N, z' = lambda_1 P / N, Q' = w_2 - p r z', N = hypot(Q, P), and the vertical balance integrates
to P = p r^2 / 2 + f, where 2 pi f is the pull on the substrate. Only a vanishing tension is singular.

This is the stationarity of EML Eq. 1 over all shapes, derived in ``docs/physics-membrane.md``; gas: EML Eq. 6, with the
volume of Eq. 7 taken over the true shape; closure ``RELEASE``: EML Eq. 10.

Lengths in units of R_0, tensions of mu h_0, pressures of mu h_0 / R_0. The annulus a <= R <= 1 is mapped by
R = a^(1 - x): it resolves the layers of a small contact and keeps full precision for a narrow annulus.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.membrane_contact import Contact, EdgeState, Surface
from model.membrane_material import respond, tension

Array = NDArray[np.float64]

STEP_TOLERANCE = 1e-7
"""Newton's last step; convergence is quadratic, so that the state after it is exact to rounding."""
LONGEST_STEP = 0.5
"""Largest relative change of the shape in one step; the pressure follows the shape and is not limited."""
ROUNDING = 1e-5
"""Steps below this that no longer shrink are rounding, which small strains and high orders amplify."""


class Grid(NamedTuple):
    """Collocation at N Gauss points for polynomials through N + 1 nodes on [0, 1]."""

    points: Array
    weights: Array
    values: Array
    slopes: Array
    cumulative: Array


@lru_cache(maxsize=16)
def grid(order: int) -> Grid:
    """Return the matrices of one order: points, weights (N,), values, slopes (N, N + 1), cumulative (N, N)."""
    gauss, weights = np.polynomial.legendre.leggauss(order)
    points = (gauss + 1) / 2
    nodes = node_positions(order)
    barycentric = (-1.0) ** np.arange(order + 1)
    barycentric[[0, -1]] /= 2
    distance = points[:, None] - nodes
    terms = barycentric / distance
    total = terms.sum(axis=1, keepdims=True)
    values = terms / total
    slopes = values * ((barycentric / distance**2).sum(axis=1, keepdims=True) / total - 1 / distance)
    return Grid(points, weights / 2, values, slopes, _cumulative(order, gauss))


def _cumulative(order: int, gauss: Array) -> Array:
    """Return the matrix that integrates values at the Gauss points from 0 to each of them."""
    vander = np.polynomial.legendre.legvander(gauss, order)
    integrals = np.empty((order, order))
    integrals[:, 0] = gauss + 1
    for k in range(1, order):
        integrals[:, k] = (vander[:, k + 1] - vander[:, k - 1]) / (2 * k + 1)
    return np.asarray(np.linalg.solve(vander[:, :order].T, integrals.T).T / 2)


@lru_cache(maxsize=16)
def node_positions(order: int) -> Array:
    """Return the Chebyshev extreme points on [0, 1], rising."""
    return (1 - np.cos(np.pi * np.arange(order + 1) / order)) / 2


@dataclass(frozen=True, slots=True)
class Gas:
    """Chamber gas in scaled units.

    Attributes
    ----------
    pressure
        Gauge pressure at ``volume``.
    atmosphere
        Absolute pressure outside.
    volume
        Volume at which the gauge pressure is ``pressure``; infinite where the pressure is held.
    free_volume
        V_0, the volume above the flat membrane.
    measured
        Heights of the rim and pressures measured there, or ``None``.
    """

    pressure: float
    atmosphere: float
    volume: float
    free_volume: float
    measured: tuple[Array, Array] | None = None

    @property
    def held(self) -> bool:
        """Whether the pressure depends neither on the volume nor on the height."""
        return self.measured is None and not np.isfinite(self.volume)

    def measured_at(self, height: Array) -> tuple[Array, Array]:
        """Return the measured pressure and its slope at the given heights."""
        assert self.measured is not None
        heights, pressures = self.measured
        if heights.size == 1:
            return np.full_like(height, pressures[0]), np.zeros_like(height)
        segment = np.clip(np.searchsorted(heights, height) - 1, 0, heights.size - 2)
        slope = (pressures[segment + 1] - pressures[segment]) / (heights[segment + 1] - heights[segment])
        outside = (height < heights[0]) | (height > heights[-1])
        return np.interp(height, heights, pressures), np.where(outside, 0.0, slope)


@dataclass(frozen=True, slots=True)
class Annulus:
    """One scene in scaled units; states are rows (u, Q, p, f) with u = r - R and Q at the nodes.

    ``work`` is the work of adhesion over mu h_0; ``contact`` says what holds at the contact line. The rim holds the
    membrane at ``prestretch`` times its reference radius.
    """

    surface: Surface
    gas: Gas
    work: float
    contact: Contact
    tension_field: bool = False
    prestretch: float = 1.0


class Closure(Enum):
    """The condition that closes the problem at a given reference radius of the contact line."""

    RELEASE = "the energy release rate equals the work of adhesion"
    HEIGHT = "the rim stands at a given height"
    TANGENT = "the membrane leaves the substrate at no angle"


class Shape(NamedTuple):
    """Fields at the collocation points (n, N); height of the rim, volume, release rate and peel angle (n,)."""

    R: Array
    r: Array
    z: Array
    stretch: Array
    hoop_tension: Array
    height: Array
    volume_change: Array
    release: Array
    peel_angle: Array


def shape(annulus: Annulus, width: Array, state: Array) -> Shape:
    """Return the shape of solved states."""
    s = _Fields(annulus, width, state)
    rise = s.response.stretch * s.sine * s.R * s.width[:, None]
    return Shape(
        s.R,
        s.r,
        s.edge.height[:, None] + rise @ s.grid.cumulative.T,
        s.response.stretch,
        s.response.hoop_tension,
        s.height,
        s.volume_change,
        s.edge.release,
        s.edge.peel_angle,
    )


class _Fields:
    """Everything the residual and its Jacobian share."""

    def __init__(self, annulus: Annulus, width: Array, state: Array) -> None:
        self.annulus, self.width, self.a = annulus, width, np.exp(-width)
        order = state.shape[1] // 2 - 2
        self.grid = grid(order)
        self.order = order
        self.at_line = [0, order + 1, -2, -1]
        u, q = state[:, : order + 1], state[:, order + 1 : 2 * order + 2]
        self.p, self.f = state[:, -2], state[:, -1]
        self.R = np.exp(-self.width[:, None] * (1 - self.grid.points))
        self.r = self.R + u @ self.grid.values.T
        self.metric = 1 / (self.width[:, None] * self.R)
        self.r_slope = (u @ self.grid.slopes.T) * self.metric
        self.q_slope = (q @ self.grid.slopes.T) * self.metric
        Q = q @ self.grid.values.T
        P = 0.5 * self.p[:, None] * self.r**2 + self.f[:, None]
        self.N = np.hypot(Q, P)
        self.cosine, self.sine = Q / self.N, P / self.N
        self.response = respond(self.N / self.R, self.r / self.R, tension_field=annulus.tension_field)
        at_line = EdgeState(self.a, u[:, 0], q[:, 0], self.p, self.f)
        self.edge = annulus.contact.edge(annulus.surface, at_line, tension_field=annulus.tension_field)
        self.integration = self.width[:, None] * self.grid.weights * self.R
        rise = self.response.stretch * self.sine
        self.height = self.edge.height + (self.integration * rise).sum(axis=1)
        cap = annulus.surface.cap(self.edge.radius)
        self.volume_change = np.pi * (self.integration * self.r**2 * rise).sum(axis=1) - cap
        self.rim = u[:, -1]


def residual_and_jacobian(
    annulus: Annulus, width: Array, state: Array, closure: Closure, target: Array
) -> tuple[Array, Array]:
    """Return residual (n, m) and Jacobian (n, m, m); ``target`` (n,) is the height of the closure."""
    s, residual, J, partial = _unclosed(annulus, width, state)
    if closure is Closure.HEIGHT:
        residual[:, -1] = (s.height - target) / s.width
        J[:, -1] = _height_row(s, partial) / s.width[:, None]
    elif closure is Closure.RELEASE:
        residual[:, -1] = s.edge.release - annulus.work
        J[:, -1, s.at_line] = s.edge.release_by
    else:
        residual[:, -1] = s.edge.tangency
        J[:, -1, s.at_line] = s.edge.tangency_by
    return residual, J


def _unclosed(annulus: Annulus, width: Array, state: Array) -> tuple[_Fields, Array, Array, _Partial]:
    """Return fields, residual and Jacobian with the last row, which closes the problem, left at zero."""
    s = _Fields(annulus, width, state)
    n, m = state.shape
    order, B, D = s.order, s.grid.values, s.grid.slopes
    lam, w2, A, K, C = s.response
    c, si, p, r = s.cosine, s.sine, s.p[:, None], s.r
    residual = np.zeros((n, m))
    residual[:, :order] = s.r_slope - (lam - 1) * c + np.where(c > 0, si**2 / (1 + np.abs(c)), 1 - c)
    residual[:, order : 2 * order] = s.q_slope - w2 + p * r * lam * si
    residual[:, -4] = s.edge.tie
    residual[:, -3] = (s.rim - (annulus.prestretch - 1)) / s.width

    # Partial derivatives of X = lambda_1 cos(psi), Y = lambda_1 sin(psi) and w_2 by Q, P and r.
    AR, bend = A / s.R, lam / s.N
    X_Q, X_P, Y_P = AR * c**2 + bend * si**2, (AR - bend) * c * si, AR * si**2 + bend * c**2
    KR = K / s.R
    w_Q, w_P = -KR * c, -KR * si
    pr = p * r
    X_r = KR * c + X_P * pr
    Y_r = KR * si + Y_P * pr
    w_r = C / s.R + w_P * pr
    Y = lam * si
    half = 0.5 * r**2

    J = np.zeros((n, m, m))
    u, q = slice(0, order + 1), slice(order + 1, 2 * order + 2)
    top, low = slice(0, order), slice(order, 2 * order)
    slopes = s.metric[:, :, None] * D
    J[:, top, u] = slopes - X_r[:, :, None] * B
    J[:, top, q] = -X_Q[:, :, None] * B
    J[:, low, u] = (-w_r + pr * Y_r + p * Y)[:, :, None] * B
    J[:, low, q] = slopes + (-w_Q + pr * X_P)[:, :, None] * B
    by_P = -w_P + pr * Y_P
    J[:, top, -2], J[:, top, -1] = -X_P * half, -X_P
    J[:, low, -2], J[:, low, -1] = by_P * half + r * Y, by_P
    J[:, -4, s.at_line] = s.edge.tie_by
    J[:, -3, order] = 1 / s.width

    partial = _Partial(Y, Y_r, X_P, Y_P, half)
    _gas_row(s, residual, J, partial)
    return s, residual, J, partial


class _Partial(NamedTuple):
    """Y = lambda_1 sin(psi) at the points, its derivatives by r, Q and P, and dP / dp."""

    Y: Array
    r: Array
    Q: Array
    P: Array
    half: Array


def _height_row(s: _Fields, by: _Partial) -> Array:
    row = _integral_row(s, s.integration * by.r, s.integration, by)
    row[:, 0] += s.edge.gradient
    return row


def _integral_row(s: _Fields, by_r: Array, weight: Array, by: _Partial) -> Array:
    """Return the derivative (n, m) of an integral of weight * Y, given its total weight on r."""
    B = s.grid.values
    P = weight * by.P
    return np.concatenate(
        [by_r @ B, (weight * by.Q) @ B, (P * by.half).sum(axis=1)[:, None], P.sum(axis=1)[:, None]], axis=1
    )


def _gas_row(s: _Fields, residual: Array, J: Array, by: _Partial) -> None:
    gas = s.annulus.gas
    if gas.measured is not None:
        pressure, slope = gas.measured_at(s.height)
        residual[:, -2] = s.p - pressure
        J[:, -2] = -slope[:, None] * _height_row(s, by)
        J[:, -2, -2] += 1
    elif gas.held:
        residual[:, -2] = s.p - gas.pressure
        J[:, -2, -2] = 1
    else:
        ratio = (gas.free_volume + s.volume_change) / gas.volume
        residual[:, -2] = s.p * ratio - gas.pressure + gas.atmosphere * (ratio - 1)
        weight = (gas.atmosphere + s.p)[:, None] * (np.pi / gas.volume) * s.integration * s.r
        J[:, -2] = _integral_row(s, weight * (2 * by.Y + s.r * by.r), weight * s.r, by)
        J[:, -2, 0] += (gas.atmosphere + s.p) * (np.pi / gas.volume) * s.edge.radius**2 * s.edge.gradient
        J[:, -2, -2] += ratio


class Solved(NamedTuple):
    """States (n, m), which of them converged (n,), and the number of evaluated states."""

    state: Array
    converged: NDArray[np.bool_]
    evaluations: int


def solve(
    annulus: Annulus,
    width: Array,
    guess: Array,
    *,
    closure: Closure = Closure.RELEASE,
    target: Array | float = 0.0,
    iterations: int = 25,
    precision: float = STEP_TOLERANCE,
) -> Solved:
    """Solve n states at once by Newton's method from their guesses (n, m), to a last step of ``precision``."""
    targets = np.broadcast_to(np.asarray(target, dtype=float), width.shape)
    state = guess.copy()
    converged = np.zeros(width.size, dtype=bool)
    before = np.full(width.size, np.inf)
    active = np.arange(width.size)
    evaluations = 0
    for _ in range(iterations):
        evaluations += active.size
        part = state[active]
        with np.errstate(all="ignore"):  # a trial state may lie anywhere; what is not finite is dropped below
            residual, jacobian = residual_and_jacobian(annulus, width[active], part, closure, targets[active])
        usable = np.isfinite(residual).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
        active, part, residual, jacobian = active[usable], part[usable], residual[usable], jacobian[usable]
        step = _newton_step(jacobian, residual)
        size = relative_size(part, step, width[active])
        fraction = np.minimum(1.0, LONGEST_STEP / np.maximum(_change_of_shape(part, step, width[active]), 1e-300))
        state[active] = part + fraction[:, None] * step
        done = (size < precision) | ((size < ROUNDING) & (size > 0.1 * before[active]))
        before[active] = size
        converged[active[done]] = True
        active = active[~done & np.isfinite(size)]
        if active.size == 0:
            break
    return Solved(state, converged, evaluations)


def _newton_step(jacobian: Array, residual: Array) -> Array:
    try:
        return -_solve_linear(jacobian, residual)
    except np.linalg.LinAlgError:  # one singular state spoils the batch: take them one by one
        steps = np.full_like(residual, np.nan)
        for i in range(len(residual)):
            with suppress(np.linalg.LinAlgError):  # a singular state keeps its nan and counts as not converged
                steps[i] = -_solve_linear(jacobian[i : i + 1], residual[i : i + 1])[0]
        return steps


def _solve_linear(matrix: Array, right: Array) -> Array:
    return np.asarray(np.linalg.solve(matrix, right[:, :, None])[:, :, 0], dtype=np.float64)


def remaining_step(
    annulus: Annulus, width: Array, state: Array, closure: Closure, target: Array | float = 0.0
) -> Array:
    """Return the relative size (n,) of the Newton step that solved states (n, m) would still take."""
    targets = np.broadcast_to(np.asarray(target, dtype=float), width.shape)
    residual, jacobian = residual_and_jacobian(annulus, width, state, closure, targets)
    return relative_size(state, _newton_step(jacobian, residual), width)


def release_slope(annulus: Annulus, width: Array, state: Array) -> Array:
    """Return how fast the energy release rate of solved states rises with the rim, the contact line held.

    Negative on the lower of two roots: there a higher rim relaxes the stretch stored in contact.
    """
    s, right, jacobian, partial = _unclosed(annulus, width, state)
    jacobian[:, -1] = _height_row(s, partial)
    right[:] = 0.0
    right[:, -1] = 1.0
    by_height = _newton_step(jacobian, right)
    return np.asarray(-(s.edge.release_by * by_height[:, s.at_line]).sum(axis=1))


def relative_size(state: Array, step: Array, width: Array) -> Array:
    """Return the largest change of strain, tension or pressure in each row, in units of what the row holds."""
    tension = _largest_tension(state)
    pressure = np.abs(step[:, -2]) / np.maximum(tension, np.abs(state[:, -2]))
    return np.maximum(_change_of_shape(state, step, width), pressure)


def _largest_tension(state: Array) -> Array:
    order = state.shape[1] // 2 - 2
    return np.asarray(np.maximum(np.abs(state[:, order + 1 : -2]).max(axis=1), np.abs(state[:, -1])) + 1e-300)


def _change_of_shape(state: Array, step: Array, width: Array) -> Array:
    """Return the largest relative change of strain or tension in each row."""
    order = state.shape[1] // 2 - 2
    tension = _largest_tension(state)
    strain = tension / (4 + tension)  # w_1 = 4 strain for small strains
    R = np.exp(-width[:, None] * (1 - node_positions(order)))
    displacement = (np.abs(step[:, : order + 1]) / R).max(axis=1) / (np.minimum(width, 1) * strain)
    pulled = np.maximum(np.abs(step[:, order + 1 : -2]).max(axis=1), np.abs(step[:, -1])) / tension
    return np.asarray(np.maximum(displacement, pulled))


def strip(work: float, order: int) -> Array:
    """Return the first guess (1, m): a narrow, straight annulus peeling off a flat without pressure.

    With d = l - 1/l, the stretch l solves d^2 (1/2 + l^-2) = work: the limit a -> R_0 of the membrane.
    """
    excess = 0.0
    for _ in range(200):
        stretch = excess / 2 + np.hypot(1, excess / 2)
        excess, before = np.sqrt(work / (0.5 + stretch**-2)), excess
        if abs(excess - before) <= 1e-14 * excess:
            break
    force = excess * (1 + stretch**-2)
    state = np.zeros((1, 2 * order + 4))
    state[:, order + 1 : 2 * order + 2] = force / stretch
    state[:, -1] = force * np.sqrt(excess / stretch)
    return state


def straight(annulus: Annulus, width: float, height: float, order: int) -> Array:
    """Return the guess (1, m) of a prestretched annulus straight from the contact line to the rim at ``height``."""
    a = np.exp(-np.array([width]))
    spread = 0.0 if annulus.contact.sticks else annulus.prestretch - 1
    inner = annulus.contact.radius(annulus.surface, a, spread * a)
    run, rise = annulus.prestretch - inner, height - annulus.surface.height(inner)
    R = np.exp(-width * (1 - node_positions(order)))
    r = inner + run * (R - a) / (1 - a)
    stretch = np.hypot(run, rise) / (1 - a)
    momentum = R * np.maximum(tension(stretch, r / R), 1e-3 * (annulus.prestretch - 1))
    state = np.zeros((1, 2 * order + 4))
    state[0, : order + 1] = r - R
    state[0, order + 1 : 2 * order + 2] = momentum * run / np.hypot(run, rise)
    state[0, -1] = (momentum * rise / np.hypot(run, rise)).mean()
    return state


def resample(state: Array, order: int) -> Array:
    """Return states (n, m) as polynomials of another order."""
    old = state.shape[1] // 2 - 2
    if old == order:
        return state
    matrix = _transfer(old, order).T
    parts = state[:, : old + 1] @ matrix, state[:, old + 1 : 2 * old + 2] @ matrix, state[:, -2:]
    return np.concatenate(parts, axis=1)


@lru_cache(maxsize=64)
def _transfer(old: int, new: int) -> Array:
    here, there = (np.polynomial.chebyshev.chebvander(2 * node_positions(order) - 1, old) for order in (old, new))
    return np.asarray(np.linalg.solve(here.T, there.T).T, dtype=np.float64)
