"""Recovery of the emulated world's truth: bias and coverage of the stated uncertainties over N random tests of a kind.

    python benchmarks/analysis_recovery.py [pull_off|indentation|volume ...] [--tests 200] [--jobs 2]

Every test has its own substrate, membrane, pressure, preload and speed, and instruments whose errors are drawn from
the uncertainties that the bench states for them. The truth is the plant's own state at every knot of its grid: force
at the load cell (the load train relaxes under compression) and height of the gripper's rim, without noise, drift,
gain and quantisation. Scenes are short: the stage starts close to the sample and retracts at 50 or 100 um/s after 2 to
8 s in contact (JKR tests: 20 or 50 um/s); every third pull-off test retracts at the papers' 10 um/s after their 30 s.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pandas as pd

from analysis import Run, analyze
from analysis.batch import on_all_cores
from analysis.coverage import summary
from analysis.numerics import Array
from analysis.retraction import RUN_AWAY
from drivers.emulated.bench import EmulatedBench
from drivers.emulated.chamber import ATMOSPHERE
from drivers.emulated.electronics import Cell, Device, PressureSensor, usb_6211
from drivers.emulated.indentation import Indentation
from drivers.emulated.plant import Plant
from drivers.emulated.truth import Truth
from model.jkr import work_of_adhesion_jkr
from rig.bench import Bench, load_bench, parse_bench
from rig.emulation import truth as emulated_truth
from rig.measured import load_run, sensors
from rig.observe import Observer
from rig.scene import Scene, parse_scene
from rig.session import Request, run_scene
from sequences.frame import Frame

Random = np.random.Generator

START_MM = 20.4

PULL_OFF = """
[substrate]
shape = "{shape}"
{diameter}
[gripper]
chamber_volume_ml = {volume:.4f}
[protocol]
name = "pull_off"
initial_pressure_kPa = {pressure:.3f}
preload_N = {preload:.3f}
retract_speed_um_s = {speed:.1f}
preload_dwell_s = {dwell:.1f}
"""

INDENTATION = """
[substrate]
shape = "flat"
[protocol]
name = "indentation"
preload_N = {preload:.4f}
retract_speed_um_s = {speed:.1f}
preload_dwell_s = {dwell:.1f}
positions = ["center"]
"""

VOLUME = """
[substrate]
shape = "flat"
[gripper]
chamber_volume_ml = {volume:.4f}
[protocol]
name = "volume"
"""


def pull_off_scene(draw: Random) -> str:
    """Return a pull-off test of the rigid gripper."""
    diameter = float(draw.choice([15.0, 30.0, 60.0, 0.0]))
    speed = float(draw.choice([10.0, 50.0, 100.0]))
    return PULL_OFF.format(
        shape="sphere" if diameter else "flat",
        diameter=f"diameter_mm = {diameter}" if diameter else "",
        volume=draw.uniform(5.0, 10.0),
        pressure=draw.uniform(-2.5, 2.0),
        preload=draw.uniform(0.4, 1.0),
        speed=speed,
        dwell=30.0 if speed == 10.0 else draw.uniform(2.0, 8.0),
    )


def indentation_scene(draw: Random) -> str:
    """Return a JKR test at one position."""
    return INDENTATION.format(
        preload=draw.uniform(0.05, 0.2), speed=draw.choice([20.0, 50.0]), dwell=draw.uniform(2.0, 8.0)
    )


def volume_scene(draw: Random) -> str:
    """Return a measurement of V_0."""
    return VOLUME.format(volume=draw.uniform(5.0, 10.0))


SCENES: dict[str, Callable[[Random], str]] = {
    "pull_off": pull_off_scene,
    "indentation": indentation_scene,
    "volume": volume_scene,
}


def world(scene: Scene, bench: Bench, draw: Random, seed: int) -> Truth:
    """Return the world of one test: another work of adhesion, stiffness and load train than any scene names."""
    known = sensors(bench)
    truth = emulated_truth(scene, seed)
    specimen = truth.specimen
    if hasattr(specimen, "line"):
        receding = draw.uniform(2.0, 5.0)
        specimen = replace(specimen, line=replace(specimen.line, receding=receding))  # type: ignore[type-var]
    if hasattr(specimen, "sphere_radius"):
        error = getattr(scene.protocol, "indenter_radius_uncertainty_mm", 0.0) * 1e-3 * draw.normal()
        specimen = replace(specimen, sphere_radius=specimen.sphere_radius + error)  # type: ignore[type-var]
    stiffness = 1 / (known.compliance + known.compliance_uncertainty * draw.normal())
    assert bench.pump is not None
    syringe = bench.pump.syringe_diameter_mm * 1e-3 * (1 + known.pump_volume / 2 * draw.normal())
    relaxing = known.creep + known.creep_uncertainty * draw.normal()
    return replace(
        truth,
        specimen=specimen,
        train=replace(truth.train, stiffness=stiffness, relaxing=relaxing, start_position=START_MM * 1e-3),
        chamber=replace(truth.chamber, syringe_diameter=syringe),
    )


@dataclass(frozen=True, slots=True)
class BentCell(Cell):
    """A load cell whose line is out by ``bow`` (N) under tension and under compression, 63 % of it at ``bow_load``."""

    bow: tuple[float, float] = (0.0, 0.0)
    bow_load: float = 0.025

    def output(self, force: Array, bridge: bool) -> Array:
        """Return the noise-free signal of the bent line."""
        bent = np.where(force < 0, *self.bow) * -np.expm1(-np.abs(force) / self.bow_load)
        return Cell.output(self, force + bent, bridge)


def instruments(bench: Bench, draw: Random) -> Device:
    """Return the DAQ with a cell and a pressure sensor that are off by their stated uncertainties."""
    known, force = sensors(bench), bench.force
    cell = BentCell(
        name=force.cell,
        capacity=force.capacity_N,
        sensitivity=1 / force.calibration.slope,
        gain_error=known.force_gain * draw.normal(),
        linearity=0.0,
        noise=4e-5 * force.capacity_N,
        bow=(known.force_linearity * draw.normal(), known.force_linearity * draw.normal()),
        bow_load=force.capacity_N * 0.005 * 2 ** float(draw.uniform(-1, 1)),
    )
    sensor = PressureSensor()
    span = 2 * sensor.full_scale
    return usb_6211(
        cell=cell,
        sensor=replace(
            sensor, offset=known.pressure_offset / span * draw.normal(), gain_error=known.pressure_gain * draw.normal()
        ),
    )


@dataclass
class Witness(Observer):
    """Keeps every knot of the plant: time, force on the sample, height, pressure, contact radius, force at the cell."""

    plant: Plant
    rows: list[tuple[float, ...]] = field(default_factory=list)
    begin: float = math.nan

    def frame(self, frame: Frame) -> None:
        """Note when the first sample was taken, in the plant's time; the last of a frame is taken now."""
        if math.isnan(self.begin):
            self.begin = self.plant.time - (frame.stop - 1) / frame.rate

    def keep(self) -> None:
        """Copy the knots not yet seen."""
        relaxing = self.plant.truth.train.relaxing
        last = self.rows[-1][0] if self.rows else -1.0
        for knot in self.plant._knots:
            if last < knot.time <= self.plant.time:
                state = knot.state
                shown = state.force - relaxing * knot.relaxed
                self.rows.append((knot.time, state.force, state.height, state.pressure, state.radius, shown))


@dataclass
class Test:
    """One emulated test: what was recorded, and what was so."""

    run: Run
    truth: Truth
    rows: Array
    begin: float


def emulate(kind: str, seed: int) -> Test:
    """Run one random test."""
    draw = np.random.default_rng([seed, 77, len(kind)])
    _, bench_text = load_bench(None)
    bench_text = bench_text.replace("reference_on_start = true", "reference_on_start = false")
    bench = parse_bench(bench_text, "benches/emulated.toml")
    text = SCENES[kind](draw)
    scene = parse_scene(text, kind)
    emulated = EmulatedBench(
        world(scene, bench, draw, seed),
        seed=seed,
        wire=False,
        pressure=scene.uses_pressure,
        device=instruments(bench, draw),
        referenced=True,
    )
    witness = Witness(emulated.plant)
    forget = Plant._forget

    def remembered(plant: Plant) -> None:
        witness.keep()
        forget(plant)

    with (
        tempfile.TemporaryDirectory() as folder,
        patch("rig.emulation.emulated_bench", lambda request: emulated),
        patch.object(Plant, "_forget", remembered),
    ):
        out = Path(folder) / f"{kind}-{seed}.h5"
        request = Request(scene, text, bench, bench_text, out, seed, wire=False, live=False, observers=[witness])
        ending = run_scene(request)
        if ending.exit_code:
            raise RuntimeError(f"{kind}, seed {seed}: {ending.reason}")
        return Test(load_run(out), emulated.plant.truth, np.array(witness.rows), witness.begin)


def true_features(test: Test) -> dict[str, float]:
    """Read the features off the true trace: the contact is lost where its radius ends."""
    if test.run.protocol == "volume":
        return {"chamber_volume_m3": test.truth.chamber.volume}
    times = (test.rows[:, 0] - test.begin) * test.run.rate
    retract, dwell = test.run.step("retract"), test.run.step("dwell")
    assert retract is not None
    assert dwell is not None
    _, force, height, pressure, radius, _ = test.rows[times >= retract.start].T
    lowest, last = int(np.argmin(force)), int(np.flatnonzero(radius > 0)[-1])
    compressed = np.flatnonzero(force[: lowest + 1] > 0)
    first = int(compressed[-1]) if compressed.size else 0
    zero = float(np.interp(0, -force[first : first + 2], height[first : first + 2])) if compressed.size else height[0]
    part = slice(first + 1 if compressed.size else 0, last + 1)
    start = 0.0 if compressed.size else float(force[0])
    # A JKR contact's force vanishes with its radius: what the last knot still carries is the world's step in time.
    end = height[last + 1] if test.run.protocol == "indentation" else height[last]
    found = {
        "pull_off_force_N": -float(force[lowest]),
        "pull_off_distance_m": float(end - zero),
        "preload_N": float(test.rows[times < dwell.stop][:, 1].max()),
        "adhesion_energy_J": -float(np.trapezoid(np.r_[start, force[part]], np.r_[zero, height[part]])),
    }
    if test.run.protocol == "pull_off":
        before = test.rows[:, 0] <= test.rows[times >= retract.start][last, 0] - RUN_AWAY
        part = before & (times >= retract.start)
        gas = gas_volume(test)[part]
        return found | {
            "initial_pressure_Pa": float(pressure[0]),
            "gas_work_J": float(np.trapezoid(test.rows[part, 3], gas)),
        }
    specimen = test.truth.specimen
    assert isinstance(specimen, Indentation)
    work = work_of_adhesion_jkr(-float(force[lowest]), specimen.sphere_radius)
    return found | {
        "work_of_adhesion_J_m2": work,
        "fitted_work_of_adhesion_J_m2": work,
        "fitted_modulus_Pa": specimen.modulus,
    }


def gas_volume(test: Test) -> Array:
    """Return the volume of the leaking gas at each knot, m^3."""
    chamber, time, pressure = test.truth.chamber, test.rows[:, 0], test.rows[:, 3]
    lost = np.r_[0.0, np.cumsum((pressure[1:] + pressure[:-1]) / 2 * np.diff(time))] / chamber.leak_time
    return np.asarray(chamber.volume * (ATMOSPHERE - lost) / (ATMOSPHERE + pressure))


def one(kind: str, seed: int) -> dict[str, list[float]]:
    """Run, analyse and compare one random test."""
    test = emulate(kind, seed)
    features = analyze(test.run).features
    return {
        name: [(features.value(name) - true) / features.uncertainty(name)] for name, true in true_features(test).items()
    }


def main() -> None:
    """Print one table per kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", default=list(SCENES), metavar="KIND", help=", ".join(SCENES))
    parser.add_argument("--tests", type=int, default=200, metavar="N")
    parser.add_argument("--jobs", type=int, metavar="N", help="processes (default: one per core)")
    arguments = parser.parse_args()
    for kind in arguments.kinds:
        begin = time.perf_counter()
        found: dict[str, list[float]] = {}
        for outcome in on_all_cores(partial(one, kind), range(arguments.tests), workers=arguments.jobs):
            for name, scores in outcome.items():
                found.setdefault(name, []).extend(scores)
        with pd.option_context("display.width", 160):
            print(f"{kind}: {arguments.tests} emulated tests, {time.perf_counter() - begin:.0f} s")
            print(summary(found).to_string(index=False), flush=True)


if __name__ == "__main__":
    main()
