"""The live prediction: what it learns from a test it has the truth of, and that it never holds up a run."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from model import Gas, Parameters, Substrate, predict
from rig.live import LivePredictor
from rig.live_data import GONE, Evidence, Gathering, Glance
from rig.live_fit import Doubt, Estimator, Kernel, mend
from rig.live_prediction import LivePrediction
from rig.live_run import Again, Beside, Inline, live
from rig.observe import Ending, Observer, StepEvent, StepPhase
from rig.session import Request, run_scene

RATE, SAMPLES = 1000.0, 20
SPHERE = Parameters(Substrate("sphere", 60e-3), gas=Gas(initial_pressure=1000.0))
APEX, ZERO = 20e-3, 0.012
SPEED = 100e-6


def started(name: str, sample: int = 0) -> StepEvent:
    return StepEvent(StepPhase.STARTED, name, sample)


def specimen(work: float = 1.0, pressure: float = 1000.0) -> Parameters:
    film = SPHERE.membrane.work_of_adhesion
    return SPHERE.with_changes(work_of_adhesion=work * film, initial_pressure=pressure)


def glances(truth: Parameters, *, noise: float = 3e-4, seed: int = 1, shape: float = 0.0) -> list[tuple[str, Glance]]:
    """Frames of a test whose specimen is the model with other values, plus a smooth deviation if asked for."""
    found = predict(truth)
    start = found.position[0] + 150e-6
    random = np.random.default_rng(seed)
    plan: list[tuple[str, np.ndarray]] = [
        ("tare", np.full(50, 1e-3)),
        ("approach", np.linspace(1e-3, -5e-6, 400)),
        ("dwell", np.full(40, start)),
        ("retract", np.arange(start, found.detachment_position + 0.2e-3, SPEED * SAMPLES / RATE)),
    ]
    frames: list[tuple[str, Glance]] = []
    for name, heights in plan:
        for z in heights:
            touching = name in ("dwell", "retract") and z <= found.detachment_position
            force = float(np.interp(z, found.position, found.force)) if touching else 0.0
            force -= shape * np.sin(3e3 * z) if touching and name == "retract" else 0.0
            force += 4e-3 if name == "approach" and z < 0 else 0.0
            gas = float(np.interp(z, found.position, found.pressure)) if touching else 0.0
            number = len(frames)
            glance = Glance(
                number, number * SAMPLES, (number + 1) * SAMPLES, RATE,
                ZERO + force + noise * random.standard_normal(), gas + random.standard_normal(), APEX + z,
            )  # fmt: skip
            frames.append((name, glance))
    return frames


def gathered(frames: list[tuple[str, Glance]], part: float, distance: float, zero: float) -> Evidence:
    """Everything up to ``part`` of the way to pull-off."""
    gathering, step = Gathering(), ""
    for name, glance in frames:
        if name != step:
            step = name
            gathering.step(started(name, glance.start))
        gathering.add(glance)
        if step == "retract" and glance.position > zero + part * distance:
            break
    return gathering.evidence()


def announced(truth: Parameters, part: float, **options: float) -> LivePrediction:
    found = predict(truth)
    frames = glances(truth, **options)  # type: ignore[arg-type]
    predictor = LivePredictor(SPHERE, model="cone")
    predictor._estimator.mend = dataclasses.replace(predictor._estimator.mend)
    zero = APEX + found.zero_force_position
    result = None
    for step in sorted({min(part, 0.0), part / 2, part}):
        result = predictor.predict(gathered(frames, step, found.pull_off_distance, zero))
    assert result is not None
    return result


@pytest.fixture(autouse=True)
def cone_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """These specimens are cones: nothing is to be mended. One test below takes the mending back."""
    import rig.live_fit

    monkeypatch.setattr(rig.live_fit, "mend", lambda parameters: rig.live_fit.Mend(known=True))


def test_gathering_feels_the_touch_and_knows_p0_and_the_end() -> None:
    truth = specimen()
    frames = glances(truth, noise=1e-4)
    gathering, step = Gathering(), ""
    for name, glance in frames:
        if name != step:
            step = name
            gathering.step(started(name, glance.start))
        gathering.add(glance)
    evidence = gathering.evidence()
    assert evidence.force_zero == pytest.approx(ZERO, abs=5e-5)
    assert evidence.touch == pytest.approx(APEX, abs=5e-6)
    assert evidence.initial_pressure == pytest.approx(
        np.interp(evidence.start - APEX, predict(truth).position, predict(truth).pressure), abs=2.0
    )
    assert gathering.gone
    assert evidence.height[-1] == pytest.approx(APEX + predict(truth).detachment_position, abs=5e-6)
    assert (evidence.force_zero - evidence.force[-1]) > GONE * (evidence.force_zero - evidence.force).max()


@pytest.mark.parametrize("work", [0.75, 1.0, 1.35])
def test_the_effective_work_of_adhesion_is_learnt_from_the_frames(work: float) -> None:
    truth = specimen(work)
    found = predict(truth)
    early, late = announced(truth, -0.12), announced(truth, 0.6)
    said = late.work_of_adhesion
    assert said.low <= truth.membrane.work_of_adhesion <= said.high
    assert said.high - said.low < 0.8 * (early.work_of_adhesion.high - early.work_of_adhesion.low)
    assert late.pull_off_force.low <= found.pull_off_force <= late.pull_off_force.high
    assert late.pull_off_distance.low <= found.pull_off_distance <= late.pull_off_distance.high
    assert late.pull_off_distance.value == pytest.approx(found.pull_off_distance, rel=0.1)
    assert late.force_zero.low <= ZERO <= late.force_zero.high


def test_the_band_narrows_towards_pull_off() -> None:
    truth = specimen(1.2)
    widths = []
    for part in (0.0, 0.3, 0.6, 0.9):
        said = announced(truth, part)
        widths.append(said.pull_off_distance.high - said.pull_off_distance.low)
        assert np.all(said.force_low <= said.force + 1e-9)
        assert np.all(said.force_high >= said.force - 1e-9)
    assert widths[3] < widths[2] < widths[1] < 1.05 * widths[0]
    assert widths[3] < 0.5 * widths[0]


def test_p0_is_the_measured_one_not_the_scenes() -> None:
    low, high = (announced(specimen(pressure=pressure), 0.0) for pressure in (-500.0, 1500.0))
    assert low.pressure is not None
    assert high.pressure is not None
    for said, pressure in ((low, -500.0), (high, 1500.0)):
        true = predict(specimen(pressure=pressure))
        assert said.pull_off_force.value == pytest.approx(true.pull_off_force, rel=0.15)
        middle = 0.4 * true.pull_off_distance
        assert np.interp(middle, said.retraction, said.pressure) == pytest.approx(
            np.interp(middle, true.retraction, true.pressure), abs=60.0
        )


def test_data_that_leave_the_band_are_said_to() -> None:
    truth = specimen()
    found = predict(truth)
    zero = APEX + found.zero_force_position
    for lost, expected in ((0.0, True), (0.12, False)):
        frames = glances(truth, noise=1e-4)
        begin = zero + 0.3 * found.pull_off_distance
        frames = [
            (name, g._replace(force=g.force + lost if name == "retract" and g.position > begin else g.force))
            for name, g in frames
        ]
        predictor = LivePredictor(SPHERE)
        said = [
            predictor.predict(gathered(frames, part, found.pull_off_distance, zero))
            for part in (0.0, 0.06, 0.1, 0.14, 0.18, 0.22, 0.25, 0.28, 0.33, 0.36)
        ]
        assert all(prediction is not None for prediction in said)
        verdicts = [prediction.inside for prediction in said if prediction is not None]
        assert verdicts[7]
        assert all(verdicts[7:]) is expected
    last = said[-1]
    assert last is not None
    assert "F_r left the band at z_r" in last.note


def test_no_number_of_frames_makes_the_band_narrower_than_the_model_deserves() -> None:
    """Without a discrepancy the same data would claim more than ten times the certainty."""
    truth = specimen(1.1)
    found = predict(truth)
    evidence = gathered(glances(truth), 0.3, found.pull_off_distance, APEX + found.zero_force_position)
    widths = []
    for doubt in (Doubt(), Doubt(force_shape=1e-4, pressure_shape=1.0)):
        said = LivePredictor(SPHERE, doubt=doubt).predict(evidence)
        assert said is not None
        widths.append(said.work_of_adhesion.high - said.work_of_adhesion.low)
    assert widths[0] > 10 * widths[1]


def test_the_discrepancys_covariance_is_one() -> None:
    kernel = Kernel(Doubt(), 2e-3)
    height = np.sort(np.random.default_rng(3).uniform(0, 2e-3, 40))
    matrix = kernel(height, height)
    np.testing.assert_allclose(matrix, matrix.T)
    assert np.linalg.eigvalsh(matrix).min() > -1e-12


def test_the_exact_membrane_mends_the_cone_under_suction(monkeypatch: pytest.MonkeyPatch) -> None:
    """EML 2020 section 5: under suction the cone's distance is far too long; above it is not."""
    pressed = mend(SPHERE)
    drawn = mend(SPHERE.with_changes(initial_pressure=-4000.0))
    assert pressed.known
    assert drawn.known
    assert drawn.distance < 0.8
    assert 0.9 < pressed.distance < 1.15
    estimator = Estimator(SPHERE, Doubt(), 0.0, "cone")
    values = {"apex": APEX, "force_zero": 0.0, "stiffness": 0.0, "work": 0.0, "gas": -4000.0}
    plain = estimator.curves(values)
    estimator.mend = drawn
    mended = estimator.curves(values)
    onset = APEX + plain.prediction.onset_position
    assert (mended.end - onset) == pytest.approx(drawn.distance * (plain.end - onset), rel=1e-9)


def test_equal_evidence_gives_equal_predictions_and_replay_makes_them_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.live_run.UPDATES", 6)
    frames = glances(specimen(0.9), noise=1e-4)

    def play(maker: Inline | Again) -> list[tuple[int, str]]:
        told, step = [], ""
        for name, glance in frames:
            if name != step:
                step = name
                maker.step(started(name, glance.start))
            prediction = maker.frame(glance)
            if prediction is not None:
                told.append((glance.stop, dataclasses.replace(prediction, runtime_s=0.0).to_json()))
        return told

    first = play(Inline(SPHERE, 0.0))
    assert len(first) >= 6
    assert play(Inline(SPHERE, 0.0)) == first
    assert play(Again(SPHERE, 0.0, first)) == first
    later = [(sample + 3 * SAMPLES, text) for sample, text in first[::2]]  # as a slow process would have told them
    again = play(Again(SPHERE, 0.0, later))
    assert [sample for sample, _ in again] == [sample for sample, _ in later]
    assert [json.loads(text)["frame"] for _, text in again] == [json.loads(text)["frame"] for _, text in later]


def test_the_recorded_form_is_exact_and_small() -> None:
    said = announced(specimen(), 0.4)
    text = said.to_json()
    assert len(text) < 16_000
    assert LivePrediction.from_json(text).to_json() == text
    assert said.frame > 0
    assert set(said.numerical_error) >= {"pull_off_force", "pull_off_distance"}
    assert said.runtime_s > 0


def test_a_scene_without_pressure_has_no_pressure_curve() -> None:
    vented = Parameters(Substrate("sphere", 60e-3))
    found = predict(vented)
    frames = [(name, g._replace(pressure=float("nan"))) for name, g in glances(vented)]
    said = LivePredictor(vented).predict(
        gathered(frames, 0.3, found.pull_off_distance, APEX + found.zero_force_position)
    )
    assert said is not None
    assert said.pressure is None
    assert said.pull_off_distance.low <= found.pull_off_distance <= said.pull_off_distance.high


def test_a_scene_without_a_model_means_no_prediction_and_no_failure() -> None:
    nothing = Parameters(Substrate("sphere", None))
    evidence = gathered(glances(specimen()), 0.1, 2e-3, APEX)
    assert LivePredictor(nothing).predict(evidence) is None


def test_a_process_beside_the_run_predicts_and_dies_unharmful() -> None:
    frames = glances(specimen(), noise=1e-4)
    maker = Beside(SPHERE, 0.0)
    said: list[LivePrediction] = []
    step = ""
    retracting = 0
    for name, glance in frames:
        if name != step:
            step = name
            maker.step(started(name, glance.start))
        retracting += name == "retract"
        while not (prediction := maker.frame(glance)) and retracting == 100 and not said:
            time.sleep(0.01)  # the stage waits here until the process has begun and predicted
        if prediction is not None:
            said.append(prediction)
    assert said
    assert said[0].pull_off_force.value > 0
    maker._process.kill()
    maker._process.join()
    with contextlib.suppress(EOFError, ConnectionResetError):
        while maker._pipe.poll():
            maker._pipe.recv_bytes()
    with pytest.raises(ChildProcessError, match="the run goes on without"):  # the reporter drops it, loudly
        maker.frame(frames[-1][1])
    assert maker.lost


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGSTOP to freeze a process")
def test_the_loop_never_waits_for_a_frozen_process_beside_it() -> None:
    maker = Beside(SPHERE, 0.0)
    glance = glances(specimen())[0][1]
    maker.frame(glance)
    assert maker._process.pid is not None
    os.kill(maker._process.pid, signal.SIGSTOP)
    done = threading.Event()

    def feed() -> None:
        for _ in range(20_000):  # far more than a pipe holds
            maker.frame(glance)
        done.set()

    thread = threading.Thread(target=feed, daemon=True)
    thread.start()
    thread.join(200)
    assert done.is_set()
    maker.close()


def test_a_run_records_what_it_announced(request_for: Callable[..., Request]) -> None:
    from rig.recording import load_recording

    told: list[LivePrediction] = []

    class Witness(Observer):
        def prediction(self, prediction: LivePrediction) -> None:
            told.append(prediction)

    request = request_for("sphere-60mm-vented", live=True, observers=[Witness()])
    ending = run_scene(request)
    assert ending.exit_code == 0
    recorded = load_recording(request.out).predictions
    assert len(told) == len(recorded) > 10
    assert LivePrediction.from_json(bytes(recorded[-1]["json"]).decode()).frame == told[-1].frame


def test_the_observer_tells_and_closes() -> None:
    told: list[tuple[LivePrediction, str]] = []
    observer = live(SPHERE, lambda prediction, text: told.append((prediction, text)), virtual=True)
    observer.step(started("tare"))
    observer.finished(Ending("done", 0, 0))
    assert told == []
