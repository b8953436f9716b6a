"""What an operator may get wrong, and what a sensor may do, without harm to specimen and load cell."""

from __future__ import annotations

import dataclasses

import pytest
from test_check import bench_with, said

from rig import emulation
from rig.observe import Observer
from rig.session import run_scene


class Truth(Observer):
    """Keeps the extremes of the plant's true force (N) and pressure (Pa), and its lowest height (m)."""

    def __init__(self):
        self.world = None
        self.least = self.most = self.least_pressure = 0.0
        self.lowest = 1.0

    def frame(self, frame):
        state = self.world.plant.state
        self.least, self.most = min(self.least, state.force), max(self.most, state.force)
        self.least_pressure = min(self.least_pressure, state.pressure)
        self.lowest = min(self.lowest, self.world.plant.axis.position)


@pytest.fixture
def truth(monkeypatch):
    seen, make = Truth(), emulation.emulated_bench

    def made(request):
        seen.world = make(request)
        return seen.world

    monkeypatch.setattr(emulation, "emulated_bench", made)
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
