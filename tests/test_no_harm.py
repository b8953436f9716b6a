"""What an operator may get wrong, and what a sensor may do, without harm to specimen and load cell."""

from __future__ import annotations

import dataclasses

import pytest
from test_check import bench_with, refused_bench, said

from drivers.emulated.direct import DirectDaq, DirectStage
from drivers.emulated.faults import Fault, Faults
from rig import emulation
from rig.errors import FileError
from rig.observe import Observer, StepPhase
from rig.recording import load_recording
from rig.session import run_scene


class Truth(Observer):
    """Keeps the extremes of the plant's true force (N) and its lowest height (m)."""

    def __init__(self):
        self.world = None
        self.least = self.most = 0.0
        self.lowest = 1.0

    def frame(self, frame):
        state = self.world.plant.state
        self.least, self.most = min(self.least, state.force), max(self.most, state.force)
        self.lowest = min(self.lowest, self.world.plant.axis.position)


@pytest.fixture
def truth(tell_bench):
    seen = Truth()
    tell_bench(lambda bench: setattr(seen, "world", bench))
    return seen


def run(request, truth, bench=None):
    request = dataclasses.replace(request, observers=[truth], bench=bench or request.bench)
    return run_scene(request)


@pytest.mark.parametrize("contact", [151.0, 1000.0])
def test_a_contact_force_that_is_no_small_part_of_the_preload_is_refused(contact):
    bench = bench_with()
    told = said(bench, "sphere-60mm-vented", preload_N=0.3, contact_force_mN=contact)
    assert f"contact_force_mN = {contact:g} is more than half of preload_N = 0.3" in told
    assert not said(bench, "sphere-60mm-vented", preload_N=0.3, contact_force_mN=150.0)


WRONG_SIGN = ('readout = "amplified"', 'readout = "amplified"\ncompression_positive = false')


def test_a_force_of_the_wrong_sign_ends_the_run_at_the_preload(request_for, truth):
    ending = run(request_for(protocol={"preload_N": 0.3}), truth, bench_with(WRONG_SIGN))
    assert ending.exit_code == 4
    assert "compression_positive" in ending.reason
    assert truth.most < 0.5


def test_the_approach_is_slow_enough_for_a_force_of_either_sign():
    bench = bench_with(("compression_N = 4.4", "compression_N = 2.0"), ("tension_N = 4.4", "tension_N = 5.4"))
    bench = bench.model_copy(update={"daq": bench.daq.model_copy(update={"frame_ms": 60.0})})
    told = said(bench, "sphere-60mm-vented", approach_speed_um_s=60.0)
    assert "approach_speed_um_s = 60 can overload the load cell" in told


def left_at(height):
    """Return the change of a bench whose stage was left at a height, mm."""
    return ("start_mm = 22.0", f"start_mm = {height}\nleft_on = true")


def resting_at(force):
    """Return the change of a bench whose load cell reads so much more, N."""
    return ("intercept = 0.0", f"intercept = {force}")


def stated(force):
    """Return the change of a bench that says what its load cell reads at rest, N."""
    return ('readout = "amplified"', f'readout = "amplified"\nat_rest_N = {force}')


def test_a_tare_in_contact_is_refused_where_the_stage_is(request_for, truth):
    ending = run(request_for(), truth, bench_with(left_at(18.8)))
    pressed = truth.most
    assert pressed > 0.2
    assert ending.exit_code == 4
    assert "step tare: the force at rest is +3." in ending.reason
    assert "drive the stage clear" in ending.reason
    assert truth.lowest == pytest.approx(18.8e-3, abs=1e-6)


@pytest.mark.parametrize("rest", [3.6, 0.5, -0.5])
def test_a_force_at_rest_that_nobody_has_stated_is_refused(request_for, truth, rest):
    ending = run(request_for(), truth, bench_with(resting_at(rest)))
    assert ending.exit_code == 4
    assert f"the force at rest is {rest + 0.019:+.3f}" in ending.reason
    assert "at_rest_N" in ending.reason
    assert truth.most < 0.01


@pytest.mark.parametrize("rest", [0.5, -0.5])
def test_a_stated_force_at_rest_is_tared_away(request_for, truth, rest):
    ending = run(request_for(), truth, bench_with(resting_at(rest), stated(rest)))
    assert ending.exit_code == 0, ending.reason
    assert 0.29 < truth.most < 0.4


def test_the_force_at_rest_counts_among_what_the_cell_carries():
    assert "at most 1.93 N" in said(bench_with(stated(1.5)), "sphere-60mm-vented", preload_N=2.0)
    assert not said(bench_with(stated(-1.5)), "sphere-60mm-vented", preload_N=1.7, approach_speed_um_s=50.0)
    assert "look_ahead_um = 50" in said(bench_with(stated(1.5)), "sphere-60mm-vented", preload_N=1.0)
    assert "the tension limit is 2.9 N" in said(bench_with(stated(-1.5)), "soft-flat")


def test_a_tare_of_a_stage_that_moves_is_refused(request_for, truth, monkeypatch):
    real = DirectStage.status
    monkeypatch.setattr(DirectStage, "status", lambda stage: dataclasses.replace(real(stage), moving=True))
    ending = run(request_for(referenced=True), truth)
    assert ending.exit_code == 4
    assert "step tare: the stage is moving" in ending.reason


def test_a_force_that_does_not_scatter_is_refused(request_for, truth, monkeypatch):
    real = DirectDaq.read

    def frozen(daq, samples):
        volts = real(daq, samples)
        volts[0] = 0.0
        return volts

    monkeypatch.setattr(DirectDaq, "read", frozen)
    ending = run(request_for(), truth)
    assert ending.exit_code == 4
    assert "step tare: the force does not scatter" in ending.reason
    assert truth.most < 0.01


def test_a_chamber_smaller_than_said_is_not_pumped_far_beyond_its_pressure(request_for, truth, monkeypatch):
    make = emulation.truth

    def tenth(scene, seed):
        world = make(scene, seed)
        return dataclasses.replace(world, chamber=dataclasses.replace(world.chamber, volume=world.chamber.volume / 10))

    monkeypatch.setattr(emulation, "truth", tenth)
    request = request_for("sphere-60mm-low")  # -3.2 kPa; the preload has made +2.2 kPa
    ending = run(request, truth)
    assert ending.exit_code == 4
    assert "chamber_volume_ml = 7.2" in ending.reason
    assert load_recording(request.out).pressure.min() > -6.5e3
    assert truth.least > -2.0


def test_a_dead_load_cell_ends_the_approach_where_contact_should_have_been(request_for, truth):
    dead = Faults([Fault("force", "over_range", value=0.0)])  # noise there is, force not
    ending = run(request_for(faults=dead), truth)
    assert ending.exit_code == 4
    assert "no contact down to 18.500 mm" in ending.reason
    assert "press the load cell by hand" in ending.reason
    assert "minimum_mm" not in ending.reason
    assert truth.lowest > 18.49e-3


def test_an_approach_that_begins_too_low_ends_there(request_for, truth):
    with pytest.raises(FileError, match="lowest_contact_mm = 23 must lie within"):
        bench_with(("lowest_contact_mm = 18.5", "lowest_contact_mm = 23.0"))
    ending = run(request_for(), truth, bench_with(("lowest_contact_mm = 18.5", "lowest_contact_mm = 21.5")))
    assert "no contact down to 21.500 mm" in ending.reason
    assert truth.lowest > 21.49e-3


@pytest.mark.parametrize("step", ["approach", "preload", "retract", "pull-off"])
def test_no_step_waits_for_ever_for_a_stage_that_does_not_go(request_for, truth, monkeypatch, step):
    class Stubborn(Observer):
        def step(self, event):
            if event.name == step and event.phase is StepPhase.STARTED:
                truth.world.plant.axis.halt(float("inf"))
                monkeypatch.setattr(DirectStage, "move_to", lambda stage, height: None)

    request = request_for(protocol={"retract_speed_um_s": 200.0, "approach_speed_um_s": 100.0})
    request = dataclasses.replace(request, observers=[truth, Stubborn()])
    ending = run_scene(dataclasses.replace(request, bench=bench_with(("minimum_mm = 1.0", "minimum_mm = 18.0"))))
    assert ending.exit_code == 4
    assert f"step {step}: the stage does not arrive" in ending.reason


def test_a_compliance_in_the_wrong_unit_is_refused():
    told = refused_bench(("compliance_um_per_N = 12.0", "compliance_um_per_N = 12000.0"))
    assert "compliance_um_per_N = 12000: the cell would give by 58.8 mm" in told
