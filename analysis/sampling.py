"""Error of F_p and D_p against sample rate and filter, on synthetic truth."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.extraction import extract
from analysis.numerics import Array, running_mean
from analysis.pipeline import analyze  # noqa: F401  (importing registers the steps)
from analysis.run import Run
from analysis.synthetic import Experiment, Imperfections, Profile, pull_off_run

if TYPE_CHECKING:
    import pandas as pd

RATES = (20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0)
"""Sample rates, Hz."""

Reader = Callable[[Run], tuple[float, float]]
"""Run -> (F_p in N, D_p in m)."""


def _read_off(force: Array, run: Run) -> tuple[float, float]:
    """Read F_p and D_p as from a plot: the least sample; first tensile sample to last sample beyond 2 % of F_p."""
    tare = run.step("tare")
    retract = run.step("retract")
    assert tare is not None
    assert retract is not None
    tared = force[retract.start :] - force[tare.start : tare.stop].mean()
    height = run.height[retract.start :]
    lowest = int(np.argmin(tared))
    compressed = np.flatnonzero(tared[: lowest + 1] > 0)
    first = int(compressed[-1]) if compressed.size else 0
    last = int(np.flatnonzero(tared < 0.02 * tared[lowest])[-1])
    return -float(tared[lowest]), float(height[last] - height[first])


def _raw(run: Run) -> tuple[float, float]:
    return _read_off(run.force, run)


def _running(run: Run) -> tuple[float, float]:
    return _read_off(running_mean(run.force, max(1, round(0.1 * run.rate))), run)


def _median(run: Run) -> tuple[float, float]:
    from scipy.ndimage import median_filter

    return _read_off(np.asarray(median_filter(run.force, size=max(3, round(0.1 * run.rate))), dtype=np.float64), run)


def _low_pass(run: Run) -> tuple[float, float]:
    """Second-order Butterworth at 4 Hz, causal, as an amplifier has it: it delays."""
    from scipy.signal import butter, sosfilt, sosfilt_zi

    sections = butter(2, min(4.0, 0.45 * run.rate), fs=run.rate, output="sos")
    settled = sosfilt_zi(sections) * run.force[0]
    filtered, _ = sosfilt(sections, run.force, zi=settled)
    return _read_off(np.asarray(filtered, dtype=np.float64), run)


def _this_analysis(run: Run) -> tuple[float, float]:
    values = extract(run).values
    return values.get("pull_off_force_N", np.nan), values.get("pull_off_distance_m", np.nan)


READERS: dict[str, Reader] = {
    "least sample, no filter": _raw,
    "running mean, 0.1 s": _running,
    "median, 0.1 s": _median,
    "low-pass 4 Hz, causal": _low_pass,
    "this analysis": _this_analysis,
}


@dataclass(frozen=True, slots=True)
class SamplingStudy:
    """What is varied; ``repeats`` tests per rate, each with its own noise and instant of detachment."""

    repeats: int = 12
    rates: tuple[float, ...] = RATES
    force_noise_density: float = 3e-5
    """N/sqrt(Hz): at a higher rate a single sample is noisier."""
    retract_speed: float = 50e-6


def study(profile: Profile, settings: SamplingStudy | None = None) -> pd.DataFrame:
    """Return bias and root mean square error of F_p and D_p, and the time per run, by rate and reader.

    Parameters
    ----------
    profile
        The true force; the same for all.

    Returns
    -------
    DataFrame
        Columns rate_Hz, reader, pull_off_force_bias_N, pull_off_force_error_N, pull_off_distance_bias_m,
        pull_off_distance_error_m, seconds, missing (how many of the repeats gave no number).
    """
    import pandas as pd

    chosen = settings or SamplingStudy()
    rows = []
    for rate in chosen.rates:
        tests = [_test(profile, chosen, rate, seed) for seed in range(chosen.repeats)]
        rows += [(rate, name, *_errors(reader, tests)) for name, reader in READERS.items()]
    columns = [
        "rate_Hz",
        "reader",
        "pull_off_force_bias_N",
        "pull_off_force_error_N",
        "pull_off_distance_bias_m",
        "pull_off_distance_error_m",
        "seconds",
        "missing",
    ]
    return pd.DataFrame(rows, columns=columns)


Test = tuple[Run, dict[str, float]]


def _test(profile: Profile, chosen: SamplingStudy, rate: float, seed: int) -> Test:
    generator = np.random.default_rng([seed, 41])
    experiment = Experiment(rate=rate, retract_speed=chosen.retract_speed, dwell=2.0, snap=0.004)
    flaws = Imperfections(force_noise=chosen.force_noise_density * float(np.sqrt(rate / 2)), drift=2e-6)
    return pull_off_run(profile, experiment, flaws, seed=seed, phase=float(generator.uniform()))


def _errors(reader: Reader, tests: list[Test]) -> tuple[float, float, float, float, float, int]:
    begin = clock.perf_counter()
    found = np.array([reader(run) for run, _ in tests])
    seconds = (clock.perf_counter() - begin) / len(tests)
    truth = np.array([(t["pull_off_force_N"], t["pull_off_distance_m"]) for _, t in tests])
    error = found - truth
    good = np.isfinite(error).all(axis=1)
    if not good.any():
        return (np.nan, np.nan, np.nan, np.nan, seconds, len(tests))
    bias = error[good].mean(axis=0)
    size = np.sqrt((error[good] ** 2).mean(axis=0))
    return float(bias[0]), float(size[0]), float(bias[1]), float(size[1]), seconds, int((~good).sum())
