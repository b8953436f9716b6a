"""Stated uncertainties against synthetic truth: 68 % of the intervals should hold it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from analysis import analyze
from analysis.coverage import CASES, coverage, deviations
from analysis.extraction import extract
from analysis.numerics import Noise
from analysis.preparation import fit_baseline
from analysis.propagation import _drift_excess

FEATURES = (
    "pull_off_force_N",
    "pull_off_distance_m",
    "preload_N",
    "initial_pressure_Pa",
    "adhesion_energy_J",
)


def test_a_sample_of_pull_off_tests_is_covered() -> None:
    found = deviations("pull_off", range(12))
    for name in FEATURES:
        scores = np.array(found[name])
        assert np.isfinite(scores).all(), name
        assert 4 <= np.count_nonzero(np.abs(scores) < 1) <= 12, (name, scores)
        assert np.abs(np.median(scores)) < 1, (name, scores)


@pytest.mark.parametrize(
    ("kind", "feature"), [("volume", "chamber_volume_m3"), ("indentation", "work_of_adhesion_J_m2")]
)
def test_a_sample_of_other_protocols_is_covered(kind: str, feature: str) -> None:
    scores = np.array(deviations(kind, range(8))[feature])
    assert np.isfinite(scores).all()
    assert 2 <= np.count_nonzero(np.abs(scores) < 1) <= 8, scores


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("kind", "tests"), [("pull_off", 400), ("volume", 400), ("indentation", 400)])
def test_68_percent_intervals_hold_the_truth_in_60_to_76_percent(kind: str, tests: int) -> None:
    table = coverage(kind, range(tests))
    assert set(CASES) >= {kind}
    for row in table.itertuples():
        assert row.missing == 0, row
        assert 0.60 <= row.within_one_uncertainty <= 0.76, row
        assert abs(row.mean_deviation) < 0.25, row


def test_linearity_belongs_to_the_cell_and_not_to_the_run() -> None:
    """A bow of 0.3 mN has developed at one per cent of 5 N: at no load it bends nothing."""
    run, _ = CASES["indentation"](3)
    features = analyze(run).features
    stiffness = features["stiffness_at_zero_N_m"]
    assert stiffness.budget["force linearity"] < 0.01 * stiffness.value
    assert "force linearity" not in features["force_noise_N"].budget
    assert "force linearity" not in features["force_drift_N_s"].budget
    force = features["pull_off_force_N"]
    whole = run.sensors.force_linearity * np.tanh(force.value / (0.007 * run.sensors.force_capacity))
    assert force.budget["force linearity"] == pytest.approx(whole, rel=0.05)


def test_what_the_cell_is_out_by_under_tension_says_nothing_of_compression() -> None:
    """The slope of E* leans on both: their parts add up in squares, not one against the other."""
    run, _ = CASES["indentation"](3)
    work = extract(run)
    name = "fitted_modulus_Pa"
    parts = []
    for side in (np.minimum, np.maximum):
        scale = 0.007 * run.sensors.force_capacity
        bent = run.force + run.sensors.force_linearity * np.tanh(side(work.force, 0.0) / scale)
        parts.append(extract(replace(run, force=bent), before=work).values[name] - work.values[name])
    found = analyze(run).features[name].budget["force linearity"]
    assert found == pytest.approx(np.hypot(*parts), rel=1e-6)
    assert found < 0.9 * abs(parts[0] + parts[1])


def test_a_fit_is_no_better_known_than_the_force_it_was_fitted_to() -> None:
    run, _ = CASES["indentation"](3)
    features = analyze(run).features
    force, fitted = features["work_of_adhesion_J_m2"], features["fitted_work_of_adhesion_J_m2"]
    for source in ("force linearity", "drift", "creep"):
        assert fitted.budget[source] == pytest.approx(force.budget[source], rel=0.6), source


def drift_scores(gap: int, wander: float) -> tuple[list[float], list[float]]:
    """Return errors of the zero in units of the drift stated, and the drift stated in units of the noise, N/N.

    The zero of force wanders between two short force-free parts, in waves of 200 to 1800 s.
    """
    generator, rate, sigma = np.random.default_rng(1), 50, 6e-5
    scores, stated = [], []
    for _ in range(100):
        before, after = (round(rate * generator.uniform(5, 10)) for _ in range(2))
        count = before + gap * rate + after
        time = np.arange(count) / rate
        zero = wander * 1e-2 * generator.normal() * time
        for period in (197.0, 611.0, 1789.0):
            phase = generator.uniform(0, 2 * np.pi)
            zero = zero + wander * generator.normal() * np.sin(2 * np.pi * time / period + phase)
        windows = [(0, before), (count - after, count)]
        noise = Noise(sigma, generator.normal(0, sigma, count))
        recorded = zero + noise.residual
        baseline = fit_baseline(recorded, windows)
        line = baseline(np.arange(count))
        work = SimpleNamespace(
            details={"tare": {"windows": windows}}, force=recorded - line, baseline=baseline, noise=noise
        )
        excess = _drift_excess(work)  # type: ignore[arg-type]
        scores += list((zero - line)[generator.integers(before, count - after, 8)] / excess)
        stated.append(excess / sigma)
    return scores, stated


@pytest.mark.parametrize("gap", [40, 160, 300])
def test_a_wander_as_slow_as_the_contact_is_long_is_covered(gap: int) -> None:
    scores, _ = drift_scores(gap, wander=4e-4)
    assert 0.4 < np.sqrt(np.mean(np.square(scores))) < 1.2


@pytest.mark.parametrize("gap", [40, 160, 300])
def test_noise_in_the_force_free_parts_is_no_drift(gap: int) -> None:
    """The slope of a line through n samples has the noise s sqrt(12 / n^3): over the gap that would be 1 to 7 s."""
    _, stated = drift_scores(gap, wander=0.0)
    samples = 7.5 * 50
    as_drift = np.sqrt(12 / samples**3) * gap * 50 / (np.sqrt(2) * np.pi)
    assert np.median(stated) < 0.6 * as_drift
