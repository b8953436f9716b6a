"""The way to the starting height: never far ahead, no faster than the bench can stop, and not through anything."""

from __future__ import annotations

import dataclasses

import pytest

import rig.emulation
from drivers.emulated.chamber import Chamber
from drivers.emulated.direct import DirectStage
from drivers.emulated.specimens import RigidStop
from drivers.emulated.truth import Train, Truth
from rig.bench import OVERLOAD, load_bench, parse_bench
from rig.check import parking
from rig.errors import FileError
from rig.observe import Controls, Observer
from rig.session import reference_only, run_scene
from sequences.errors import StepFailed


def on(request, *changes):
    """Return the request on the emulated bench with these changes of its text."""
    text = request.bench_text
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return dataclasses.replace(request, bench=parse_bench(text, "bench"), bench_text=text)


@pytest.fixture
def ways(monkeypatch):
    """Distances from the last polled position to every target, m."""
    seen, move = [], DirectStage.move_to

    def moved(stage, position):
        seen.append(abs(stage.status().position - position))
        move(stage, position)

    monkeypatch.setattr(DirectStage, "move_to", moved)
    return seen


def test_no_command_goes_further_than_the_look_ahead_even_from_outside_the_travel(request_for, ways):
    request = on(request_for(), ("maximum_mm = 51.5", "maximum_mm = 22.5"))
    assert run_scene(request).exit_code == 0
    assert max(ways) <= 50.1e-6


@pytest.mark.parametrize(
    "change", [("look_ahead_um = 50.0", "look_ahead_um = 4.0"), ("frame_ms = 20.0", "frame_ms = 250.0")]
)
def test_a_bench_of_short_look_ahead_or_long_frames_parks_all_the_same(request_for, change):
    assert reference_only(on(request_for(), change)) == pytest.approx(22e-3, abs=3e-6)


@pytest.mark.parametrize("start", [0.5, 60.0])
def test_a_start_outside_the_limits_is_refused(start):
    text = load_bench(None)[1].replace("start_mm = 22.0", f"start_mm = {start}")
    with pytest.raises(FileError, match=f"start_mm = {start:g} must lie within minimum_mm = 1 and maximum_mm = 51.5"):
        parse_bench(text, "bench")


def test_a_start_beyond_the_real_travel_is_refused_before_anything_moves(request_for, ways):
    request = on(request_for(), ("maximum_mm = 51.5", "maximum_mm = 60.0"), ("start_mm = 22.0", "start_mm = 55.0"))
    with pytest.raises(StepFailed, match=r"start_mm = 55 lies outside the stage's travel of 1 to 52 mm"):
        reference_only(request)
    assert not ways


@pytest.mark.parametrize(
    ("bench", "stiff"),
    [("emulated", ()), ("emulated-gso25", (("compliance_um_per_N = 830.0", "compliance_um_per_N = 12.0"),))],
)
def test_what_is_in_the_way_ends_the_parking_and_survives(request_for, monkeypatch, bench, stiff):
    world = Truth(RigidStop(), Chamber(vented=True), Train(contact_position=49.5e-3, start_position=50e-3))
    forces, make = [], rig.emulation.emulated_bench

    def emulated(request):
        made = make(request)
        advance = made.plant.advance

        def advanced(samples, rate):
            signals = advance(samples, rate)
            forces.extend(signals["force"][-1:])
            return signals

        made.plant.advance = advanced
        return made

    monkeypatch.setattr(rig.emulation, "truth", lambda scene, seed: world)
    monkeypatch.setattr(rig.emulation, "emulated_bench", emulated)
    text = load_bench(bench)[1]
    request = dataclasses.replace(request_for(), bench_text=text)
    request = on(request, ("start_mm = 22.0", "start_mm = 48.0"), *stiff)
    with pytest.raises(StepFailed, match=r"something is in the way at 49\..* mm"):
        reference_only(request)
    assert 0.1 < max(forces) / request.bench.force.capacity_N < OVERLOAD


def test_a_reference_move_is_taken_up_again_after_a_hold(request_for):
    controls = Controls()

    class Hold(Observer):
        frames = 0

        def frame(self, frame):
            self.frames += 1
            if self.frames == 50:
                controls.hold()
            if self.frames == 8000:
                controls.resume()

    request = on(request_for(controls=controls), ("start_mm = 22.0", "start_mm = 51.0"))
    hold = Hold()
    with pytest.MonkeyPatch.context() as patch:
        make = rig.session.open_instruments

        def opened(request):
            devices = make(request)
            devices.observers.append(hold)
            return devices

        patch.setattr("rig.session.open_instruments", opened)
        assert reference_only(request) == pytest.approx(51e-3, abs=3e-6)
    assert hold.frames > 8000


def test_the_speed_follows_from_cell_compliance_and_frame():
    bench, _ = load_bench(None)
    usual = parking(bench)
    assert usual.speed == 500e-6
    stiff = bench.model_copy(update={"force": bench.force.model_copy(update={"compliance_um_per_N": 1.0})})
    careful = parking(stiff)
    room = 1.1 * bench.force.capacity_N * 1e-6
    assert careful.speed == pytest.approx(room / 0.07)
