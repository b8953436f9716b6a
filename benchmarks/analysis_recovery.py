"""Recovery of the emulated world's truth by the analysis: bias and coverage over N random pull-off tests (default 200).

The truth is the plant's own state at every knot of its grid: height of the contact and force at the load cell (the
load train relaxes under compression), without noise, drift, gain and quantisation. Detachment is where half of the
force of five milliseconds before is lost. The bench is given the plant's compliance.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pandas as pd

from analysis import analyze
from analysis.batch import on_all_cores
from analysis.coverage import summary
from drivers.emulated.plant import Plant
from rig.bench import load_bench
from rig.emulation import emulated_bench
from rig.observe import Watcher
from rig.recording import load_run
from rig.scene import parse_scene
from rig.session import Request, run_scene
from sequences.frame import Frame

SCENE = """
[substrate]
shape = "{shape}"
{diameter}
[protocol]
name = "pull_off"
initial_pressure_kPa = {pressure:.3f}
preload_N = {preload:.3f}
retract_speed_um_s = {speed:.1f}
preload_dwell_s = 5.0
"""


@dataclass
class TruthWatcher(Watcher):
    """Keeps every knot of the plant: time, force at the load cell, separation, pressure."""

    plants: list[Plant] = field(default_factory=list)
    rows: list[tuple[float, float, float, float]] = field(default_factory=list)
    offset: float = np.nan

    def frame(self, frame: Frame) -> None:
        """Note when the record began, in the plant's time."""
        if np.isnan(self.offset):
            self.offset = self.plants[0].time - frame.stop / frame.rate

    def keep(self, plant: Plant) -> None:
        """Copy the knots not yet seen."""
        relaxing = plant.truth.train.relaxing
        last = self.rows[-1][0] if self.rows else -1.0
        for knot in plant._knots:
            if last < knot.time <= plant.time:
                force = knot.state.force - relaxing * knot.relaxed
                self.rows.append((knot.time, force, knot.state.height, knot.state.pressure))


def one(seed: int) -> dict[str, list[float]]:
    """Run, analyse and compare one random test."""
    draw = np.random.default_rng([seed, 77])
    diameter = float(draw.choice([15.0, 30.0, 60.0, 0.0]))
    text = SCENE.format(
        shape="sphere" if diameter else "flat",
        diameter=f"diameter_mm = {diameter}" if diameter else "",
        pressure=draw.uniform(-0.7, 1.5),
        preload=draw.uniform(0.4, 1.0),
        speed=draw.choice([20.0, 50.0]),
    )
    watcher = TruthWatcher()

    def noted(request: Request) -> object:
        bench = emulated_bench(request)
        watcher.plants.append(bench.plant)
        return bench

    def remembered(plant: Plant) -> None:
        watcher.keep(plant)
        forget(plant)

    forget = Plant._forget
    bench, bench_text = load_bench(None)
    with (
        tempfile.TemporaryDirectory() as folder,
        patch("rig.emulation.emulated_bench", noted),
        patch.object(Plant, "_forget", remembered),
    ):
        out = Path(folder) / "run.h5"
        scene = parse_scene(text, "recovery")
        run_scene(Request(scene, text, bench, bench_text, out, seed, wire=False, live=False, observers=[watcher]))
        run = load_run(out)
        compliance = 1 / watcher.plants[0].truth.train.stiffness
        run = replace(run, sensors=replace(run.sensors, compliance=compliance))
        features = analyze(run).features
    truth = true_features(np.array(watcher.rows), watcher.offset + run.step("retract").start / run.rate)
    return {name: [(features.value(name) - true) / features.uncertainty(name)] for name, true in truth.items()}


def true_features(rows: np.ndarray, start: float) -> dict[str, float]:
    """Read the features off the true trace; ``start`` is the beginning of the retraction, s."""
    time_, force, height, pressure = rows.T
    loading, pulling = rows[time_ < start], rows[time_ >= start]
    force, height, pressure = pulling[:, 1], pulling[:, 2], pulling[:, 3]
    lowest = int(np.argmin(force))
    last = int(np.flatnonzero(force < 0.02 * force[lowest])[-1])
    shortly_before = float(np.interp(pulling[last, 0] - 5e-3, pulling[:, 0], force))
    attached = int(np.flatnonzero(force < 0.5 * shortly_before)[-1])
    compressed = np.flatnonzero(force[: lowest + 1] > 0)
    first = int(compressed[-1]) if compressed.size else 0
    zero = float(np.interp(0, -force[first : first + 2], height[first : first + 2])) if compressed.size else height[0]
    part = slice(first + 1 if compressed.size else 0, attached + 1)
    return {
        "pull_off_force_N": -float(force[lowest]),
        "pull_off_distance_m": float(height[attached] - zero),
        "preload_N": float(loading[:, 1].max()),
        "initial_pressure_Pa": float(pressure[0]),
        "adhesion_energy_J": -float(np.trapezoid(force[part], height[part])),
    }


def main(count: int) -> None:
    """Print the table."""
    begin = time.perf_counter()
    found: dict[str, list[float]] = {}
    for outcome in on_all_cores(one, range(count)):
        for name, scores in outcome.items():
            found.setdefault(name, []).extend(scores)
    with pd.option_context("display.width", 160):
        print(f"{count} emulated pull-off tests, {time.perf_counter() - begin:.0f} s")
        print(summary(found).to_string(index=False))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
