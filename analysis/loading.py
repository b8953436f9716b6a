"""Approach, contact point, preload and relaxation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from analysis.errors import FeatureMissing
from analysis.extraction import CONTACT_TESTS, SMOOTHING, Details, Extraction, extraction_step
from analysis.numerics import Array, Noise, fit_around, on_grid, running_mean

ContactMethod = Callable[[Array, Array, float], int]
"""(depth, force, noise of one point) -> index of contact. Depth rises towards the sample."""

CONTACT_METHODS: dict[str, ContactMethod] = {}
POINTS = 1500
FEWEST_FOR_LINE = 8
"""Cells before contact that show a drift; fewer show noise."""


def contact_method(name: str) -> Callable[[ContactMethod], ContactMethod]:
    """Register a contact-point method; its docstring is its algorithm."""

    def register(function: ContactMethod) -> ContactMethod:
        CONTACT_METHODS[name] = function
        return function

    return register


@contact_method("deviation")
def deviation(depth: Array, force: Array, sigma: float) -> int:
    """Deviation from the baseline.

    1. The first point from which on five points in a row lie more than four standard deviations off zero.
    2. A line through the next points, up to three times that force, is extended back to zero force, if it leads back.
    """
    first = _lasting_deviation(force, sigma)
    if first > force.size - 3:
        return first
    beyond = np.flatnonzero(np.abs(force[first:]) > 12 * sigma)
    last = min(force.size, first + (int(beyond[0]) if beyond.size else 5) + 2)
    slope, offset = np.polyfit(depth[first:last], force[first:last], 1)
    if slope * force[first] <= 0:
        return first
    return int(np.clip(np.searchsorted(depth, -offset / slope), 0, first))


def _lasting_deviation(force: Array, sigma: float) -> int:
    """Return the first of five points in a row beyond four standard deviations; the last point where there is none."""
    off = np.abs(force) > 4 * sigma
    lasting = np.flatnonzero(np.convolve(off, np.ones(5), mode="valid") == 5)
    return int(lasting[0]) if lasting.size else force.size - 1


@contact_method("constant and polynomial")
def constant_and_polynomial(depth: Array, force: Array, sigma: float) -> int:
    """Piecewise fit.

    1. Use the curve up to a tenth of the way from its first lasting deviation (four standard deviations) to its end.
    2. For each candidate, force is zero before and a + b x + c x^2 with x the depth beyond the candidate, by least
       squares; a is the snap-in.
    3. The candidate with the smallest sum of squares is the contact.
    """
    first = _lasting_deviation(force, sigma)
    stop = min(force.size, first + max(12, (force.size - first) // 10))
    depth, force = depth[:stop] - depth[0], force[:stop]
    candidates = np.arange(0, stop - 6)
    for stride in (max(1, candidates.size // 60), 1):
        tried = candidates[::stride]
        errors = [_piecewise_error(depth, force, int(candidate)) for candidate in tried]
        best = int(tried[int(np.argmin(errors))])
        candidates = np.arange(max(0, best - stride), min(stop - 6, best + stride) + 1)
    return best


def _piecewise_error(depth: Array, force: Array, candidate: int) -> float:
    x = (depth[candidate:] - depth[candidate]) / depth[-1]
    y = force[candidate:]
    design = np.stack([np.ones_like(x), x, x * x])
    normal = design @ design.T + 1e-12 * x.size * np.eye(3)
    solution = np.linalg.solve(normal, design @ y)
    return float(np.sum(force[:candidate] ** 2) + np.sum((y - solution @ design) ** 2))


@contact_method("gradient")
def gradient(depth: Array, force: Array, sigma: float) -> int:
    """Gradient.

    1. The gradient of the force, as the difference of the means of the next and the last ``n`` points; n grows until
       noise alone gives less than two per cent of the largest force.
    2. The first point where it exceeds five times what noise alone gives, less n / 2.
    """
    n = int(np.clip(np.ceil(2 * (sigma / (0.02 * max(float(np.abs(force).max()), 1e-12))) ** 2), 3, force.size // 8))
    means = running_mean(force, n)
    change = means[n:] - means[:-n]
    steep = np.flatnonzero(np.abs(change) > 5 * sigma * np.sqrt(2 / n))
    return min(int(steep[0]) + n // 2, force.size - 1) if steep.size else force.size - 1


@contact_method("cumulative sum")
def cumulative_sum(depth: Array, force: Array, sigma: float) -> int:
    """Change point by cumulative sum.

    1. Sum |F| - 2.5 sigma from the first point on: it falls while there is noise only, and rises in contact.
    2. The contact is where it is least.
    """
    del depth
    return int(np.argmin(np.cumsum(np.abs(force) - 2.5 * sigma)))


@extraction_step(
    "contact",
    title="Contact point",
    protocols=CONTACT_TESTS,
    after=("compliance",),
    gives={
        "contact_height_m": "separation at contact: median of the contact-point methods",
        "contact_spread_m": "standard deviation among the contact-point methods",
    },
)
def contact(work: Extraction) -> Details:
    """Find the contact by every registered method on the same curve; the median counts, the spread is reported.

    The methods are not independent: they see the same points, two start from the same lasting deviation, and where the
    contact is sharp they name the same point. So the uncertainty is their spread and that of a cell of the curve. On
    emulated tests the error is a third of it: the methods err to either side, early and late.
    """
    depth, force, sigma = _approach_curve(work)
    found = {name: -float(depth[method(depth, force, sigma)]) for name, method in CONTACT_METHODS.items()}
    places = np.array(list(found.values()))
    work.methods["contact_height_m"] = found
    work.set(contact_height_m=float(np.median(places)), contact_spread_m=float(places.std(ddof=1)))
    return {"decision": f"median of {len(found)} methods", "methods": found, "separation": -depth, "force": force}


def _approach_curve(work: Extraction) -> tuple[Array, Array, float]:
    """Return depth (rising evenly) and force of the approach, averaged in cells of depth, and the noise of one cell.

    A line through the part before contact is removed: here drift within the approach counts, not over the whole test.
    Where that part is very short its mean is.
    """
    if work.windows.approach is None:
        raise FeatureMissing("the run has no approach")
    start, stop = work.windows.approach
    width = work.samples(SMOOTHING)
    smooth = running_mean(work.force[start:stop], width)
    top = int(np.argmax(smooth))
    if smooth[top] < 8 * work.noise.of_mean(width) or start + top <= work.contact_start:
        raise FeatureMissing("the approach ended before contact")
    stop = start + top + 1
    depth = -work.separation[start:stop]
    touch = float(depth[work.contact_start - start])
    first = max(float(depth[0]), touch - 2 * (float(depth[-1]) - touch))
    samples = int(np.count_nonzero((depth > first) & (depth < touch)))
    cells = int(min(POINTS, samples // 4))
    if cells < 24:
        raise FeatureMissing("too few samples while the stage approached")
    grid = np.linspace(first, float(depth[-1]), cells)
    per_cell = samples / max(1.0, cells * (touch - first) / (grid[-1] - first))
    force = on_grid(depth, work.force[start:stop], grid)
    before = grid < touch - 0.1 * (touch - first)
    known = int(np.count_nonzero(before))
    if not known:
        raise FeatureMissing("no sample before contact")
    force = force - np.polynomial.Polynomial.fit(grid[before], force[before], 1 if known >= FEWEST_FOR_LINE else 0)(
        grid
    )
    return grid, force, max(work.noise.of_mean(per_cell), float(force[before].std()))


@extraction_step(
    "preload",
    title="Preload and relaxation",
    protocols=CONTACT_TESTS,
    after=("compliance",),
    gives={
        "preload_N": "largest compressive force before the retraction",
        "relaxation_N": "fall of the force during the dwell",
        "relaxation_fraction": "fall of the force during the dwell, of the preload",
    },
)
def preload(work: Extraction) -> Details:
    """Find the largest force of approach, preload and dwell on a 5 ms mean, and fit what follows it.

    There the force rises at the approach speed and then relaxes: a corner, which a fit across it would overshoot. So a
    parabola is fitted from the largest force on, in the widest window whose residuals are noise; its largest value is
    the preload. The force at the end of the dwell is the mean of its last half second.
    """
    if work.windows.approach is None:
        raise FeatureMissing("the run has no approach")
    start, stop = work.windows.approach
    later = work.windows.dwell[1] if work.windows.dwell else stop
    width = work.samples(0.005)
    smooth = running_mean(work.force[start:later], width)
    index = start + int(np.argmax(smooth))
    if smooth.max() < 8 * work.noise.of_mean(width):
        raise FeatureMissing("no compression above the noise before the retraction")
    reach = work.samples(0.5)
    place, value = _largest(work.force, index, min(later, index + reach), work.noise)
    work.set(preload_N=value)
    details: dict[str, object] = {"decision": f"peak of a local fit, {value:.4f} N", "index": place}
    if work.windows.dwell is None:
        reason = "the run has no dwell"
        work.missing.update(relaxation_N=reason, relaxation_fraction=reason)
        return details
    end = work.windows.dwell[1]
    rest = float(work.force[max(work.windows.dwell[0], end - reach) : end].mean())
    work.set(relaxation_N=value - rest, relaxation_fraction=(value - rest) / value)
    return details


def _largest(force: Array, index: int, right: int, noise: Noise) -> tuple[float, float]:
    fit = fit_around(-force, index, index, right, noise, degree=2)
    place, value = fit.minimum()
    return place, -value
