"""How often the announced 90 % band holds: emulated pull-off tests with random true parameters.

    python benchmarks/live_coverage.py --tests 300 --out docs/live-coverage.json

Each test is played on the emulated plant, with its noise, drift and creep, but without wires and control loop, so that
hundreds take minutes. Each takes one of the shipped scenes in turn; its world (adhesion, modulus, thickness, peeling
rate, tilt, chamber, load train) is drawn anew and is never told to the prediction. Afterwards the frames up to a given
part of the true way to pull-off are given to the predictor, and its intervals are held against what was measured.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from drivers.emulated.plant import Plant
from drivers.emulated.truth import Truth
from rig.emulation import truth as specimen_of
from rig.library import load_scene, shipped
from rig.live import LivePredictor
from rig.live_data import Evidence, Gathering, Glance
from rig.live_prediction import LivePrediction
from rig.observe import StepEvent, StepPhase
from rig.scene import Scene

PARTS = (0.0, 0.25, 0.5, 0.75, 0.9)
RATE = 1000.0
SAMPLES = 100


def wide_truth(scene: Scene, seed: int) -> Truth:
    """The plant's own variation of specimens, and more: adhesion 12 %, modulus 3 %, peeling rate 30 % (1 sigma)."""
    truth: Any = specimen_of(scene, seed)
    draw = np.random.default_rng([seed, 77]).standard_normal
    line = dataclasses.replace(
        truth.specimen.line,
        receding=truth.specimen.line.receding * float(np.exp(0.12 * draw())),
        line_speed=truth.specimen.line.line_speed * float(np.exp(0.3 * draw())),
    )
    modulus = truth.specimen.youngs_modulus * (1 + 0.03 * draw())
    specimen = dataclasses.replace(truth.specimen, line=line, youngs_modulus=modulus)
    return dataclasses.replace(truth, specimen=specimen)


class Hand:
    """Plays a pull-off test on a plant in frames of 0.1 s, and gathers what the live prediction would see."""

    def __init__(self, truth: Truth, seed: int) -> None:
        self.plant = Plant(truth, seed=seed)
        self.gathering = Gathering()
        self.number = 0

    def step(self, name: str) -> None:
        """Begin a step."""
        self.gathering.step(StepEvent(StepPhase.STARTED, name, self.number * SAMPLES))

    def advance(self) -> tuple[float, float]:
        """Let one frame pass; return its mean force and pressure."""
        start = self.number * SAMPLES
        signals = self.plant.advance(SAMPLES, RATE)
        force, pressure = float(signals["force"].mean()), float(signals["pressure"].mean())
        position = self.plant.axis.position
        self.gathering.add(Glance(self.number, start, start + SAMPLES, RATE, force, pressure, position))
        self.number += 1
        return force, pressure

    def wait(self, seconds: float) -> float:
        """Let time pass; return the mean pressure of it."""
        return float(np.mean([self.advance()[1] for _ in range(round(seconds * RATE / SAMPLES))]))


def play(scene: Scene, truth: Truth, seed: int) -> Evidence:
    """Tare, approach, preload, rest, pressurize and retract until the contact is gone."""
    hand, contact = Hand(truth, seed), truth.train.contact_position
    plant, protocol = hand.plant, scene.protocol
    hand.step("tare")
    hand.wait(2.0)
    hand.step("approach")
    plant.axis.move(contact + 50e-6, 2e-3, 1.0, 1.0)
    while plant.axis.moving:
        hand.advance()
    plant.axis.move(contact - 4e-3, 50e-6, 1e-2, 1e-2)
    while hand.advance()[0] - hand.gathering.zero < protocol.preload_N and plant.axis.moving:
        pass
    plant.axis.halt(1e-2)
    hand.step("dwell")
    pressure = hand.wait(5.0)
    goal = getattr(protocol, "initial_pressure_kPa", None)
    for _ in range(20 if goal is not None else 0):
        missing = goal * 1e3 - pressure
        if abs(missing) < 30:
            break
        plant.syringe.run(float(np.sign(missing)) * 1e-7, 0.9 * abs(missing) / 101.3e3 * truth.chamber.volume)
        while plant.syringe.rate:
            hand.advance()
        pressure = hand.wait(1.0)
    hand.step("retract")
    plant.axis.move(plant.axis.position + 8e-3, protocol.retract_speed_um_s * 1e-6, 1e-2, 1e-2)
    while not hand.gathering.gone and plant.axis.moving:
        hand.advance()
    evidence = hand.gathering.evidence()
    if goal is None:
        return dataclasses.replace(evidence, initial_pressure=None, pressure=None)
    return evidence


def until(evidence: Evidence, rows: int) -> Evidence:
    pressure = None if evidence.pressure is None else evidence.pressure[:rows]
    return dataclasses.replace(evidence, height=evidence.height[:rows], force=evidence.force[:rows], pressure=pressure)


def judge(scene: Scene, evidence: Evidence) -> dict[str, Any]:
    tension = evidence.force_zero - evidence.force
    crossed = np.flatnonzero(tension > 0)
    zero = evidence.start if tension[0] > 0 else float(evidence.height[crossed[0]])
    force, distance = float(tension.max()), float(evidence.height[-1]) - zero
    predictor = LivePredictor(scene.parameters(), compliance=12e-6)
    said = {}
    for part in PARTS:
        rows = max(1, int(np.searchsorted(evidence.height, zero + part * distance)))
        prediction = predictor.predict(until(evidence, rows))
        said[f"{part:g}"] = None if prediction is None else verdict(prediction, force, distance)
    return {"pull_off_force_N": force, "pull_off_distance_m": distance, "said": said}


def verdict(prediction: LivePrediction, force: float, distance: float) -> dict[str, Any]:
    result = {"runtime_s": prediction.runtime_s, "inside": prediction.inside}
    for name, estimate, true in (
        ("force", prediction.pull_off_force, force),
        ("distance", prediction.pull_off_distance, distance),
    ):
        result[name] = {
            "holds": bool(estimate.low <= true <= estimate.high),
            "width": (estimate.high - estimate.low) / true,
            "error": (estimate.value - true) / true,
        }
    return result


def summarise(tests: list[dict[str, Any]]) -> dict[str, Any]:
    table: dict[str, Any] = {}
    for part in (f"{part:g}" for part in PARTS):
        said = [test["said"][part] for test in tests if test["said"][part] is not None]
        row: dict[str, Any] = {
            "predictions": len(said),
            "median_runtime_s": float(np.median([s["runtime_s"] for s in said])),
        }
        row["said_outside"] = float(np.mean([not s["inside"] for s in said]))
        for name in ("force", "distance"):
            row[name] = {
                "coverage": float(np.mean([s[name]["holds"] for s in said])),
                "median_width": float(np.median([s[name]["width"] for s in said])),
                "median_error": float(np.median([abs(s[name]["error"]) for s in said])),
            }
        table[part] = row
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tests", type=int, default=300)
    parser.add_argument("--first-seed", type=int, default=10_000)
    parser.add_argument("--out", type=Path)
    told = parser.parse_args()
    scenes, tests, began = [s for s in shipped("scene") if is_pull_off(s)], [], time.perf_counter()
    for number in range(told.tests):
        name, seed = scenes[number % len(scenes)], told.first_seed + number
        scene, _ = load_scene(name)
        evidence = play(scene, wide_truth(scene, seed), seed)
        tests.append({"scene": name, "seed": seed, **judge(scene, evidence)})
        if (number + 1) % 30 == 0:
            print(f"{number + 1} tests, {time.perf_counter() - began:.0f} s", flush=True)
    by_scene = {name: summarise([t for t in tests if t["scene"] == name])["0.5"] for name in scenes}
    result = {"tests": len(tests), "by_part": summarise(tests), "at_half_by_scene": by_scene}
    text = json.dumps(result, indent=1)
    print(text)
    if told.out is not None:
        told.out.write_text(text + "\n", encoding="utf-8")


def is_pull_off(name: str) -> bool:
    scene, _ = load_scene(name)
    return scene.protocol.name == "pull_off" and scene.gripper.kind == "rigid" and name.startswith(("flat", "sphere"))


if __name__ == "__main__":
    main()
