"""Whole runs on the emulated bench."""

from __future__ import annotations

import dataclasses
import signal

import h5py
import numpy as np
import pytest

from drivers.emulated.direct import DirectDaq
from drivers.emulated.faults import Fault, Faults
from drivers.errors import NotConnected
from rig.bench import parse_bench
from rig.cli import main
from rig.emulation import truth
from rig.errors import FileError, Refused
from rig.measured import load_run
from rig.observe import Controls, Observer, StepPhase
from rig.recorder import Recorder
from rig.recording import load_recording
from rig.replay import Pace
from rig.replay_session import replay
from rig.session import run_scene


def raw(path):
    recording = load_recording(path)
    return recording.volts, recording.frames, recording.stage


def test_a_vented_scene_runs_to_its_end_and_detaches(request_for):
    request = request_for()
    ending = run_scene(request)
    assert ending.exit_code == 0, ending.reason
    run = load_run(request.out)
    assert [step.name for step in run.steps] == [
        "tare",
        "approach",
        "preload",
        "dwell",
        "retract",
        "pull-off",
        "return",
    ]
    assert run.pressure is None
    zero = run.force[: run.steps[0].stop].mean()
    assert run.force.max() - zero > 0.3
    assert run.force.min() - zero < -0.1
    assert abs(run.force[-200:].mean() - zero) < 0.02


def test_the_wire_and_the_direct_back_end_record_the_same(request_for, tmp_path):
    for wire, name in ((True, "wire.h5"), (False, "direct.h5")):
        assert run_scene(request_for(wire=wire, out=tmp_path / name)).exit_code == 0
    for ours, theirs in zip(raw(tmp_path / "wire.h5"), raw(tmp_path / "direct.h5"), strict=True):
        assert np.array_equal(ours, theirs)


def test_an_emulated_stage_that_was_left_on_starts_without_seeking_its_switch(request_for):
    request = request_for()
    text = request.bench_text.replace("start_mm = 22.0", "start_mm = 20.3\nleft_on = true")
    text = text.replace("reference_on_start = true", "reference_on_start = false")
    request = dataclasses.replace(request, bench=parse_bench(text, "bench.toml"), bench_text=text)
    assert run_scene(request).exit_code == 0
    assert load_run(request.out).height[0] == pytest.approx(20.3e-3, abs=1e-6)


def test_one_seed_is_one_run_and_another_is_another(request_for, tmp_path):
    for seed, name in ((1, "a.h5"), (1, "b.h5"), (2, "c.h5")):
        assert run_scene(request_for(seed=seed, out=tmp_path / name)).exit_code == 0
    first, again, other = (raw(tmp_path / name)[0] for name in ("a.h5", "b.h5", "c.h5"))
    assert np.array_equal(first, again)
    assert not np.array_equal(first[:, :500], other[:, :500])


def test_pressure_is_reached_in_closed_loop(request_for):
    request = request_for("sphere-60mm-low")
    ending = run_scene(request)
    assert ending.exit_code == 0, ending.reason
    run = load_run(request.out)
    start = run.step("retract").start
    assert run.pressure[start - 300 : start].mean() == pytest.approx(-3200.0, abs=50.0)


def test_replay_is_identical_to_the_bit(request_for):
    request = request_for("sphere-60mm-low")
    assert run_scene(request).exit_code == 0
    assert replay(load_recording(request.out), pace=Pace()).differences == ()


def test_replay_sees_a_changed_bit(request_for):
    request = request_for()
    run_scene(request)
    with h5py.File(request.out, "r+") as file:
        file["entry/data/force"][1234] += 1e-12
    assert replay(load_recording(request.out), pace=Pace()).differences


@pytest.mark.parametrize(
    "change", ["title.x=1", "membrane.thickness=1", "protocol.speed.x=1", "thickness_um=thin", "=1"]
)
def test_a_replay_with_a_value_that_is_none_of_the_scene_is_refused(change, request_for, capsys):
    request = request_for()
    run_scene(request)
    assert main(["replay", str(request.out), "--set", change]) == 2
    told = capsys.readouterr().err
    assert "Traceback" not in told
    assert change in told


def test_a_system_without_room_for_the_live_prediction_costs_no_test(request_for, monkeypatch):
    def refuse(*_, **__):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("rig.live_run.live", refuse)
    request = request_for("sphere-60mm-low", live=True)
    assert run_scene(request).exit_code == 0
    told = [row["text"] for row in load_recording(request.out).events if row["kind"] == b"warning"]
    assert any(b"no live prediction" in text for text in told)


class StopIn(Observer):
    """Asks for something when a step begins."""

    def __init__(self, controls, step, wish):
        self._controls, self._step, self._wish = controls, step, wish

    def step(self, event):
        if event.phase is StepPhase.STARTED and event.name == self._step:
            getattr(self._controls, self._wish)()


@pytest.mark.parametrize("wish", ["stop", "emergency_stop"])
def test_the_operator_can_end_any_run(request_for, wish):
    controls = Controls()
    request = request_for(controls=controls, observers=[StopIn(controls, "dwell", wish)])
    ending = run_scene(request)
    assert ending.exit_code == 130
    recording = load_recording(request.out)
    assert recording.step_table()[-1].name == "dwell"
    assert recording.force.size == ending.samples
    assert replay(recording, pace=Pace()).differences == ()


def test_ctrl_c_ends_the_run_in_good_order(request_for):
    class Press(Observer):
        def step(self, event):
            if event.phase is StepPhase.STARTED and event.name == "preload":
                signal.raise_signal(signal.SIGINT)

    ending = run_scene(request_for(observers=[Press()]))
    assert ending.exit_code == 130
    assert "preload" in ending.reason


def test_hold_keeps_recording_and_resume_goes_on(request_for):
    controls = Controls()

    class HoldAWhile(StopIn):
        frames = 0

        def frame(self, frame):
            self.frames += 1
            if self.frames == 400:
                controls.hold()
            if self.frames == 500:
                controls.resume()

    request = request_for(controls=controls, observers=[HoldAWhile(controls, "", "")])
    assert run_scene(request).exit_code == 0
    recording = load_recording(request.out)
    held = recording.height[402 * 20 : 498 * 20]
    assert np.ptp(held) < 5e-6
    assert [row["text"] for row in recording.events if row["kind"] == b"operator"] == [b"hold", b"resume"]
    assert replay(recording, pace=Pace()).differences == ()


def test_force_over_the_limit_stops_the_stage_and_keeps_the_recording(request_for):
    request = request_for(protocol={"preload_N": 0.5})
    limits = request.bench.limits.model_copy(update={"compression_N": 0.4})
    bench = request.bench.model_copy(update={"limits": limits})
    with pytest.raises(Refused, match="preload_N"):
        run_scene(dataclasses.replace(request, bench=bench))
    request = request_for(
        faults=Faults([Fault("force", "over_range", at_step="preload", after_samples=100, value=4.7)])
    )
    ending = run_scene(request)
    assert ending.exit_code == 3
    assert "Remedy" in ending.reason
    recording = load_recording(request.out)
    assert recording.force.size == ending.samples
    assert replay(recording, pace=Pace()).differences == ()


def test_a_stop_byte_that_cannot_be_sent_does_not_hide_the_limit_nor_lose_the_frame(request_for, monkeypatch):
    def unplugged(stage):
        raise NotConnected("stage", "the stop could not be sent", "check the cable")

    monkeypatch.setattr("drivers.emulated.direct.DirectStage.emergency_stop", unplugged)
    faults = Faults([Fault("force", "over_range", at_step="preload", after_samples=100, value=4.7)])
    request = request_for(faults=faults)
    ending = run_scene(request)
    assert ending.exit_code == 3
    assert "force +4.7" in ending.reason
    recording = load_recording(request.out)
    assert recording.force[-1] > request.bench.limits.compression_N
    told = [(row["kind"], row["text"]) for row in recording.events if row["kind"] in (b"fault", b"interlock")]
    assert [kind for kind, _ in told] == [b"fault", b"interlock"]
    assert b"the stop could not be sent" in told[0][1]


@pytest.mark.parametrize("device", ["stage", "pump"])
def test_the_samples_read_when_a_poll_fails_are_kept(request_for, monkeypatch, device):
    read = []

    def keeping(daq, samples, real=DirectDaq.read):
        read.append(real(daq, samples))
        return read[-1]

    monkeypatch.setattr(DirectDaq, "read", keeping)
    faults = Faults([Fault(device, "unplugged", at_step="approach", after_samples=500)])
    request = request_for("sphere-60mm-low", faults=faults, referenced=True)
    ending = run_scene(request)
    assert ending.exit_code == 6
    assert ending.reason.startswith(f"{device}: ")
    recording = load_recording(request.out)
    delivered = np.concatenate(read, axis=1)
    assert ending.samples == recording.force.size == delivered.shape[1]
    assert np.array_equal(recording.volts, delivered)
    assert replay(recording, pace=Pace()).differences == ()


def test_a_disk_that_fails_with_the_last_frame_does_not_hide_the_limit(request_for, monkeypatch):
    append = Recorder.append

    def failing(recorder, frame, *rest):
        append(recorder, frame, *rest)
        if frame.number < 0:
            raise FileError("the disk is full")

    monkeypatch.setattr(Recorder, "append", failing)
    request = request_for(faults=Faults([Fault("force", "over_range", at_step="preload", value=4.7)]))
    ending = run_scene(request)
    assert ending.exit_code == 3
    told = [row["text"] for row in load_recording(request.out).events if row["kind"] in (b"fault", b"interlock")]
    assert told[0] == b"the disk is full"


def test_a_limit_of_time_stops_the_stage_and_is_told_as_an_interlock(request_for, monkeypatch):
    pressed = []

    def press(stage):
        pressed.append(stage)

    monkeypatch.setattr("drivers.emulated.direct.DirectStage.emergency_stop", press)
    monkeypatch.setattr("rig.timebase.TimeBase.age", lambda *_: 9.0)
    request = request_for(referenced=True)
    ending = run_scene(request)
    assert (ending.exit_code, len(pressed)) == (3, 1)
    recording = load_recording(request.out)
    assert [row["kind"] for row in recording.events if b"late" in row["text"]] == [b"interlock", b"end"]


def test_a_run_that_needs_hands_asks_first_and_replays(request_for):
    request = request_for(hands="Bring the probe over center")
    assert run_scene(request).exit_code == 0
    recording = load_recording(request.out)
    assert [step.name for step in recording.step_table()][:3] == ["place", "tare", "approach"]
    asked = [row["text"].decode() for row in recording.events if row["kind"] == b"prompt"]
    assert asked[0] == "Bring the probe over center, then go on"
    assert replay(recording, pace=Pace()).differences == ()


def test_a_pressure_that_does_not_follow_the_pump_ends_the_run_after_one_stroke(request_for, monkeypatch):
    def vented(scene, seed):
        world = truth(scene, seed)
        return dataclasses.replace(world, chamber=dataclasses.replace(world.chamber, vented=True))

    monkeypatch.setattr("rig.emulation.truth", vented)
    request = request_for("sphere-60mm-low")
    ending = run_scene(request)
    assert ending.exit_code == 4
    assert "stroke should make -3.2" in ending.reason
    assert "close the vent" in ending.reason
    strokes = [row for row in load_recording(request.out).events if b"dispense" in row["text"]]
    assert len(strokes) == 1


def test_an_observer_that_fails_harms_nothing(request_for):
    class Broken(Observer):
        def frame(self, frame):
            raise RuntimeError("painting failed")

    request = request_for(observers=[Broken()])
    assert run_scene(request).exit_code == 0
    warnings = [row["text"] for row in load_recording(request.out).events if row["kind"] == b"warning"]
    assert len(warnings) == 1
    assert b"painting failed" in warnings[0]


def test_a_recording_is_never_overwritten(request_for):
    request = request_for()
    request.out.write_bytes(b"precious")
    with pytest.raises(FileError, match="--out"):
        run_scene(request)
    assert request.out.read_bytes() == b"precious"
