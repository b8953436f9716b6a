"""Many runs with faults and parameters at random, in one process: no unexplained exit, no growth."""

from __future__ import annotations

import gc
import os
import random
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import psutil
import pytest
from fault_matrix import STEPS, request_of, troubles

from drivers.emulated.faults import Fault
from rig.recording import load_recording
from rig.session import run_scene

EXPLAINED = {0, 2, 3, 4, 6, 130}
WARM_UP = 40
"""Runs after which nothing may grow any more."""
DIRECT, WIRED = (int(os.environ.get(name, most)) for name, most in (("SOAK_DIRECT", 10_000), ("SOAK_WIRED", 500)))


def random_run(number: int, folder, *, wire: bool) -> None:
    """One run with a random scene and, three times out of four, a fault somewhere."""
    draw = random.Random(number)
    scripted = [trouble for trouble in troubles() if trouble.faults and bool(trouble.wire) is wire]
    trouble = draw.choice(scripted)
    request = request_of(folder / "soak.h5", trouble, draw.choice(STEPS))
    if draw.random() < 0.25:
        request.faults = None
    elif request.faults is not None:
        request.faults.add(Fault("force", "noise", at_sample=draw.randrange(60_000), value=draw.uniform(1, 3)))
    protocol = request.scene.protocol.model_copy(
        update={
            "preload_N": draw.uniform(0.05, 0.5),
            "approach_speed_um_s": draw.uniform(50, 100) if wire else draw.uniform(100, 250),
            "retract_speed_um_s": draw.uniform(100, 250),
            "initial_pressure_kPa": draw.uniform(-4, 4),
        }
    )
    request.scene = request.scene.model_copy(update={"protocol": protocol})
    if not wire:  # frames cannot come late there, so that the load cell allows a faster approach
        limits = request.bench.limits.model_copy(update={"lag_s": 0.15})
        request.bench = request.bench.model_copy(update={"limits": limits})
    request.seed = number
    ending = run_scene(request)
    assert ending.exit_code in EXPLAINED, (number, ending)
    if ending.exit_code:
        assert "Remedy" in ending.reason or ending.exit_code == 130
    assert load_recording(request.out).force.size == ending.samples
    request.out.unlink()


@dataclass(frozen=True)
class Usage:
    """What the process holds after so many runs."""

    runs: int
    memory_MB: float
    threads: int
    open_files: int


def usage(runs: int) -> Usage:
    gc.collect()
    process = psutil.Process()
    open_files = process.num_handles() if psutil.WINDOWS else process.num_fds()
    return Usage(runs, process.memory_info().rss / 1e6, threading.active_count(), open_files)


def soak(runs: int, folder, *, wire: bool) -> Iterator[Usage]:
    """Run so many; tell what the process holds after the warm-up, then twenty times."""
    warm = min(WARM_UP, runs // 2)
    for number in range(runs):
        random_run(number, folder, wire=wire)
        if number + 1 == warm or (number + 1 > warm and (runs - number - 1) % max(runs // 20, 1) == 0):
            yield usage(number + 1)


def check_growth(usages: Iterable[Usage]) -> None:
    first, *_, last = usages
    assert last.threads <= first.threads
    assert last.open_files <= first.open_files
    assert last.memory_MB < first.memory_MB + 50


def test_some_random_runs_leave_nothing_behind(tmp_path):
    check_growth(soak(6, tmp_path, wire=False))


@pytest.mark.soak
@pytest.mark.timeout(0)
def test_ten_thousand_random_runs(tmp_path):
    check_growth(soak(DIRECT, tmp_path, wire=False))


@pytest.mark.soak
@pytest.mark.timeout(0)
def test_five_hundred_random_runs_on_the_wire(tmp_path):
    check_growth(soak(WIRED, tmp_path, wire=True))
