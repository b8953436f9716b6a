"""A hold lasts as long as it likes: whatever step it meets takes up its work afterwards, and no time-out has run."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import SHORT, scene_text

from rig.bench import parse_bench
from rig.library import find
from rig.observe import Controls, Observer, StepPhase
from rig.recording import load_recording
from rig.replay import Pace
from rig.replay_session import replay
from rig.scene import parse_scene
from rig.session import Request, run_scene

LONG = 25_000
"""Samples; longer than any deadline of the steps held here."""
QUICK = {"preload_dwell_s": 0.5, "tare_s": 0.5}


class Holder(Observer):
    """Holds every step once, so many samples after its beginning, and resumes."""

    def __init__(self, controls, length, delay):
        self._controls, self._length, self._delay = controls, length, delay
        self._hold_at = self._resume_at = None
        self.held = []
        self._name = ""

    def step(self, event):
        if event.phase is StepPhase.STARTED:
            self._name, self._hold_at = event.name, event.sample + self._delay

    def frame(self, frame):
        if self._resume_at is not None and frame.stop >= self._resume_at:
            self._resume_at = None
            self._controls.resume()
        elif self._resume_at is None and self._hold_at is not None and frame.stop >= self._hold_at:
            self._hold_at, self._resume_at = None, frame.stop + self._length
            self.held.append(self._name)
            self._controls.hold()


@pytest.fixture
def held_run(tmp_path):
    """Return a function that runs a shipped scene with a hold in every step; it gives the recording and the holds."""

    def go(name, *, bench="emulated", length=LONG, delay=150, **protocol):
        text = scene_text(name, **protocol)
        bench_text = find("bench", bench)[0]
        controls = Controls()
        holder = Holder(controls, length, delay)
        request = Request(
            parse_scene(text, name), text, parse_bench(bench_text, bench), bench_text, tmp_path / "run.h5",
            wire=False, live=False, referenced=True, observers=[holder], controls=controls,
        )  # fmt: skip
        ending = run_scene(request)
        assert ending.exit_code == 0, ending.reason
        recording = load_recording(request.out)
        assert replay(recording, pace=Pace()).differences == ()
        return recording, holder.held

    return go


@pytest.mark.parametrize(
    ("name", "bench", "delay", "protocol"),
    [
        ("sphere-60mm-low", "emulated", 150, {**SHORT, **QUICK}),
        ("indentation", "emulated", 150, QUICK),
        ("fiber", "emulated-gso25", 150, QUICK),
        ("leak", "emulated", 1800, {"hold_s": 2.0}),
        ("volume", "emulated", 150, {"settle_s": 1.0, "strokes_ml": [-0.1, 0.2]}),
    ],
)
def test_every_step_outlasts_a_hold(held_run, name, bench, delay, protocol):
    recording, held = held_run(name, bench=bench, delay=delay, **protocol)
    assert held == [step.name for step in recording.step_table() if step.name != "close"]


@pytest.mark.parametrize("length", [20, 2000, LONG])
def test_a_stroke_is_moved_as_a_whole_whatever_hold_has_stopped_it(held_run, length):
    strokes = [-0.1, 0.2]
    recording, held = held_run("volume", length=length, delay=400, settle_s=1.0, strokes_ml=strokes)
    assert {"stroke 1", "stroke 2"} <= set(held)
    moved = [recording.pump["volume_m3"][recording.pump["sample"] < s.stop][-1] for s in recording.step_table()]
    assert np.diff(moved)[-2:] * 1e6 == pytest.approx(strokes, rel=2e-3)


def test_what_is_held_is_no_part_of_a_rest(held_run):
    recording, _ = held_run("sphere-60mm-vented", length=3000, **{**SHORT, **QUICK})
    dwell = next(step for step in recording.step_table() if step.name == "dwell")
    assert dwell.stop - dwell.start >= 3000 + 500
