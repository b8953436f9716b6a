"""``kill -9`` of the program while the instruments live on in another process."""

from __future__ import annotations

import random

import pytest
from dead_man import Halt, kill_in

from rig.bench import load_bench
from rig.recording import load_recording

LONGEST = {"approach": 1.2, "preload": 3.0, "pressurize": 4.0, "retract": 4.0}
"""Seconds into a step at which the kill may come: the step lasts at least about so long."""

SERVO_LAG = 2e-6
LARGEST_TARGET = 0.5e-6
"""m^3; the scene's pressure takes less than this of the syringe."""


def check(halt: Halt) -> None:
    limits = load_bench(None)[0].limits
    assert halt.at_rest
    assert halt.overrun <= limits.look_ahead_um * 1e-6 + SERVO_LAG
    assert halt.pumped <= LARGEST_TARGET
    assert halt.largest_force < limits.compression_N
    recording = load_recording(halt.recording)
    assert recording.ending == ("the program died; recovered", -9)
    assert recording.step_table()[-1].name == halt.step


@pytest.mark.parametrize(("step", "delay"), [("preload", 0.6), ("pressurize", 2.2)])
def test_stage_and_pump_stop_by_themselves(step, delay, tmp_path):
    halt = kill_in(step, delay, tmp_path)
    check(halt)
    assert abs(halt.rate) > 1e-6 or halt.pumped > 1e-11  # something was moving when the program died


@pytest.mark.soak
@pytest.mark.timeout(120)
@pytest.mark.parametrize("trial", range(60))
def test_a_kill_at_any_moment_crushes_nothing(trial, tmp_path):
    draw = random.Random(trial)
    step = draw.choice(sorted(LONGEST))
    check(kill_in(step, draw.uniform(0, LONGEST[step]), tmp_path, seed=trial))
