"""From the sample that passes the limit to the stop byte at the stage's controller."""

from __future__ import annotations

import time
import tomllib
from pathlib import Path

import numpy as np
from conftest import scene_text
from dead_man import PROTOCOL, bench_file, emulators

from rig.bench import load_bench
from rig.observe import Ending, Observer, StepPhase
from rig.scene import Scene
from rig.session import Request, run_scene

AHEAD = 120
"""Samples between the command and the trip, so that it comes in the middle of a run that has settled."""


class _Trip(Observer):
    """Asks for the trip some frames into the approach."""

    def __init__(self, command, ahead: int) -> None:
        self._command, self._ahead = command, ahead
        self._asked = False
        self._approaching = False

    def step(self, event) -> None:
        self._approaching |= event.phase is StepPhase.STARTED and event.name == "approach"

    def frame(self, frame) -> None:
        if self._approaching and not self._asked:
            self._asked = True
            self._command(f"trip {self._ahead}")


def measure(folder: Path, frame_ms: float, trials: int, seed: int = 0) -> tuple[np.ndarray, list[Ending]]:
    """Trip the force interlock so many times; return the latencies, s, and how the runs ended."""
    draw = np.random.default_rng(seed)
    text = scene_text("sphere-60mm-vented", **{**PROTOCOL, "tare_s": 0.3, "approach_speed_um_s": 20.0})
    endings: list[Ending] = []
    tripped: list[tuple[float, float]] = []
    with emulators("--vented", "--seed", str(seed)) as (ends, command, finish):
        bench, bench_text = load_bench(bench_file(folder, {**ends, "pump": "COM99"}, frame_ms=frame_ms))
        limits = bench.limits.model_copy(update={"lag_s": 2.0})  # the computer may be loaded on purpose
        bench = bench.model_copy(update={"limits": limits})
        for trial in range(trials):
            request = Request(
                Scene.model_validate(tomllib.loads(text)), text, bench, bench_text, folder / f"{trial}.h5"
            )
            request.live = False
            request.observers = [_Trip(command, AHEAD + int(draw.integers(100)))]
            began = time.monotonic()
            endings.append(run_scene(request))
            if "force" in endings[-1].reason:  # a computer too busy for real time ends a run for that
                tripped.append((began, time.monotonic()))
            command("clear")
        told = finish()
    log = np.array(told["log"])
    moments = np.array([_moment(log, trip) for trip in told["trips"]])
    stops = [stop for stop in told["stops"] if any(began < stop < ended for began, ended in tripped)]
    return np.array([stop - moments[moments <= stop].max() for stop in stops]), endings


def _moment(log: np.ndarray, sample: int) -> float:
    """When a sample was there: the plant makes them in blocks, of which the last is the present one."""
    row = log[np.searchsorted(log[:, 1], sample)]
    return float(row[0] - (row[1] - sample) * 1e-3)
