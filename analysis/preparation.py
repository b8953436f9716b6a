"""Segments, tare, drift, noise and compliance: what comes before any feature."""

from __future__ import annotations

import numpy as np

from analysis.creep import find_creep, known_creep
from analysis.errors import AnalysisError, FeatureMissing
from analysis.extraction import SMOOTHING, Details, Extraction, Windows, extraction_step
from analysis.numerics import Array, Noise, block_means, find_jumps, running_mean
from analysis.run import Run

WITHOUT_CONTACT = frozenset({"volume", "leak"})
"""Protocols that never touch a sample: any of their samples shows the zero of force."""

NOISE_MEMORY = 0.1
"""Block length on which the colour of the noise is measured, s."""


@extraction_step("segments", title="Segments")
def segments(work: Extraction) -> Details:
    """Take the segments from the recorded step events, and check them against the data.

    The retraction runs from the start of ``retract`` to the end of ``pull-off``. Without ``tare`` the first part of
    the approach serves as force-free. Checks: the stage rises in the retraction, falls in the approach, and rests in
    the dwell.
    """
    run = work.run
    if run.force.size < 16:
        raise AnalysisError(f"{run.name}: only {run.force.size} samples; nothing to analyse")
    retract, pull_off = run.step("retract"), run.step("pull-off")
    retraction = None
    if retract is not None and retract.stop - retract.start > 8:
        stop = pull_off.stop if pull_off is not None and pull_off.start >= retract.stop else retract.stop
        retraction = (retract.start, min(stop, run.force.size))
    approach = _between(run, "approach", "preload")
    tare = run.step("tare")
    if tare is not None:
        free = (tare.start, tare.stop)
    elif approach is not None:
        free = (approach[0], approach[0] + max(16, (approach[1] - approach[0]) // 20))
    elif run.protocol in WITHOUT_CONTACT:
        free = (0, min(run.force.size, max(16, round(run.rate))))
    else:
        raise AnalysisError(f"{run.name}: neither a tare nor an approach step; the zero of force is unknown")
    if free[1] - free[0] < 16:
        raise AnalysisError(f"{run.name}: the tare holds {free[1] - free[0]} samples; at least 16 are needed")
    work.windows = Windows(
        free, approach, _between(run, "dwell"), _between(run, "pressurize"), retraction, run.force.size
    )
    checks = {
        "the stage falls during the approach": _moves(run.height, approach, -1),
        "the stage rests during the dwell": _moves(run.height, work.windows.dwell, 0),
        "the stage rises during the retraction": _moves(run.height, retraction, +1),
    }
    failures = [text for text, fulfilled in checks.items() if fulfilled is False]
    decision = "from the step events" + (
        "; contradicted by the data: " + "; ".join(failures) if failures else ", confirmed by the data"
    )
    return {"decision": decision, "checks": checks}


def _between(run: Run, first: str, last: str | None = None) -> tuple[int, int] | None:
    begin = run.step(first)
    end = begin if last is None else run.step(last) or begin
    if begin is None or end is None or end.stop - begin.start < 8:
        return None
    return begin.start, min(end.stop, run.force.size)


def _moves(height: Array, window: tuple[int, int] | None, direction: int) -> bool | None:
    if window is None:
        return None
    travel = float(height[window[1] - 1] - height[window[0]])
    return bool(abs(travel) < 5e-6) if direction == 0 else bool(direction * travel > 0)


@extraction_step(
    "tare",
    title="Tare, drift and creep",
    after=("segments",),
    gives={
        "force_noise_N": "standard deviation of one force sample, out of contact",
        "force_drift_N_s": "drift of the zero of force, fitted jointly before contact and after detachment",
        "creep_fraction": "share of a compression that the load train loses and gives back after detachment",
        "baseline_residual_N": "force left after detachment once tare, drift and creep are removed (quality)",
    },
)
def tare(work: Extraction) -> Details:
    """Fit one straight line in time to all force-free samples: tare, approach before contact, and after detachment.

    1. Level and noise from the tare. Contact is where the force leaves it for good, up or (snap-in) down; a margin
       before it is left out.
    2. The sample has come off when the force ends within a quarter of the largest tension from the level; detachment
       is the last crossing of three per cent of it.
    3. What the reading loses to creep of the load train is put back, as the bench's calibration says. Without one,
       creep is looked for in the dwell, and counts where the force comes back in the same way after detachment.
    4. Block means before contact and after detachment, equally weighted, give level and drift by least squares. What
       fades to the last half of the record by more than five standard deviations of a 20 ms mean is left out.
    """
    run = work.run
    free_start, free_stop = work.windows.free
    level = float(np.median(run.force[free_start:free_stop]))
    memory = work.samples(NOISE_MEMORY, least=1)
    noise = Noise.measure(_without_trend(run.force[free_start:free_stop]), memory)
    width = work.samples(SMOOTHING)
    smooth = running_mean(run.force, width)
    contact = _contact_onset(work, smooth, level, noise)
    margin = max(work.samples(0.2), width)
    before = (free_start, max(free_stop, contact - margin))
    work.contact_start = contact
    work.detached = _rough_detachment(work, smooth, level, noise.of_mean(width))
    force = _without_creep(work, level, margin)
    if force is not run.force:
        work.detached = _rough_detachment(work, running_mean(force, width), level, noise.of_mean(width))
    after = _after_detachment(work, margin, _faded(work, running_mean(force, width), noise.of_mean(width)))
    windows = [before] if after is None else [before, after]
    work.baseline = fit_baseline(force, windows)
    work.force = force - work.baseline(np.arange(force.size, dtype=np.float64))
    residual = np.concatenate([_without_trend(force[slice(*window)]) for window in windows])
    work.noise = Noise.measure(residual, memory)
    work.set(force_noise_N=work.noise.sigma, force_drift_N_s=float(work.baseline.deriv()(0.0)) * run.rate)
    if after is not None:
        work.set(baseline_residual_N=float(work.force[slice(*after)].mean()))
    elif work.windows.retraction is not None:
        work.missing["baseline_residual_N"] = "the recording holds no force-free part after detachment"
    decision = "line through " + ("before contact and after detachment" if after is not None else "before contact only")
    if work.creep is not None and work.creep.share:
        decision += f"; creep of {work.creep.share:.1%} within {work.creep.time_constant:.2g} s put back"
    return {"decision": decision, "windows": windows, "baseline": work.baseline, "contact": contact}


def _without_creep(work: Extraction, level: float, margin: int) -> Array:
    """Return the force with what the load train's creep has taken from it; the recorded one where none is known."""
    run, sensors = work.run, work.run.sensors
    if run.protocol in WITHOUT_CONTACT:
        work.missing["creep_fraction"] = "nothing is pressed"
        return run.force
    after = _after_detachment(work, margin)
    if sensors.creep_time > 0:
        calibrated = (sensors.creep, sensors.creep_uncertainty, sensors.creep_time)
        work.creep = known_creep(run.force - level, run.rate, *calibrated)
    elif work.earlier is None and work.windows.dwell is not None and after is not None:
        work.creep = find_creep(run.force - level, run.rate, work.windows.dwell, after)
    creep = work.creep
    if creep is None or not creep.share:
        work.missing["creep_fraction"] = "the force does not creep back after detachment"
        return run.force
    work.set(creep_fraction=creep.share)
    if sensors.creep_time == 0:
        work.stated["creep_fraction"] = creep.uncertainty  # else the budget's creep is this very number
    return run.force + creep.share * creep.response


def _without_trend(values: Array) -> Array:
    places = np.arange(values.size, dtype=np.float64)
    return np.asarray(values - np.polynomial.Polynomial.fit(places, values, 1)(places), dtype=np.float64)


def _contact_onset(work: Extraction, smooth: Array, level: float, noise: Noise) -> int:
    """Return the first sample of contact in the approach, whether the force rises or falls (snap-in) there.

    Contact is certain where the force first stays off the tare by one per cent of its largest value. From there back,
    it began at the first jump of the force, if there is one (snap-in), or else after the last sample within five
    standard deviations of a line through all samples well before.
    """
    window = work.windows.approach
    if window is None:
        return work.windows.free[1]
    width = work.samples(SMOOTHING)
    sigma = noise.of_mean(width)
    force = smooth[window[0] : window[1]] - level
    largest = float(np.abs(force).max())
    departed = (np.abs(force) > max(5 * sigma, 0.01 * largest)).astype(np.float64)
    ahead = work.samples(0.2, least=2)
    total = np.concatenate([[0.0], np.cumsum(departed), np.full(ahead, departed.sum())])
    share = (total[ahead : ahead + departed.size] - total[: departed.size]) / ahead
    lasting = np.flatnonzero((departed > 0) & (share > 0.8))
    if lasting.size == 0:
        return window[1]
    certain = window[0] + int(lasting[0])
    snaps = find_jumps(
        work.run.force[window[0] : certain + ahead], noise, max(4, width), max(8 * sigma, 2e-3 * largest)
    )
    if snaps and window[0] + snaps[0].start < certain:
        return window[0] + snaps[0].start
    before = (work.windows.free[0], max(work.windows.free[1], certain - ahead))
    line = fit_baseline(work.run.force, [before])
    places = np.arange(before[0], certain, dtype=np.float64)
    quiet = np.flatnonzero(np.abs(smooth[before[0] : certain] - line(places)) < 5 * sigma)
    return before[0] + int(quiet[-1]) if quiet.size else certain


def _rough_detachment(work: Extraction, smooth: Array, level: float, sigma: float) -> int | None:
    """Return the sample after which no tension is left, or ``None`` while still attached or never adhered."""
    if work.windows.retraction is None:
        return None
    start, stop = work.windows.retraction
    force = smooth[start:] - level
    lowest = int(np.argmin(force[: stop - start]))
    peak = float(force[lowest])
    tail = float(np.median(force[-max(8, min(work.samples(0.5), (force.size - lowest) // 4)) :]))
    if peak > -8 * sigma or tail < 0.25 * peak:
        return None
    tense = np.flatnonzero(force[lowest:] < tail - max(5 * sigma, 0.03 * -peak))
    return start + lowest + (int(tense[-1]) if tense.size else 0)


def _faded(work: Extraction, smooth: Array, sigma: float) -> int:
    """Return how many samples after detachment tension still fades, half of what follows at most."""
    if work.detached is None:
        return 0
    force = smooth[work.detached : work.windows.end]
    half = force.size // 2
    free = np.flatnonzero(force > float(np.median(force[half:])) - 5 * sigma)
    return min(int(free[0]), half)


def _after_detachment(work: Extraction, margin: int, faded: int = 0) -> tuple[int, int] | None:
    if work.detached is None:
        return None
    start = work.detached + faded + max(margin, (work.windows.end - work.detached) // 20)
    return (start, work.windows.end) if work.windows.end - start >= margin else None


def fit_baseline(force: Array, windows: list[tuple[int, int]], degree: int = 1) -> np.polynomial.Polynomial:
    """Fit block means by least squares; every part of the record counts by its length."""
    places, means = [], []
    for start, stop in windows:
        length = max(1, (stop - start) // 200)
        blocks = block_means(force[start:stop], length)
        means.append(blocks)
        places.append(start + (length - 1) / 2 + length * np.arange(blocks.size))
    weights = np.concatenate(
        [np.full(p.size, np.sqrt((stop - start) / p.size)) for p, (start, stop) in zip(places, windows, strict=True)]
    )
    where = np.concatenate(places)
    fit = np.polynomial.Polynomial.fit(where, np.concatenate(means), degree, w=weights)
    return fit.convert() if degree == 1 else fit


@extraction_step("compliance", title="Separation", after=("tare",))
def compliance(work: Extraction) -> Details:
    """Correct the stage's position for the compliance C of load cell, fixture and frame: separation = height + F C.

    The force used is the tared one, sample by sample; with C unknown (zero) the separation is the stage's height.
    """
    constant = work.run.sensors.compliance
    work.separation = work.run.height + work.force * constant if constant else work.run.height
    return {"decision": f"C = {constant * 1e6:.3g} µm/N", "compliance": constant}


def require_adhesion(work: Extraction) -> None:
    """Raise ``FeatureMissing`` unless the retraction shows tension."""
    start, stop = work.retraction()
    width = work.samples(SMOOTHING)
    if float(running_mean(work.force[start:stop], width).min()) > -8 * work.noise.of_mean(width):
        raise FeatureMissing("no tension above the noise in the retraction")
