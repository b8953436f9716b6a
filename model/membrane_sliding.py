"""A membrane that slides on the substrate without friction: the disc in contact is in equilibrium by itself.

With the arc length alpha r_b = R u and the nominal meridional tension q, on x = (R / a)^2:
2 x u' + u = lambda_1(q, lambda_2), 2 x q' + q = w_2 cos(alpha), lambda_2 = r_b sin(alpha) / R. Both are regular at the
pole, where the two equations coincide: one condition is left for the radius of the line.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from model.membrane_contact import Edge, EdgeState, Surface
from model.membrane_material import energy, respond, tension

Array = NDArray[np.float64]

DISC_ORDER = 10
"""Exact to 1e-11 up to a slope of 0.97 at the line."""
DISC_TOLERANCE = 1e-6
"""Newton's last step; convergence is quadratic."""


@dataclass(frozen=True, slots=True)
class Sliding:
    """Fibres hold the membrane down but not in place.

    The line carries no force along the substrate, so that the disc's tension balances the component of the free
    membrane's along it, and the work of adhesion counts per reference area, as fibres do. A substrate that wets, with
    adhesion per current area, would have continuous tension and G = T (1 - cos theta) instead.
    """

    sticks: bool = False

    def radius(self, surface: Surface, a: Array, u: Array) -> Array:
        """Return the contact radius, which is the radius of the free membrane's edge."""
        return a + u

    def edge(self, surface: Surface, state: EdgeState, *, tension_field: bool) -> Edge:
        """Return the conditions at the contact line."""
        a, u, Q, p, f = state
        radius = np.maximum(a + u, 1e-3 * a)
        if surface.curvature > 0:
            radius = np.minimum(radius, (1 - 1e-7) / surface.curvature)
        hoop = radius / a
        half, P_u = 0.5 * radius**2, p * radius
        P = p * half + f
        N = np.hypot(Q, P)
        free = respond(N / a, hoop, tension_field=tension_field)
        held, held_u = disc_tension(surface, a, radius)
        disc = respond(np.maximum(held, 0.0), hoop)
        cosine, sine = surface.cosine(radius), -surface.curvature * radius
        turn = -surface.curvature / cosine
        along, across = (Q * cosine + P * sine) / a, (P * cosine - Q * sine) / a
        by_Q = (free.stretch * Q / N - disc.stretch * cosine) / a
        by_P = (free.stretch * P / N - disc.stretch * sine) / a
        disc_u = disc.compliance * held_u + disc.coupling / a
        by_u = by_P * P_u + (disc.hoop_tension - free.hoop_tension) / a
        by_u += (held - along) * disc_u - disc.stretch * across * turn
        stored = energy(free.stretch, hoop, tension_field=tension_field)
        gradient = sine / cosine
        return Edge(
            radius=radius,
            height=surface.height(radius),
            gradient=gradient,
            tie=along - held,
            tie_by=np.stack([sine * P_u / a + across * turn - held_u, cosine / a, sine * half / a, sine / a], axis=1),
            release=energy(disc.stretch, hoop) - stored + N / a * free.stretch - disc.stretch * along,
            release_by=np.stack([by_u, by_Q, by_P * half, by_P], axis=1),
            tangency=P - gradient * Q,
            tangency_by=np.stack([P_u + surface.curvature / cosine**3 * Q, -gradient, half, np.ones_like(a)], axis=1),
            peel_angle=np.arctan2(P, Q) - np.arctan2(sine, cosine),
        )


def disc_tension(surface: Surface, a: Array, radius: Array) -> tuple[Array, Array]:
    """Return the nominal edge tension of discs of reference radius ``a`` spread to ``radius``, and d / d radius.

    Both are nan where the disc could not be solved: to Newton's method such a trial state is no solution.
    """
    if surface.curvature == 0:
        stretch = radius / a
        return tension(stretch, stretch), (1 + 5 * stretch**-6) / a
    return _spherical(surface.curvature, a, radius)


def _spherical(curvature: float, a: Array, radius: Array) -> tuple[Array, Array]:
    nodes, slopes = _disc_grid(DISC_ORDER)
    size = nodes.size
    R = a[:, None] * np.sqrt(nodes)
    sine = curvature * radius
    target = np.arcsin(sine) / (curvature * a)
    target_by_radius = 1 / (a * np.sqrt(1 - sine**2))
    u = np.repeat(target[:, None], size, axis=1)
    hoop = np.maximum(u * _sinc(curvature * R * u), 1e-6)
    q = np.maximum(tension(u, hoop), 0.0)
    jacobian = np.zeros((a.size, 2 * size, 2 * size))
    for _ in range(30):
        alpha = curvature * R * u
        hoop = u * _sinc(alpha)
        hoop_u = np.cos(alpha)
        lam, w2, compliance, coupling, stiffness = respond(np.maximum(q, 0.0), hoop)
        residual = np.concatenate(
            [
                2 * nodes * (u @ slopes.T) + u - lam,
                2 * nodes * (q @ slopes.T) + q - w2 * np.cos(alpha),
            ],
            axis=1,
        )
        diagonal = np.arange(size)
        jacobian[:, :size, :size] = 2 * nodes[:, None] * slopes
        jacobian[:, size:, size:] = 2 * nodes[:, None] * slopes
        jacobian[:, :size, size:] = jacobian[:, size:, :size] = 0.0
        jacobian[:, diagonal, diagonal] += 1 - coupling * hoop_u
        jacobian[:, diagonal, size + diagonal] = -compliance
        jacobian[:, size + diagonal, size + diagonal] += 1 + coupling * np.cos(alpha)
        jacobian[:, size + diagonal, diagonal] = (
            -stiffness * hoop_u * np.cos(alpha) + w2 * np.sin(alpha) * curvature * R
        )
        residual[:, size] = u[:, -1] - target  # the second equation at the pole repeats the first
        jacobian[:, size] = 0.0
        jacobian[:, size, size - 1] = 1.0
        right = np.stack([residual, np.zeros_like(residual)], axis=2)
        right[:, size, 1] = -target_by_radius
        step = -np.linalg.solve(jacobian, right)
        u, q = u + step[:, :size, 0], q + step[:, size:, 0]
        last = np.abs(step[:, :, 0]).max(axis=1)
        if not (last > DISC_TOLERANCE).any():
            break
    solved = last <= DISC_TOLERANCE
    return np.where(solved, q[:, -1], np.nan), np.where(solved, step[:, -1, 1], np.nan)


@lru_cache(maxsize=4)
def _disc_grid(order: int) -> tuple[Array, Array]:
    """Return Chebyshev points on [0, 1] and their differentiation matrix."""
    size = order + 1
    nodes = (1 - np.cos(np.pi * np.arange(size) / order)) / 2
    weights = (-1.0) ** np.arange(size)
    weights[[0, -1]] /= 2
    distance = nodes[:, None] - nodes + np.eye(size)
    matrix = weights / weights[:, None] / distance
    np.fill_diagonal(matrix, 0.0)
    np.fill_diagonal(matrix, -matrix.sum(axis=1))
    return nodes, matrix


def _sinc(angle: Array) -> Array:
    return np.sinc(angle / np.pi)
