"""Chamber volume, leak and the calibration fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis import AnalysisError, FeatureMissing, Run, Sensors, Step, analyze
from analysis.calibration import (
    STANDARD_GRAVITY,
    calibrate_compliance,
    calibrate_load_cell,
    fit_line,
    pressure_zero,
)
from analysis.chamber import fit_boyle, fit_leak
from analysis.synthetic import volume_run
from model import Parameters, Substrate
from model.parameters import STANDARD_ATMOSPHERE


def test_boyle_recovers_the_volume_exactly_without_noise() -> None:
    volume = 7.2e-6
    moved = np.linspace(0, -1e-6, 50)
    gas = STANDARD_ATMOSPHERE * volume / (volume - moved) - STANDARD_ATMOSPHERE
    fit = fit_boyle(moved, gas)
    assert fit.volume == pytest.approx(volume, rel=1e-9)
    assert fit.uncertainty < 1e-12


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("tightness", [300.0, 3000.0])
def test_neither_a_leak_nor_a_lag_of_the_pressure_shifts_the_volume(delay: float, tightness: float) -> None:
    volume, interval = 7.2e-6, 0.05
    time = np.arange(0.0, 40.0, interval)
    pumped = 2e-7 * np.interp(time, np.arange(0, 41, 4), [0, -0.5, -0.5, -1, -1, 0, 0, 0.5, 0.5, 0, 0])
    gas = np.zeros_like(time)
    leaked = 0.0
    for k, moved in enumerate(pumped):
        gas[k] = STANDARD_ATMOSPHERE * (volume - leaked) / (volume - moved) - STANDARD_ATMOSPHERE
        leaked += volume * gas[k] / STANDARD_ATMOSPHERE / tightness * interval
    shown = np.interp(time - delay, time, gas)
    assert fit_boyle(pumped, shown, interval=interval).volume == pytest.approx(volume, rel=1e-3)


def test_volume_protocol_states_gain_and_pump_errors() -> None:
    sensors = Sensors(pressure_gain=3e-3, pump_volume=4e-3)
    quantity = analyze(volume_run(7.2e-6, sensors=sensors)).features["chamber_volume_m3"]
    assert quantity.value == pytest.approx(7.2e-6, rel=2e-3)
    assert quantity.uncertainty == pytest.approx(7.2e-6 * 5e-3, rel=0.1)
    assert str(quantity).endswith("mL")


def test_a_constant_pressure_gives_no_volume() -> None:
    with pytest.raises(FeatureMissing, match="nothing to fit"):
        fit_boyle(np.linspace(0, 1e-7, 20), np.zeros(20))
    run = replace(volume_run(7.2e-6), pump_volume=None)
    assert "no pump volume" in analyze(run).features.missing["chamber_volume_m3"]


@pytest.mark.parametrize("level", [-4000.0, 2500.0])
def test_leak_rate_and_time_constant(level: float) -> None:
    time = np.linspace(0, 120, 6000)
    generator = np.random.default_rng(5)
    gas = level * np.exp(-time / 600) + generator.normal(0, 5, time.size)
    leak = fit_leak(time, gas, 7.2e-6)
    assert leak.time_constant == pytest.approx(600, rel=0.02)
    assert leak.rate == pytest.approx(level / 600, rel=0.02)
    assert leak.flow == pytest.approx(level / 600 * 7.2e-6 / STANDARD_ATMOSPHERE, rel=0.02)


def test_leak_protocol_needs_no_contact() -> None:
    rate, n = 100.0, 8000
    time = np.arange(n) / rate
    generator = np.random.default_rng(6)
    run = Run(
        "leak-1",
        "leak",
        rate,
        generator.normal(0, 1e-3, n),
        -3000 * np.exp(-time / 900) + generator.normal(0, 5, n),
        np.zeros(n),
        (Step("hold", 0, n),),
        parameters=Parameters(Substrate("flat")),
    )
    quantity = analyze(run).features["leak_time_constant_s"]
    assert quantity.value == pytest.approx(900, abs=4 * quantity.uncertainty)


def test_load_cell_against_hung_weights() -> None:
    masses = -np.array([0, 10, 20, 50, 100, 200, 300]) * 1e-3
    generator = np.random.default_rng(7)
    readings = masses * STANDARD_GRAVITY / 0.4903 + 0.012 + generator.normal(0, 2e-4, masses.size)
    found = calibrate_load_cell(masses, readings, mass_uncertainty=1e-4)
    assert found.slope == pytest.approx(0.4903, abs=3 * 0.4903 * found.relative_uncertainty)
    assert found.residual == pytest.approx(1e-4, rel=0.7)
    assert found.slope * 0.012 + found.intercept == pytest.approx(0, abs=3e-4)
    assert found.relative_uncertainty >= 1e-4


def test_compliance_against_a_rigid_stop() -> None:
    generator = np.random.default_rng(8)
    force = np.linspace(0, 2, 400)
    height = 5e-3 - 12e-6 * force + generator.normal(0, 5e-8, force.size)
    found = calibrate_compliance(force, height)
    assert found.compliance == pytest.approx(12e-6, abs=4 * found.uncertainty)
    assert found.uncertainty < 1e-8
    assert found.nonlinearity == pytest.approx(5e-8, rel=0.2)


def test_line_needs_points() -> None:
    with pytest.raises(AnalysisError, match="no line to fit"):
        fit_line(np.zeros(5), np.arange(5.0))


def test_line_uncertainty_covers_the_truth() -> None:
    x = np.linspace(0, 1, 20)
    generator = np.random.default_rng(9)
    scores = []
    for _ in range(300):
        fit = fit_line(x, 2 * x + 1 + generator.normal(0, 0.1, x.size))
        scores.append((fit.slope - 2) / fit.slope_uncertainty)
    assert 0.60 < np.mean(np.abs(scores) < 1) < 0.76


def test_pressure_zero_counts_the_colour_of_the_noise() -> None:
    generator = np.random.default_rng(10)
    white = generator.normal(20, 10, 20_000)
    slow = np.convolve(white, np.ones(20) / 20, mode="valid") + 0.0
    mean, uncertainty = pressure_zero(white, 1000.0)
    assert mean == pytest.approx(20, abs=4 * uncertainty)
    assert uncertainty == pytest.approx(10 / np.sqrt(20_000), rel=0.3)
    assert pressure_zero(slow, 1000.0)[1] == pytest.approx(uncertainty, rel=0.4)
