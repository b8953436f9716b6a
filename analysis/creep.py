"""Creep of the load train: a share of the compression is lost to the reading little by little, and comes back after.

The train answers a compression F like a spring and dashpot: shown = F - s R with tau dR/dt = F - R (a Zener solid).
In the dwell the sample's own relaxation looks the same, and only bounds s. After detachment nothing pulls any more, and
what is left of R decays to the tare in plain sight: there s is read, and all before is put right with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.numerics import RECTANGULAR, Array, block_means

CELLS_PER_SECOND = 20.0
"""The force is averaged into so many cells a second; creep is slower."""

TIMES = np.geomspace(1.0, 120.0, 49)
"""Time constants that are tried, s."""

SIGNIFICANT = 3.0
"""Standard deviations from which on the recovery counts as seen, and up to which dwell and recovery agree."""

FEWEST = 20
"""Cells that a fit needs."""


@dataclass(frozen=True)
class Creep:
    """Creep of the load train in one run.

    Attributes
    ----------
    share, uncertainty
        s and its standard uncertainty; a share of zero with an uncertainty: not seen, but not excluded either.
    time_constant
        tau, s.
    response
        (n,), N, the delayed compression R at each sample.
    """

    share: float
    uncertainty: float
    time_constant: float
    response: Array


def delayed(force: Array, interval: float, time_constant: float) -> Array:
    """Return R of tau dR/dt = F - R for the compression in a force sampled every ``interval`` seconds, from rest."""
    from scipy.signal import lfilter

    kept = float(np.exp(-interval / time_constant))
    return np.asarray(lfilter([1 - kept], [1, -kept], np.maximum(force, 0.0)), dtype=np.float64)


def find_creep(force: Array, rate: float, dwell: tuple[int, int], after: tuple[int, int]) -> Creep | None:
    """Look for creep that the dwell begins and the force-free part after detachment shows recover.

    1. For each tau of a grid, fit s R to the dwell (with a level) and to the part after (with a level and a slope); the
       tau with the least sum of squares counts.
    2. Creep is seen if the recovery's s is more than three standard deviations and the dwell agrees with it; then one s
       is fitted to both. Its uncertainty holds the spread among the tau that fit as well.
    3. If it is not seen, R may have died away too soon, or the sample has relaxed too: what the dwell has lost is the
       most it can have been, and a rectangular distribution up to there is carried as uncertainty.

    Parameters
    ----------
    force
        (n,), N, tared.
    dwell, after
        Sample ranges: at rest in compression, and free after detachment.

    Returns
    -------
    Creep or None
        ``None`` where a part is too short or the dwell loses nothing.
    """
    length = max(1, round(rate / CELLS_PER_SECOND))
    cells, interval = block_means(force, length), length / rate
    rest, free = (slice(-(-start // length), stop // length) for start, stop in (dwell, after))
    if min(rest.stop - rest.start, free.stop - free.start) < FEWEST:
        return None
    true, found = cells, (0.0, 0.0, 0.0)
    for _ in range(2):  # the second time with the force put right by the first
        tries = [_Try.of(cells, delayed(true, interval, tau), tau, rest, free) for tau in TIMES.tolist()]
        judged = _judged(tries)
        if judged is None:
            return None
        found = judged
        true = cells + found[0] * delayed(true, interval, found[2])
    return known_creep(force, rate, *found)


def known_creep(force: Array, rate: float, share: float, uncertainty: float, time_constant: float) -> Creep:
    """Return the creep of a tared force where share and time constant are known, from a calibration for instance."""
    length = max(1, round(rate / CELLS_PER_SECOND))
    true = cells = block_means(force, length)
    for _ in range(2):
        true = cells + share * delayed(true, length / rate, time_constant)
    places = (length - 1) / 2 + length * np.arange(cells.size)
    response = np.interp(np.arange(force.size), places, delayed(true, length / rate, time_constant))
    return Creep(share, uncertainty, time_constant, np.asarray(response, dtype=np.float64))


@dataclass(frozen=True, slots=True)
class _Fit:
    """s, its standard uncertainty and the sum of squares over the variance of one cell."""

    share: float
    uncertainty: float
    misfit: float

    @classmethod
    def of(cls, shown: Array, lag: Array, others: list[Array], variance: float) -> _Fit:
        design = np.stack([-lag, *others], axis=1)
        solution, _, _, _ = np.linalg.lstsq(design, shown, rcond=None)
        residual = shown - design @ solution
        spread = float(np.linalg.pinv(design.T @ design)[0, 0]) * variance
        return cls(float(solution[0]), max(spread, 0.0) ** 0.5, float(residual @ residual) / variance)


@dataclass(frozen=True, slots=True)
class _Try:
    """What one tau makes of the dwell, of the part after, and of both with one s."""

    tau: float
    rest: _Fit
    free: _Fit
    both: _Fit

    @classmethod
    def of(cls, shown: Array, lag: Array, tau: float, rest: slice, free: slice) -> _Try:
        variance = _variance(shown[free])
        resting, drifting = np.ones(rest.stop - rest.start), np.linspace(-1.0, 1.0, free.stop - free.start)
        freely = [np.ones_like(drifting), drifting]
        joined = np.concatenate([shown[rest], shown[free]])
        pad, none = np.zeros_like(resting), np.zeros_like(drifting)
        columns = [np.concatenate([resting, none]), *(np.concatenate([pad, column]) for column in freely)]
        return cls(
            tau,
            _Fit.of(shown[rest], lag[rest], [resting], variance),
            _Fit.of(shown[free], lag[free], freely, variance),
            _Fit.of(joined, np.concatenate([lag[rest], lag[free]]), columns, variance),
        )


def _variance(cells: Array) -> float:
    """Variance of one cell's noise from second differences; doubled, since neighbours share slow noise."""
    return max(2 * float(np.mean(np.diff(cells, 2) ** 2)) / 6, 1e-30)


def _judged(tries: list[_Try]) -> tuple[float, float, float] | None:
    """Return share, uncertainty and time constant; ``None`` where there is nothing to carry."""
    apart = min(tries, key=lambda t: t.rest.misfit + t.free.misfit)
    rest, free = apart.rest, apart.free
    if rest.share <= SIGNIFICANT * rest.uncertainty:
        return None
    together = min(tries, key=lambda t: t.both.misfit)
    agree = together.both.misfit - rest.misfit - free.misfit < SIGNIFICANT**2
    if agree and free.share > SIGNIFICANT * free.uncertainty:
        as_good = [t.both.share for t in tries if t.both.misfit < together.both.misfit + SIGNIFICANT**2]
        return together.both.share, float(np.hypot(together.both.uncertainty, np.std(as_good))), together.tau
    most = min(rest.share, max(free.share, 0.0) + 2 * free.uncertainty)
    return (0.0, most / RECTANGULAR, apart.tau) if most > 0 else None
