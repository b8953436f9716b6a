"""Approach, contact point, preload and relaxation."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from analysis.errors import FeatureMissing
from analysis.extraction import Details, Extraction, extraction_step
from analysis.numerics import Array, Noise, block_means, fit_around, running_mean

ContactMethod = Callable[[Array, Array, float], int]
"""(depth, force, noise of one point) -> index of contact. Depth rises towards the sample."""

CONTACT_METHODS: dict[str, tuple[str, ContactMethod]] = {}
POINTS = 1500


def contact_method(name: str) -> Callable[[ContactMethod], ContactMethod]:
    """Register a contact-point method; its docstring is its algorithm."""

    def register(function: ContactMethod) -> ContactMethod:
        CONTACT_METHODS[name] = ((function.__doc__ or "").strip(), function)
        return function

    return register


@contact_method("deviation")
def deviation(depth: Array, force: Array, sigma: float) -> int:
    """Deviation from the baseline.

    1. Go back from the deepest point to the last one whose force lies within four standard deviations of zero.
    2. A line through the next points, up to twice that force, is extended back to zero force.
    """
    quiet = np.flatnonzero(np.abs(force) < 4 * sigma)
    first = int(quiet[-1]) if quiet.size else 0
    late = np.flatnonzero(np.abs(force[first:]) > 12 * sigma)
    last = first + int(late[0]) + 2 if late.size else force.size
    if last - first < 3 or last > force.size:
        return first
    slope, offset = np.polyfit(depth[first:last], force[first:last], 1)
    if slope == 0:
        return first
    return int(np.clip(np.searchsorted(depth, -offset / slope), 0, first))


@contact_method("constant and polynomial")
def constant_and_polynomial(depth: Array, force: Array, sigma: float) -> int:
    """Piecewise fit.

    1. Use the curve up to the first fifth of its largest force.
    2. For each candidate, force is zero before and a x + b x^2 with x the depth beyond the candidate; a, b by least
       squares.
    3. The candidate with the smallest sum of squares is the contact.
    """
    del sigma
    stop = int(np.argmax(np.abs(force) > 0.2 * np.abs(force).max())) or force.size
    stop = min(force.size, max(stop, 12))
    depth, force = depth[:stop], force[:stop]
    candidates = np.arange(0, stop - 6)
    for stride in (max(1, candidates.size // 60), 1):
        tried = candidates[::stride]
        errors = [_piecewise_error(depth, force, int(candidate)) for candidate in tried]
        best = int(tried[int(np.argmin(errors))])
        candidates = np.arange(max(0, best - stride), min(stop - 6, best + stride) + 1)
    return best


def _piecewise_error(depth: Array, force: Array, candidate: int) -> float:
    x = depth[candidate:] - depth[candidate]
    y = force[candidate:]
    design = np.stack([x, x * x])
    normal = design @ design.T
    if abs(np.linalg.det(normal)) < 1e-60:
        return float(np.sum(force**2))
    solution = np.linalg.solve(normal, design @ y)
    return float(np.sum(force[:candidate] ** 2) + np.sum((y - solution @ design) ** 2))


@contact_method("gradient")
def gradient(depth: Array, force: Array, sigma: float) -> int:
    """Gradient crossing.

    1. The gradient of the force, averaged over one fortieth of the curve.
    2. Going back from the first tenth of the largest gradient, the point where the gradient falls to what noise alone
       would give.
    """
    width = max(3, force.size // 40)
    slope = np.gradient(running_mean(force, width), depth)
    spacing = float(np.median(np.diff(depth)))
    threshold = max(3 * sigma / (np.sqrt(width) * width * max(spacing, 1e-12)), 0.01 * float(np.abs(slope).max()))
    steep = int(np.argmax(np.abs(slope) > max(0.1 * np.abs(slope).max(), threshold)))
    quiet = np.flatnonzero(np.abs(slope[: steep + 1]) < threshold)
    return min(int(quiet[-1]) + width // 2, force.size - 1) if quiet.size else steep


@contact_method("direct path")
def direct_path(depth: Array, force: Array, sigma: float) -> int:
    """Farthest point from the direct path (Fréchet).

    1. Use the curve up to the first fifth of its largest force, and as long a stretch before it at most.
    2. Scale depth and force to 0...1; draw the straight path from the first to the last point.
    3. The point farthest below that path is the contact.
    """
    del sigma
    stop = min(force.size, max(12, int(np.argmax(np.abs(force) > 0.2 * np.abs(force).max())) or force.size))
    quiet = int(np.argmax(np.abs(force) > 0.02 * np.abs(force).max()))
    start = max(0, 2 * quiet - stop)
    x = (depth[start:stop] - depth[start]) / max(float(np.ptp(depth[start:stop])), 1e-12)
    y = np.abs(running_mean(force[start:stop], max(3, (stop - start) // 60)))
    y = (y - y[0]) / max(float(y[-1] - y[0]), 1e-12)
    return start + int(np.argmax(x - y))


@extraction_step(
    "contact",
    title="Contact point",
    after=("compliance",),
    gives={
        "contact_height_m": "separation at contact: median of the contact-point methods",
        "contact_spread_m": "standard deviation among the contact-point methods",
    },
)
def contact(work: Extraction) -> Details:
    """Find the contact by every registered method on the same curve; the median counts, the spread is reported."""
    depth, force, first = _approach_curve(work)
    sigma = work.noise.of_mean((work.windows.approach[1] - first) / force.size) if work.windows.approach else 0.0
    found = {name: -float(depth[method(depth, force, sigma)]) for name, (_, method) in CONTACT_METHODS.items()}
    places = np.array(list(found.values()))
    work.methods["contact_height_m"] = found
    work.set(contact_height_m=float(np.median(places)), contact_spread_m=float(places.std(ddof=1)))
    return {"decision": f"median of {len(found)} methods", "methods": found, "separation": -depth, "force": force}


def _approach_curve(work: Extraction) -> tuple[Array, Array, int]:
    """Return depth (rising) and force of the moving part of the approach, in blocks, and its first sample."""
    if work.windows.approach is None:
        raise FeatureMissing("the run has no approach")
    start, stop = work.windows.approach
    width = max(3, round(0.02 * work.run.rate))
    smooth = running_mean(work.force[start:stop], width)
    top = int(np.argmax(smooth))
    if smooth[top] < 8 * work.noise.of_mean(width):
        raise FeatureMissing("the approach ended before contact")
    stop = start + top + 1
    beyond = stop - work.contact_start
    start = max(start, work.contact_start - 2 * beyond)
    length = max(1, (stop - start) // POINTS)
    depth = -block_means(work.separation[start:stop], length)
    force = block_means(work.force[start:stop], length)
    rising = np.concatenate([[True], np.diff(np.maximum.accumulate(depth)) > 0])
    if int(rising.sum()) < 24:
        raise FeatureMissing("too few samples while the stage approached")
    return depth[rising], force[rising], start


@extraction_step(
    "preload",
    title="Preload and relaxation",
    after=("compliance",),
    gives={
        "preload_N": "largest compressive force before the retraction",
        "relaxation_N": "fall of the force during the dwell",
        "relaxation_fraction": "fall of the force during the dwell, of the preload",
    },
)
def preload(work: Extraction) -> Details:
    """Fit around the largest force of approach and preload, in the widest window whose residuals are noise.

    The force at the end of the dwell is the mean of its last half second.
    """
    if work.windows.approach is None:
        raise FeatureMissing("the run has no approach")
    start, stop = work.windows.approach
    later = work.windows.dwell[1] if work.windows.dwell else stop
    width = max(3, round(0.005 * work.run.rate))
    smooth = running_mean(work.force[start:later], width)
    index = start + int(np.argmax(smooth))
    if smooth.max() < 8 * work.noise.of_mean(width):
        raise FeatureMissing("no compression above the noise before the retraction")
    reach = round(0.5 * work.run.rate)
    place, value = _largest(work.force, index, max(start, index - reach), min(later, index + reach), work.noise)
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


def _largest(force: Array, index: int, left: int, right: int, noise: Noise) -> tuple[float, float]:
    fit = fit_around(-force, index, left, right, noise, degree=2)
    place, value = fit.minimum()
    return place, -value


def contact_methods() -> Mapping[str, str]:
    """Return the registered contact-point methods with their algorithms."""
    return {name: text for name, (text, _) in CONTACT_METHODS.items()}
