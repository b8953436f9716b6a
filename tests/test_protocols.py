"""Every protocol, shortened, runs to its end on the emulated bench and finds what the plant is made of."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest
from conftest import scene_text

from analysis import analyze
from drivers.emulated.chamber import ATMOSPHERE
from drivers.emulated.electronics import Cell
from rig.bench import load_bench, parse_bench
from rig.calibrate import calibrate
from rig.check import check, reasons
from rig.cli import main
from rig.errors import Refused
from rig.measured import load_run
from rig.observe import Observer, StepPhase
from rig.recording import load_recording
from rig.scene import parse_scene
from rig.session import Request, run_scene
from rig.summary import summarise

COVERAGE = 3.0
"""Results must lie within so many of their standard uncertainties of the truth."""


class Witness(Observer):
    """Sees the plant's true force at the end of every frame, as no instrument does."""

    def __init__(self) -> None:
        self.bench = None
        self.least_force = 0.0
        self.steps: list[str] = []
        self.pressures: dict[str, float] = {}

    @property
    def truth(self):
        return self.bench.plant.truth

    def frame(self, frame):
        self.least_force = min(self.least_force, self.bench.plant.state.force)

    def step(self, event):
        if event.phase is StepPhase.STARTED:
            self.steps.append(event.name)
            self.pressures[event.name] = self.bench.plant.state.pressure


@pytest.fixture
def witness(tell_bench):
    """Return a witness that is given the emulated bench of the next run."""
    seen = Witness()
    tell_bench(lambda bench: setattr(seen, "bench", bench))
    return seen


@pytest.fixture
def run(tmp_path, witness):
    """Return a function that runs a shipped scene with other protocol values and returns the recording's path."""

    def go(name, *, bench=None, seed=0, out="run.h5", place="", **protocol):
        text = scene_text(name, **protocol)
        found, bench_text = (
            load_bench(None if bench is None else Path(bench)) if not isinstance(bench, tuple) else bench
        )
        request = Request(
            parse_scene(text, name),
            text,
            found,
            bench_text,
            tmp_path / out,
            seed=seed,
            wire=False,
            live=False,
            observers=[witness],
            place=place,
        )
        ending = run_scene(request)
        assert ending.exit_code == 0, ending.reason
        return request.out

    return go


def close(quantity, truth):
    """Whether a quantity agrees with the truth within its stated uncertainty."""
    return abs(quantity.value - truth) <= COVERAGE * quantity.uncertainty


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_volume_test_finds_the_chamber_volume(run, witness, seed):
    path = run("volume", seed=seed, settle_s=1.0, strokes_ml=[-0.1, 0.2, -0.1])
    volume = analyze(load_run(path)).features["chamber_volume_m3"]
    assert close(volume, witness.truth.chamber.volume)
    assert volume.uncertainty < 0.01 * volume.value


@pytest.mark.parametrize("seed", [0, 1])
def test_the_leak_test_finds_the_time_constant_and_the_rate(run, witness, seed):
    path = run("leak", hold_s=60.0, seed=seed)
    features = analyze(load_run(path)).features
    tau, rate = features["leak_time_constant_s"], features["leak_rate_Pa_s"]
    chamber, pressure = witness.truth.chamber, witness.pressures["hold"]
    truth = chamber.leak_time / (1 + pressure / ATMOSPHERE)  # the syringe has enlarged the gas volume by as much
    assert close(tau, truth)
    assert close(rate, -pressure / truth)
    assert rate.uncertainty < 0.3 * rate.value


@pytest.mark.parametrize("name", ["volume", "leak"])
def test_the_chamber_tests_draw_their_fit(run, name):
    short = {"settle_s": 0.5, "strokes_ml": [-0.1, 0.2]} if name == "volume" else {"hold_s": 10.0}
    path = run(name, **short)
    text = summarise(path)
    assert ("chamber_volume_m3" if name == "volume" else "leak_rate_Pa_s") in text
    assert path.with_suffix(".png").stat().st_size > 10_000


def test_indentation_finds_the_pull_off_force_and_states_its_validity(run, witness):
    path = run("indentation", preload_dwell_s=2.0, place="center")
    analysis = analyze(load_run(path))
    assert close(analysis.features["pull_off_force_N"], -witness.least_force)
    work = analysis.features["work_of_adhesion_J_m2"]
    line = witness.truth.specimen.line
    assert line.receding < work.value < 1.25 * line.receding  # peeling at a finite rate costs more
    assert "S13" in summarise(path)


def test_fibers_let_go_at_their_true_strength(run, witness):
    path = run("fiber", bench="emulated-gso25", place="SPL#1", preload_dwell_s=1.0)
    assert close(analyze(load_run(path)).features["pull_off_force_N"], -witness.least_force)


def test_punch_finds_the_pull_off_force(run, witness):
    path = run("punch", preload_dwell_s=1.0, preload_N=0.5)
    assert close(analyze(load_run(path)).features["pull_off_force_N"], -witness.least_force)


def test_the_soft_gripper_runs_at_the_published_pressure(run, witness):
    path = run("soft-flat", preload_N=0.1, preload_dwell_s=0.0, retract_speed_um_s=100.0)
    force = analyze(load_run(path)).features["pull_off_force_N"]
    assert close(force, -witness.least_force)
    assert force.value == pytest.approx(3.61, rel=0.1)  # PNAS SI Table S2


@pytest.mark.parametrize("seed", [0, 1])
def test_dead_weights_find_the_cells_sensitivity(run, seed):
    calibration = calibrate(load_recording(run("dead-weights", rest_s=0.5, seed=seed)))
    record = tomllib.loads(calibration.toml)["force"]["calibration"]
    cell = Cell(capacity=4.903325, sensitivity=1 / 0.4903)
    heaviest = 0.2 * 9.80665
    bow = 1 + cell.linearity * (1 - heaviest / cell.capacity)
    truth = 1 / (cell.sensitivity * (1 + cell.gain_error) * bow)
    assert abs(record["slope"] - truth) <= COVERAGE * record["relative_uncertainty"] * truth
    assert record["relative_uncertainty"] < 1e-3


def test_the_lines_of_the_load_cell_go_into_the_bench_file(run):
    toml = calibrate(load_recording(run("dead-weights", rest_s=0.5))).toml
    _, text = load_bench(None)
    head, _, rest = text.partition("[force.calibration]")
    _, _, tail = rest.partition("[pressure]")
    record = toml[toml.index("[force.calibration]") :]
    bench = f"{head}{record}\n[pressure]{tail}"
    again = calibrate(
        load_recording(
            run("dead-weights", rest_s=0.5, seed=5, out="again.h5", bench=(parse_bench(bench, "new.toml"), bench))
        )
    )
    new, old = (tomllib.loads(t)["force"]["calibration"] for t in (again.toml, toml))
    assert new["slope"] == pytest.approx(old["slope"], rel=3 * old["relative_uncertainty"])
    assert abs(new["intercept"] - old["intercept"]) < 2e-3


def test_names_in_quotes_stay_what_they_are_in_the_lines_of_the_load_cell(run):
    _, text = load_bench(None)
    name = 'Ann "Bee" O\\N'
    head, _, rest = text.partition("operator = ")
    bench = f"{head}operator = {json.dumps(name)}\n{rest.partition(chr(10))[2]}"
    path = run("dead-weights", rest_s=0.5, bench=(parse_bench(bench, "new.toml"), bench))
    toml = calibrate(load_recording(path)).toml
    assert tomllib.loads(toml)["force"]["calibration"]["operator"] == name


def test_the_pressure_zero_goes_into_the_bench_file_and_takes_effect(run):
    first = calibrate(load_recording(run("pressure-zero")))
    _, text = load_bench(None)
    bench = text.replace("[limits]", first.toml.replace("# replace the whole table", "") + "\n[limits]")
    path = run("pressure-zero", rest_s=3.0, out="again.h5", bench=(parse_bench(bench, "new.toml"), bench))
    recording = load_recording(path)
    assert abs(recording.pressure.mean()) < 0.5  # the zero itself is 94 Pa
    second = tomllib.loads(calibrate(recording).toml)["pressure"]["zero"]
    assert second["offset_Pa"] == pytest.approx(tomllib.loads(first.toml)["pressure"]["zero"]["offset_Pa"], abs=0.5)


def test_compliance_finds_load_train_and_stop(run, witness):
    path = run("compliance", approach_speed_um_s=100.0, unload_um=25.0)
    found = tomllib.loads(calibrate(load_recording(path)).toml)["force"]
    truth = 1e6 / witness.truth.train.stiffness + 1e6 / witness.truth.specimen.stop_stiffness
    assert abs(found["compliance_um_per_N"] - truth) <= COVERAGE * found["compliance_uncertainty_um_per_N"]
    assert found["compliance_uncertainty_um_per_N"] < 0.3
    assert "compliance_um_per_N" in summarise(path)
    assert path.with_suffix(".toml").read_text("utf-8").startswith("[force]")


def test_hung_weights_are_asked_for_one_by_one_and_the_run_waits(run, witness):
    path = run("dead-weights", rest_s=0.5, masses_g=[0.0, 50.0, 100.0])
    assert witness.steps == [
        "hang 0 g", "weigh 0 g", "hang 50 g", "weigh 50 g", "hang 100 g", "weigh 100 g",
        "hang 50 g going down", "weigh 50 g going down", "hang 0 g going down", "weigh 0 g going down",
    ]  # fmt: skip
    events = load_recording(path).events
    prompts = [row["text"].decode() for row in events if row["kind"] == b"prompt"]
    assert prompts[1] == "Hang 50 g on the gripper, wait until it is still, then go on"
    assert sum(row["kind"] == b"operator" for row in events) == len(prompts) == 5


def refused(name, bench=None, **protocol):
    scene = parse_scene(scene_text(name, **protocol), name)
    with pytest.raises(Refused) as caught:
        check(scene, load_bench(None)[0] if bench is None else bench)
    return str(caught.value)


def test_fibers_are_refused_on_a_load_cell_that_cannot_see_them():
    message = refused("fiber")
    assert "GSO-500" in message
    assert "--bench emulated-gso25" in message


def test_weights_the_bench_cannot_carry_are_refused():
    assert "500 g pull with 4.9 N" in refused("dead-weights", masses_g=[0.0, 100.0, 500.0])


def test_the_soft_gripper_is_refused_where_its_force_would_end_the_run():
    bench, _ = load_bench(None)
    weaker = bench.model_copy(update={"limits": bench.limits.model_copy(update={"tension_N": 3.0})})
    assert "3.61 N" in refused("soft-flat", bench=weaker)


def test_substrates_that_the_emulated_bench_does_not_know_are_refused_there_alone():
    bench, _ = load_bench(None)
    for name, material, refusals in (
        ("soft-rubber-film", "Rubber Film", 0),
        ("soft-flat", "steel", 1),
        ("flat-low", "Rubber Film", 1),
    ):
        scene = parse_scene(scene_text(name), name)
        changed = scene.model_copy(update={"substrate": scene.substrate.model_copy(update={"material": material})})
        found = reasons(changed, bench)
        assert len(found) == refusals
        assert all("none of which the emulated bench knows" in reason for reason in found)


def test_strokes_beyond_the_pressure_limits_are_refused():
    assert "strokes_ml: +3 ml in the chamber make about +72.4 kPa" in refused("volume", strokes_ml=[3.0, -3.0])


def test_compliance_may_be_measured_on_a_bench_that_does_not_know_it_yet():
    bench, _ = load_bench(None)
    new = bench.model_copy(
        update={
            "force": bench.force.model_copy(update={"compliance_um_per_N": 0.0}),
            "limits": bench.limits.model_copy(update={"look_ahead_um": 40.0}),
        }
    )
    check(parse_scene(scene_text("compliance"), "compliance"), new)
    assert "run the scene `compliance`" in refused("sphere-60mm-vented", bench=new)


def test_rig_analyze_gives_the_lines_too_and_refuses_to_report_them(run, capsys):
    path = run("pressure-zero", rest_s=0.5)
    assert main(["analyze", str(path)]) == 0
    assert "[pressure.zero]" in capsys.readouterr().out
    assert main(["analyze", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    zero = tomllib.loads(told["bench_file"])["pressure"]["zero"]
    assert told["calibration"]["offset_Pa"] == pytest.approx(zero["offset_Pa"], abs=1e-3)
    assert main(["analyze", str(path), "--csv"]) == 2
    assert "a calibration (pressure_zero) has no features" in capsys.readouterr().err
