"""Repeats: bands, outliers, pooled numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis import Run, analyze
from analysis.pipeline import Analysis
from analysis.quantity import Quantity
from analysis.repeats import Condition, band, group, pool, pooled_frame
from analysis.synthetic import Experiment, Imperfections, Profile, pull_off_run
from model import Gas, Gripper, Parameters, Substrate

FAST = Experiment(rate=200.0, retract_speed=50e-6, dwell=2.0, settle=2.0, tail=3.0)
SCENE = Parameters(Substrate("sphere", 60e-3), Gripper(), gas=Gas(initial_pressure=-500.0))


def shape(scale: float, distance: float = 1.2e-3) -> Profile:
    place = np.linspace(-0.1e-3, distance, 2000)
    force = -scale * np.sin(np.pi * place / (1.2 * distance))
    return Profile(place, force, np.linspace(-500.0, -900.0, place.size))


def made_run(scale: float, seed: int, parameters: Parameters = SCENE) -> Run:
    run, _ = pull_off_run(shape(scale), FAST, Imperfections(force_noise=3e-4), seed=seed, parameters=parameters)
    return run


def analyses(scales: list[float]) -> list[Analysis]:
    return [analyze(made_run(scale, seed), uncertainties=False) for seed, scale in enumerate(scales)]


def test_band_is_mean_and_standard_deviation_on_a_common_grid() -> None:
    scales = [0.50, 0.52, 0.48, 0.51, 0.49]
    (members,) = group(analyses(scales))
    mean = band(members)
    assert mean is not None
    assert mean.count == 5
    at = int(np.argmin(mean.force))
    assert mean.force[at] == pytest.approx(-np.mean(scales), rel=0.01)
    assert mean.force_deviation[at] == pytest.approx(np.std(scales, ddof=1), rel=0.08)
    assert mean.pressure is not None
    assert np.all(np.diff(mean.retraction) > 0)


def test_the_mean_of_repeats_ends_where_the_first_detaches() -> None:
    runs = []
    for seed, distance in enumerate((1.2e-3, 1.3e-3)):
        run, _ = pull_off_run(shape(0.5, distance), FAST, Imperfections(force_noise=3e-4), seed=seed, parameters=SCENE)
        runs.append(analyze(run, uncertainties=False))
    first = min(run.features.value("pull_off_distance_m") for run in runs)
    mean = band(group(runs)[0])
    assert mean is not None
    assert first - 10e-6 < mean.retraction[-1] < first
    assert mean.force[-1] + mean.force_deviation[-1] < -0.1
    assert set(mean.frame()["repeats_in_contact"]) == {2.0}
    alone = band(group(runs[:1])[0])
    assert alone is not None
    assert alone.retraction[-1] > first + 0.1e-3


def test_band_without_pressure_has_none() -> None:
    without = [analyze(replace(made_run(0.5, seed), pressure=None), uncertainties=False) for seed in range(2)]
    mean = band(group(without)[0])
    assert mean is not None
    assert mean.pressure is None


def test_an_outlier_is_left_out_and_named_with_its_rule() -> None:
    (members,) = group(analyses([0.50, 0.502, 0.498, 0.501, 0.499, 0.80]))
    assert list(members.outliers) == ["synthetic-5"]
    assert "F_p" in members.outliers["synthetic-5"]
    assert "Grubbs" in members.rule
    pooled = members.pooled("pull_off_force_N")
    assert pooled is not None
    assert pooled.count == 5
    assert pooled.mean == pytest.approx(0.5, abs=0.002)


def test_one_gross_outlier_of_five_does_not_hide_behind_its_own_deviation() -> None:
    from analysis.repeats import _grubbs

    forces = [0.516, 0.524, 0.537, 0.547, 0.689]
    named = [(str(i), Quantity(force, 0.003, "N")) for i, force in enumerate(forces)]
    assert list(_grubbs(named)) == ["4"]
    unsure = [(name, Quantity(force.value, 0.03, "N")) for name, force in named]
    assert _grubbs(unsure) == {}


@pytest.mark.parametrize("seed", range(5))
def test_normal_repeats_are_rarely_outliers(seed: int) -> None:
    generator = np.random.default_rng(seed)
    found = [Quantity(value, 1e-6, "N") for value in generator.normal(1, 0.05, 5)]
    from analysis.repeats import _grubbs

    assert _grubbs([(str(i), quantity) for i, quantity in enumerate(found)]) == {}


def test_common_errors_do_not_average_out() -> None:
    each = [Quantity(1.0 + d, 0.02, "N", budget={"noise": 0.01, "force calibration": 0.02}) for d in (-0.01, 0, 0.01)]
    pooled = pool(each)
    assert pooled.deviation == pytest.approx(0.01)
    assert pooled.uncertainty == pytest.approx(np.hypot(0.01 / np.sqrt(3), 0.02))


def test_groups_follow_substrate_and_pressure() -> None:
    flat = replace(SCENE, substrate=Substrate("flat"))
    positive = SCENE.with_changes(initial_pressure=1000.0)
    runs = [made_run(0.5, 1, flat), made_run(0.4, 2), made_run(0.3, 3, positive), made_run(0.41, 4)]
    groups = group(analyze(run, uncertainties=False) for run in runs)
    assert [str(m.condition) for m in groups] == [
        "d_b 60 mm, P_0 = +1.0 kPa",
        "d_b 60 mm, P_0 = -0.5 kPa",
        "Flat Glass, P_0 = -0.5 kPa",
    ]
    assert [len(m.members) for m in groups] == [1, 2, 1]
    table = pooled_frame(groups)
    assert set(table["condition"]) == {str(m.condition) for m in groups}
    assert (table["count"] >= 1).all()


def test_condition_of_a_run_without_model() -> None:
    run = replace(made_run(0.5, 0), parameters=None, protocol="indentation", settings={"position": "Left"})
    assert str(Condition.of(run)) == "indentation, Left"


def test_other_membranes_and_settings_are_other_conditions() -> None:
    thick = replace(SCENE, membrane=replace(SCENE.membrane, thickness=400e-6, work_of_adhesion=8.0))
    wide = replace(SCENE, gripper=replace(SCENE.gripper, chamber_volume=14.4e-6))
    slow = {"preload_N": 0.5, "retract_speed_um_s": 10.0, "preload_dwell_s": 30.0}
    fast = {**slow, "retract_speed_um_s": 100.0, "preload_dwell_s": 2.0}
    runs = [replace(made_run(0.5, seed), settings=slow) for seed in range(2)]
    runs += [replace(made_run(0.5, 2, thick), settings=slow), replace(made_run(0.5, 3), settings=fast)]
    runs.append(replace(made_run(0.5, 4, wide), settings=slow))
    groups = group(analyze(run, uncertainties=False) for run in runs)
    names = {str(members.condition): len(members.members) for members in groups}
    same = "d_b 60 mm, P_0 = -0.5 kPa, "
    assert names == {
        same + "V_0 7.2 mL, h_0 200 µm, ω_a 4 J/m², retraction 10 µm/s, dwell 30 s": 2,
        same + "V_0 7.2 mL, h_0 400 µm, ω_a 8 J/m², retraction 10 µm/s, dwell 30 s": 1,
        same + "V_0 7.2 mL, h_0 200 µm, ω_a 4 J/m², retraction 100 µm/s, dwell 2 s": 1,
        same + "V_0 14.4 mL, h_0 200 µm, ω_a 4 J/m², retraction 10 µm/s, dwell 30 s": 1,
    }


def test_a_pressure_between_the_tenths_is_named_in_full() -> None:
    pressures = (-500.0, -520.0, -525.5)
    runs = [made_run(0.5, i, SCENE.with_changes(initial_pressure=p)) for i, p in enumerate(pressures)]
    names = [str(members.condition) for members in group(analyze(run, uncertainties=False) for run in runs)]
    assert [name.partition("P_0 = ")[2] for name in names] == ["-0.5 kPa", "-0.52 kPa", "-0.5255 kPa"]
