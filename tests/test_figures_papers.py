"""The papers' figures: each draws from the models alone and from recordings, and its CSV says which."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from analysis import AnalysisError, Run, Sensors, analyze
from analysis.figures import overview
from analysis.figures.registry import Material, draw, find, load, picture
from analysis.figures.run_overview import markers, overview_bytes
from analysis.figures.style import CYCLE, canvas, thin
from analysis.pipeline import Analysis
from analysis.repeats import Group, group
from analysis.sampling import READERS, SamplingStudy, study
from analysis.synthetic import Experiment, Imperfections, Profile, pull_off_run
from model import Gas, Parameters, Substrate, predict

FAST = Experiment(rate=100.0, retract_speed=100e-6, dwell=2.0, settle=2.0, tail=3.0)
PAPER = [
    f"{n}{c}" for n, letters in (("2", "ab"), ("3", "abcde"), ("5", "abcdef"), ("6", "abcdefghi")) for c in letters
]
MODEL_ONLY = [number for number in [*PAPER, "S8", "S9"] if number not in ("5c", "5f")]


def scene(diameter: float | None, pressure: float) -> Parameters:
    shape = Substrate("flat") if diameter is None else Substrate("sphere", diameter)
    return Parameters(shape, gas=Gas(initial_pressure=pressure))


def recorded(parameters: Parameters, seed: int = 0) -> Run:
    profile = Profile.of(predict(parameters, points=1500))
    run, _ = pull_off_run(profile, FAST, Imperfections(force_noise=3e-4), seed=seed, parameters=parameters)
    return replace(run, name=f"{parameters.substrate.diameter}-{parameters.gas.initial_pressure}-{seed}")


@cache
def analysed(diameter: float | None, pressure: float, seed: int = 0) -> Analysis:
    return analyze(recorded(scene(diameter, pressure), seed), uncertainties=False)


@cache
def groups() -> list[Group]:
    ends = ((15e-3, (1000.0,)), (30e-3, (1000.0, -1000.0)), (60e-3, (1000.0, -1000.0)), (None, (0.0,)))
    return group(analysed(d, p, seed) for d, pressures in ends for p in pressures for seed in range(2))


def read_png(data: bytes) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    from matplotlib.image import imread

    return np.asarray(imread(io.BytesIO(data), format="png"), dtype=np.float64)


def test_every_figure_of_the_papers_is_there() -> None:
    assert set(load()) == {*PAPER, "S8", "S9", "sampling"}
    with pytest.raises(AnalysisError, match="choose one of"):
        find("7z")


@pytest.mark.parametrize("number", MODEL_ONLY)
def test_draws_from_the_models_alone(number: str, tmp_path: Path) -> None:
    table = draw(number, Material(), tmp_path / "figure.png")
    data = pd.read_csv(table)
    assert len(data) > 10
    assert data["source"].str.startswith("model").all()
    shape = read_png((tmp_path / "figure.png").read_bytes()).shape
    assert shape[0] > 300
    assert shape[1] > 500


@pytest.mark.parametrize("number", ["2a", "2b", "3a", "3c", "3d", "3e", "5a", "5b", "5c"])
def test_draws_recordings_where_there_are_some(number: str, tmp_path: Path) -> None:
    data = pd.read_csv(draw(number, Material(groups()), tmp_path / "figure.png"))
    measured = data[data["source"] == "measured"]
    assert len(measured) > 1
    if number.startswith("5"):
        assert data["source"].str.startswith("model").any()


def test_5c_holds_mean_deviation_and_count(tmp_path: Path) -> None:
    data = pd.read_csv(draw("5c", Material(groups()), tmp_path / "figure.png"))
    row = data[(data["source"] == "measured") & (data["series"] == "60 mm")].iloc[0]
    assert row["count"] == 2
    truth = predict(scene(60e-3, 1000.0)).pull_off_force
    assert row["pull_off_force_N"] == pytest.approx(truth, rel=0.01)
    assert row["pull_off_force_standard_deviation_N"] < 0.01


def test_5f_shows_the_maxima_of_the_model(tmp_path: Path) -> None:
    data = pd.read_csv(draw("5f", Material(), tmp_path / "figure.png"))
    high = data[data["series"] == "+1.0 kPa"]
    best = high.loc[high["pull_off_distance_m"].idxmax()]
    assert best["diameter_m"] * 1e3 == pytest.approx(33, abs=2)
    drop = 1 - high["pull_off_distance_m"].iloc[-1] / best["pull_off_distance_m"]
    assert drop == pytest.approx(0.11, abs=0.02)
    low = data[data["series"] == "-1.0 kPa"]
    assert low.loc[low["pull_off_distance_m"].idxmax(), "diameter_m"] == pytest.approx(29.8e-3, abs=0.1e-3)
    assert np.diff(low["diameter_m"]).max() <= 1.001e-3


@pytest.mark.parametrize("number", ["5d", "5e", "6a", "6d", "6g", "6h"])
def test_a_picture_of_a_model_names_it_and_what_it_assumes(number: str) -> None:
    with canvas() as figure:
        find(number).draw(figure, Material())
        title = figure.axes[0].get_title(loc="left")
    assert "model cone" in title
    assert "$P_0$" in title
    assert ("assumed" in title) == (number in ("6a", "6d", "6g"))
    assert {"6a": "$d_b$ = 30 mm", "6d": "$d_b$ = 30 mm", "6g": "$d_b$ = 60 mm"}.get(number, "") in title


def test_s8_shows_the_beginning_of_the_retraction(tmp_path: Path) -> None:
    data = pd.read_csv(draw("S8", Material(), tmp_path / "figure.png"))
    beginning = data[data["series"] == "beginning"]
    assert len(beginning) > 50
    assert beginning["retraction_m"].max() < 101e-6
    assert np.all(np.diff(beginning["force_N"]) < 0)
    assert np.diff(beginning["force_N"]).min() > -1e-3
    assert "7.9999 mm" in set(data["series"])


def test_s9_without_recordings_begins_at_the_preload(tmp_path: Path) -> None:
    data = pd.read_csv(draw("S9", Material(), tmp_path / "figure.png"))
    assert data.groupby("series")["force_N"].max().to_list() == pytest.approx([0.1, 0.1])


def test_3e_takes_the_membrane_nearest_to_no_pressure_and_names_it() -> None:
    flats = group(analysed(None, pressure) for pressure in (1000.0, 0.0, -1000.0))
    with canvas() as figure:
        find("3e").draw(figure, Material(flats))
        legend = figure.axes[0].get_legend()
        assert legend is not None
        words = [text.get_text() for text in legend.get_texts()]
        assert "75 µm" in figure.axes[0].get_title(loc="left")
    assert words[0].startswith("FAM, $P_0$ = +0.0 kPa")


@pytest.mark.parametrize(("number", "distance"), [("6h", 1.59e-3), ("6i", 1.26e-3)])
def test_disks_let_go_at_one_height_above_them(number: str, distance: float, tmp_path: Path) -> None:
    """EML 2020: D_p = 1.59 and 1.26 mm for all sizes of the disk, counted from z = 0."""
    data = pd.read_csv(draw(number, Material(), tmp_path / "figure.png"))
    ends = data.groupby("series")["position_m"].max()
    assert len(ends) == 8
    assert ends.max() - ends.min() < 2e-6
    assert ends.max() == pytest.approx(distance, abs=0.02e-3)


def test_the_example_without_recordings_names_its_anchor_and_snaps_to_zero(tmp_path: Path) -> None:
    data = pd.read_csv(draw("2a", Material(), tmp_path / "figure.png"))
    assert set(data["series"]) == {"60 mm, P_0 = -3.2 kPa at V_0"}
    assert data["pressure_Pa"].iloc[0] > -2000
    with canvas() as figure:
        find("2a").draw(figure, Material())
        assert np.asarray(figure.axes[0].get_lines()[0].get_ydata())[-1] == 0.0


def test_s9_draws_every_position(tmp_path: Path) -> None:
    profile = Profile.jkr(4.1, 4e-3, 2e6, 0.095)
    runs = []
    for seed, place in enumerate(("top", "left")):
        test = replace(FAST, preload=0.1, approach_stiffness=20000.0, retract_speed=10e-6)
        test = replace(test, settings={"indenter_radius_mm": 4.0, "position": place})
        run, _ = pull_off_run(profile, test, Imperfections(force_noise=1e-4), seed=seed)
        runs.append(replace(run, protocol="indentation", pressure=None))
    data = pd.read_csv(draw("S9", Material(group(analyze(run) for run in runs)), tmp_path / "figure.png"))
    assert data[data["source"] == "measured"]["series"].nunique() == 2
    assert {"model JKR", "model DMT", "model Maugis"} <= set(data["source"])


def test_the_line_of_the_tare_lies_on_the_force_it_was_fitted_to() -> None:
    from analysis.figures.reasons import draw_reasons

    profile = Profile.of(predict(scene(60e-3, 1000.0), points=1500))
    flaws = Imperfections(force_noise=1e-4, creep=0.06, drift=2e-5)
    sensors = Sensors(creep=0.06, creep_time=9.0)
    run, _ = pull_off_run(profile, FAST, flaws, parameters=scene(60e-3, 1000.0), sensors=sensors)
    with canvas() as figure:
        draw_reasons(figure, analyze(run, uncertainties=False))
        *_, after, line = figure.axes[0].get_lines()
        time, shown = (np.asarray(values, dtype=np.float64) for values in after.get_data())
        assert np.abs(shown - np.interp(time, *line.get_data())).max() < 0.7


def test_small_forces_and_ways_are_written_in_small_units() -> None:
    from analysis.figures.run_overview import Scale
    from analysis.quantity import Quantity

    assert Scale.of_force(np.array([0.0, -1.6e-3])).write(Quantity(1.619e-3, 2.9e-5, "N")) == "1.619 ± 0.029 mN"
    assert Scale.of_force(np.array([-1.0])).unit == "N"
    assert Scale.of_length(2.9e-6).unit == "µm"


def test_the_measured_pressure_fills_its_axis() -> None:
    from analysis.figures.run_overview import draw_overview

    run = recorded(scene(15e-3, 1000.0))
    assert run.pressure is not None
    analysis = analyze(run, uncertainties=False)
    with canvas() as figure:
        draw_overview(figure, run, analysis, predict(scene(15e-3, 9000.0)))
        low, high = figure.axes[-1].get_ylim()
        seen = 1e-3 * float(np.ptp(run.pressure[slice(*analysis.work.retraction())]))
        assert high - low < 2.2 * seen


def test_same_material_same_bytes() -> None:
    assert picture("3c", Material(groups())) == picture("3c", Material(groups()))
    assert picture("6h", Material(), "svg") == picture("6h", Material(), "svg")
    assert picture("6h", Material(), "pdf") == picture("6h", Material(), "pdf")


def test_overview_marks_the_six_moments(tmp_path: Path) -> None:
    analysis = analysed(60e-3, 1000.0)
    places = markers(analysis.run, analysis)
    assert list(places) == [1, 2, 3, 4, 5, 6]
    assert all(first[0] < second[0] for first, second in pairwise(places.values()))
    overview(analysis.run, analysis, predict(scene(60e-3, 1000.0)), tmp_path / "run.png")
    assert read_png((tmp_path / "run.png").read_bytes()).shape[0] > 900


def test_no_pressure_axis_without_pressure() -> None:
    from analysis.figures.run_overview import draw_overview

    run = recorded(scene(60e-3, 1000.0))
    vented = replace(run, pressure=None)
    for version, axes in ((run, 4), (vented, 2)):
        with canvas() as figure:
            draw_overview(figure, version, analyze(version, uncertainties=False), None)
            assert len(figure.axes) == axes
            labels = " ".join(a.get_ylabel() for a in figure.axes)
            assert ("[kPa]" in labels) == (version is run)


def test_overview_of_a_run_without_a_curve_says_why() -> None:
    run = recorded(scene(60e-3, 1000.0))
    approach = run.step("approach")
    assert approach is not None
    assert run.pressure is not None
    stop = approach.stop
    cut = replace(
        run, force=run.force[:stop], pressure=run.pressure[:stop], height=run.height[:stop], steps=run.steps[:2]
    )
    assert len(overview_bytes(cut, analyze(cut, uncertainties=False), None)) > 10_000


def test_colours_differ_in_lightness() -> None:
    """Colour-blind readers, and printers, tell neighbours apart by lightness."""
    from matplotlib.colors import to_rgb

    lightness = [float(np.dot(to_rgb(color), (0.2126, 0.7152, 0.0722))) for color in CYCLE]
    assert len(set(CYCLE)) == len(CYCLE)
    assert min(abs(a - b) for a, b in pairwise(lightness)) > 0.05


def test_thinning_keeps_the_extremes() -> None:
    x = np.arange(100_000, dtype=np.float64)
    y = np.sin(x / 3000)
    y[54_321] = 9.0
    shown_x, shown_y = thin(x, y)
    assert shown_x.size < 5000
    assert shown_y.max() == 9.0
    assert shown_y.min() == y.min()
    assert np.all(np.diff(shown_x) > 0)


def test_sampling_study_finds_this_analysis_ahead() -> None:
    profile = Profile.of(predict(scene(60e-3, -1000.0), points=1500))
    data = study(profile, SamplingStudy(repeats=4, rates=(50.0, 500.0), retract_speed=100e-6))
    assert set(data["reader"]) == set(READERS)
    assert (data["missing"] == 0).all()
    errors = data.pivot(index="rate_Hz", columns="reader", values="pull_off_force_error_N")
    assert (errors["this analysis"] < errors["least sample, no filter"]).all()
    assert errors["least sample, no filter"].iloc[1] > errors["least sample, no filter"].iloc[0]
    late = data[data["reader"] == "low-pass 4 Hz, causal"]["pull_off_distance_bias_m"]
    ours = data[data["reader"] == "this analysis"]["pull_off_distance_bias_m"]
    assert late.abs().min() > ours.abs().max()
