"""One run: every feature against known truth, and what happens when a run holds less than it should."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from analysis import AnalysisError, FeatureMissing, Run, Sensors, Step, analyze
from analysis.extraction import markdown, ordered
from analysis.loading import CONTACT_METHODS
from analysis.numerics import Noise, find_jumps, fit_around, on_grid
from analysis.pipeline import lighten
from analysis.synthetic import Experiment, Imperfections, Profile, pull_off_run, volume_run
from model import Gas, Parameters, Substrate, predict

FAST = Experiment(rate=500.0, retract_speed=50e-6, dwell=3.0, settle=2.0, tail=4.0)
QUIET = Imperfections(force_noise=2e-4, pressure_noise=3.0)
SCENE = Parameters(Substrate("sphere", 60e-3), gas=Gas(initial_pressure=500.0))
TRUTHFUL = {
    "pull_off_force_N": 5e-4,
    "pull_off_distance_m": 2e-6,
    "retraction_at_pull_off_m": 15e-6,
    "preload_N": 1e-3,
    "initial_pressure_Pa": 2.0,
    "pressure_at_pull_off_Pa": 4.0,
    "adhesion_energy_J": 1e-6,
}


@cache
def sphere_profile() -> Profile:
    return Profile.of(predict(SCENE, points=3000))


def quiet_run(**changes: object) -> tuple[Run, dict[str, float]]:
    experiment = replace(FAST, **changes.pop("experiment", {}))  # type: ignore[arg-type]
    flaws = replace(QUIET, **changes.pop("flaws", {}))  # type: ignore[arg-type]
    return pull_off_run(sphere_profile(), experiment, flaws, parameters=SCENE, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", range(3))
def test_finds_the_truth(seed: int) -> None:
    run, truth = quiet_run(seed=seed)
    features = analyze(run, uncertainties=False).features
    for name, tolerance in TRUTHFUL.items():
        assert features.value(name) == pytest.approx(truth[name], abs=tolerance), name


def test_compression_is_positive_and_magnitudes_are_reported() -> None:
    run, _ = quiet_run()
    analysis = analyze(run, uncertainties=False)
    assert analysis.features.value("pull_off_force_N") > 0
    assert analysis.features.value("preload_N") > 0
    assert analysis.curve is not None
    assert analysis.curve.force.min() == pytest.approx(-analysis.features.value("pull_off_force_N"), abs=2e-3)


def test_drift_is_fitted_jointly_from_both_ends() -> None:
    run, truth = quiet_run(flaws={"drift": 2e-4})
    features = analyze(run, uncertainties=False).features
    assert features.value("force_drift_N_s") == pytest.approx(2e-4, rel=0.01)
    assert features.value("pull_off_force_N") == pytest.approx(truth["pull_off_force_N"], abs=5e-4)
    assert abs(features.value("baseline_residual_N")) < 1e-4


def test_compliance_is_removed_from_the_separation() -> None:
    softness = 100e-6
    run, truth = quiet_run(flaws={"compliance": softness}, sensors=Sensors(compliance=softness))
    uncorrected = replace(run, sensors=Sensors())
    assert analyze(run, uncertainties=False).features.value("pull_off_distance_m") == pytest.approx(
        truth["pull_off_distance_m"], abs=2e-6
    )
    wrong = analyze(uncorrected, uncertainties=False).features.value("pull_off_distance_m")
    assert wrong - truth["pull_off_distance_m"] > 3e-6


def test_snap_duration_and_final_jump() -> None:
    run, _ = quiet_run(experiment={"snap": 0.02, "rate": 1000.0})
    features = analyze(run, uncertainties=False).features
    assert features.value("snap_duration_s") == pytest.approx(0.02, abs=0.012)
    assert features.value("jumps_count") == 1
    assert features.value("largest_jump_N") == pytest.approx(-sphere_profile().force[-1], rel=0.1)


@pytest.mark.parametrize("power", [1, 1.5, 2])
@pytest.mark.parametrize("jump", [0.0, 0.9])
def test_a_contact_that_fades_out_is_followed_to_its_end(power: float, jump: float) -> None:
    place = np.linspace(-0.05e-3, 0.3e-3, 20000)
    left = np.clip(1 - place / 0.3e-3, 0, 1) ** power
    force = -0.5 * np.minimum(place / 0.03e-3, 1.0) * left
    force = np.where(place > 0.1e-3, (1 - jump) * force, force)
    experiment = replace(FAST, rate=1000.0, retract_speed=10e-6)
    for seed in range(3):
        profile = Profile(place, force, np.zeros(place.size))
        run, _ = pull_off_run(profile, experiment, QUIET, seed=seed, sensors=Sensors(creep_time=9.0))
        features = analyze(run).features
        distance, energy = features["pull_off_distance_m"], features.value("adhesion_energy_J")
        assert abs(distance.value - 0.3e-3) < 3 * distance.uncertainty
        assert distance.uncertainty < 0.06 * 0.3e-3
        assert energy == pytest.approx(-np.trapezoid(force[place > 0], place[place > 0]), rel=2e-3)


def test_energy_is_split_at_the_main_jump() -> None:
    profile = sphere_profile()
    middle = profile.retraction.size * 3 // 4
    force = profile.force.copy()
    force[middle:] *= 0.3  # most of the contact lets go at once, a rest hangs on
    run, truth = pull_off_run(replace(profile, force=force), FAST, QUIET)
    features = analyze(run, uncertainties=False).features
    assert features.value("jumps_count") == 2
    before, after = features.value("energy_to_main_jump_J"), features.value("energy_after_main_jump_J")
    assert before > 5 * after > 0
    assert before + after == pytest.approx(truth["adhesion_energy_J"], rel=0.01)


def test_peak_at_a_jump_is_not_smeared_and_its_bias_is_stated() -> None:
    place = np.linspace(-0.2e-3, 0.8e-3, 3000)
    profile = Profile(place, -800.0 * place, np.full(place.size, -500.0))
    run, truth = pull_off_run(profile, replace(FAST, rate=200.0), QUIET)
    features = analyze(run, uncertainties=False).features
    growth = 800.0 * FAST.retract_speed / 200.0
    assert features.value("sampling_bias_N") == pytest.approx(growth / 2, rel=0.2)
    assert features.value("pull_off_force_N") == pytest.approx(truth["pull_off_force_N"], abs=1.5 * growth)
    assert features.value("retraction_at_pull_off_m") == pytest.approx(features.value("pull_off_distance_m"), abs=2e-6)


def test_tensile_from_the_start_counts_from_the_start() -> None:
    place = np.linspace(0, 1e-3, 2000)
    profile = Profile(place, -0.1 - 0.8 * np.sin(np.pi * place / 1.2e-3), np.full(place.size, -3000.0))
    run, truth = pull_off_run(profile, FAST, QUIET)
    analysis = analyze(run, uncertainties=False)
    assert analysis.features.value("pull_off_distance_m") == pytest.approx(truth["pull_off_distance_m"], abs=2e-6)
    assert "tensile from the start" in analysis.decisions["Zero of force and of z_r"]
    with pytest.raises(FeatureMissing, match="does not cross zero"):
        analysis.features["stiffness_at_zero_N_m"]


@pytest.mark.parametrize("name", list(CONTACT_METHODS))
@pytest.mark.parametrize("snap_in", [0.0, -0.02])
def test_every_contact_method_finds_contact_with_and_without_snap_in(name: str, snap_in: float) -> None:
    generator = np.random.default_rng(3)
    depth = np.linspace(-1e-3, 0.5e-3, 1500)
    inside = np.maximum(depth, 0)
    force = np.where(depth > 0, snap_in + 1500.0 * inside + 1e5 * inside**2, 0.0) + generator.normal(
        0, 2e-4, depth.size
    )
    found = CONTACT_METHODS[name](depth, force, 2e-4)
    assert depth[found] == pytest.approx(0.0, abs=12e-6)


def test_contact_point_carries_the_spread_of_its_methods() -> None:
    analysis = analyze(quiet_run()[0])
    contact = analysis.features["contact_height_m"]
    assert len(analysis.work.methods["contact_height_m"]) >= 3
    spread = analysis.features.value("contact_spread_m")
    cell = float(np.ptp(np.asarray(analysis.work.details["contact"]["separation"])[:2]))
    assert contact.budget["contact point"] == pytest.approx(np.hypot(spread, cell / np.sqrt(12)))
    assert contact.value == pytest.approx(5e-3, abs=3 * contact.uncertainty + 1e-5)


def test_snap_in_is_contact_not_drift() -> None:
    run, _ = quiet_run()
    approach = run.step("approach")
    assert approach is not None
    force = run.force.copy()
    touched = slice(approach.stop - 400, approach.stop - 150)
    force[touched] = force[: approach.start].mean() - 0.03
    snapped = analyze(replace(run, force=force), uncertainties=False).features
    assert snapped.value("force_noise_N") == pytest.approx(2e-4, rel=0.1)


def test_gas_and_pump_work_follow_boyle() -> None:
    run, _ = quiet_run()
    assert run.pressure is not None
    atmosphere, volume = SCENE.gas.atmospheric_pressure, SCENE.gripper.chamber_volume
    moved = volume * (1 - atmosphere / (atmosphere + run.pressure))
    from_gas_law = analyze(run, uncertainties=False).features.value("pump_work_J")
    from_pump = analyze(replace(run, pump_volume=moved), uncertainties=False).features.value("pump_work_J")
    assert from_pump == pytest.approx(from_gas_law, rel=0.05)
    assert from_gas_law > 0


@pytest.mark.parametrize("leak", [0.0, 1 / 3000])
def test_the_gas_leaks_and_the_end_is_not_seen(leak: float) -> None:
    """The membrane draws the gas out and gives it back within a sample; the line to the sensor lags by 50 ms."""
    run, _ = quiet_run(experiment={"retract_speed": 10e-6})
    retract = run.step("retract")
    assert retract is not None
    released = retract.stop
    atmosphere, rest, interval = SCENE.gas.atmospheric_pressure, SCENE.gripper.chamber_volume, 1 / run.rate
    volume = np.full(run.force.size, 1.015 * rest)
    volume[retract.start : released] += np.linspace(0, 0.02 * rest, released - retract.start)
    pressure, sensed, amount = np.empty(volume.size), np.empty(volume.size), 1.0
    for index, size in enumerate(volume):
        pressure[index] = atmosphere * (amount * rest / size - 1)
        sensed[index] = sensed[index - 1] + (pressure[index] - sensed[index - 1]) * interval / 0.05 if index else -1500
        if index > retract.start:
            amount -= pressure[index] / atmosphere * leak * interval
    part = slice(retract.start, released - round(0.1 * run.rate))
    true = float(np.trapezoid(pressure[part], volume[part]))
    noise = np.random.default_rng(0).normal(0, 3.0, volume.size)
    work = analyze(replace(run, pressure=sensed + noise)).features["gas_work_J"]
    assert work.value == pytest.approx(true, rel=0.01)
    assert abs(work.value - true) < 3 * work.uncertainty


def test_without_pressure_only_pressure_is_missing() -> None:
    run = replace(quiet_run()[0], pressure=None)
    features = analyze(run, uncertainties=False).features
    assert features.value("pull_off_force_N") > 0
    with pytest.raises(FeatureMissing, match="no pressure"):
        features["initial_pressure_Pa"]


@pytest.mark.parametrize("last", ["tare", "approach", "dwell", "pressurize", "retract"])
def test_an_aborted_run_gives_what_it_holds(last: str) -> None:
    run, truth = quiet_run()
    steps = run.steps[: [step.name for step in run.steps].index(last) + 1]
    stop = steps[-1].stop - (steps[-1].stop - steps[-1].start) // 3
    steps = (*steps[:-1], replace(steps[-1], stop=stop, outcome="stopped"))
    assert run.pressure is not None
    cut = replace(
        run, force=run.force[:stop], pressure=run.pressure[:stop], height=run.height[:stop], steps=steps, complete=False
    )
    features = analyze(cut).features
    assert "pull_off_distance_m" in features.missing
    assert set(features) | set(features.missing) >= {"preload_N", "pull_off_force_N", "initial_pressure_Pa"}
    if last in ("dwell", "pressurize", "retract"):
        assert features.value("preload_N") == pytest.approx(truth["preload_N"], abs=1e-3)
    if last == "retract":
        assert features.value("initial_pressure_Pa") == pytest.approx(truth["initial_pressure_Pa"], abs=3.0)


def test_without_adhesion_the_reason_is_given() -> None:
    place = np.linspace(0, 1e-3, 1000)
    profile = Profile(place, 0.3 * np.exp(-place / 1e-4), np.zeros(place.size))
    features = analyze(pull_off_run(profile, FAST, QUIET)[0]).features
    assert "no tension" in features.missing["pull_off_force_N"]
    assert features.value("preload_N") > 0.4


def test_a_useless_record_is_refused_with_its_name() -> None:
    empty = Run("nothing", "pull_off", 1000.0, np.zeros(4), None, np.zeros(4), (Step("tare", 0, 4),))
    with pytest.raises(AnalysisError, match="nothing"):
        analyze(empty)


def test_steps_are_checked_against_the_data() -> None:
    run, _ = quiet_run()
    upside_down = replace(run, height=-run.height)
    assert "contradicted by the data" in analyze(upside_down, uncertainties=False).decisions["Segments"]
    assert "confirmed" in analyze(run, uncertainties=False).decisions["Segments"]


def test_every_registered_step_explains_itself() -> None:
    steps = ordered()
    assert steps[0].name == "segments"
    assert all(len(step.explanation) > 40 for step in steps)
    names = [name for step in steps for name in step.gives]
    assert len(names) == len(set(names))
    analysis = analyze(quiet_run()[0], uncertainties=False)
    assert set(analysis.features) | set(analysis.features.missing) == {
        name for step in steps if not step.protocols or "pull_off" in step.protocols for name in step.gives
    }


def test_same_run_same_digits() -> None:
    run, _ = quiet_run()
    first, second = (json.dumps(analyze(run).features.as_json()) for _ in range(2))
    assert first == second


def test_budget_adds_up_and_follows_its_sources() -> None:
    sensors = Sensors(force_gain=0.01, position=0.001)
    run, _ = quiet_run(sensors=sensors)
    force = analyze(run).features["pull_off_force_N"]
    assert force.budget["force calibration"] == pytest.approx(0.01 * force.value, rel=0.01)
    assert force.uncertainty == pytest.approx(np.sqrt(sum(part**2 for part in force.budget.values())))
    distance = analyze(run).features["pull_off_distance_m"]
    assert distance.budget["position"] == pytest.approx(0.001 * distance.value, rel=0.05)


def test_light_copies_keep_features_and_curve() -> None:
    analysis = analyze(quiet_run()[0], uncertainties=False)
    light = lighten(analysis, 2000)
    assert light.run.force.size < 4500
    assert light.curve is not None
    assert analysis.curve is not None
    grid = np.linspace(0.1e-3, 1.5e-3, 30)
    whole = on_grid(analysis.curve.retraction, analysis.curve.force, grid)
    assert on_grid(light.curve.retraction, light.curve.force, grid) == pytest.approx(whole, abs=3e-3)
    assert light.features.value("pull_off_force_N") == analysis.features.value("pull_off_force_N")


def test_calibrated_creep_is_no_measurement_and_counts_once() -> None:
    known = Sensors(creep=0.06, creep_uncertainty=0.003, creep_time=9.0)
    run, _ = quiet_run(flaws={"creep": 0.06}, sensors=known)
    assert analyze(run).features["creep_fraction"].budget == {"creep": pytest.approx(0.003)}
    closed = volume_run(7e-6, sensors=known)
    assert "creep_fraction" not in analyze(closed).features


def test_a_kink_narrows_the_window_of_a_fit() -> None:
    x = np.arange(2000, dtype=np.float64)
    generator = np.random.default_rng(0)
    kink = np.abs(x - 1000.0) * 1e-3 + generator.normal(0, 1e-3, x.size)
    smooth = (x - 1000.0) ** 2 * 1e-6 + generator.normal(0, 1e-3, x.size)
    noise = Noise(1e-3, np.empty(0))
    narrow, wide = (fit_around(y, 1000, 0, 2000, noise) for y in (kink, smooth))
    assert narrow.stop - narrow.start < 200 < wide.stop - wide.start
    assert wide.minimum()[0] == pytest.approx(1000, abs=20)


def test_a_steep_slope_is_no_jump() -> None:
    generator = np.random.default_rng(1)
    values = np.linspace(0, 1, 4000) + generator.normal(0, 1e-3, 4000)
    noise = Noise(1e-3, np.empty(0))
    assert find_jumps(values, noise, 20, 0.01) == []
    values[2500:] += 0.1
    (jump,) = find_jumps(values, noise, 20, 0.01)
    assert jump.middle == pytest.approx(2499.5, abs=1.5)
    assert jump.size == pytest.approx(0.1, abs=0.005)


def test_coloured_noise_is_measured_and_redrawn() -> None:
    generator = np.random.default_rng(2)
    white = generator.normal(0, 1, 60_000)
    coloured = np.convolve(white, np.ones(10) / 10, mode="valid")
    noise = Noise.measure(coloured, 100)
    assert noise.inflation == pytest.approx(np.sqrt(10), rel=0.15)
    drawn = noise.draw(50_000, generator)
    assert Noise.measure(drawn, 100).of_mean(100) == pytest.approx(noise.of_mean(100), rel=0.2)


def test_documentation_lists_every_step_and_feature() -> None:
    page = Path(__file__).parents[1] / "docs" / "analysis.md"
    assert page.read_text(encoding="utf-8").endswith(markdown())
