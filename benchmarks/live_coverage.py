"""How often the announced 90 % band holds: emulated pull-off tests with random true parameters, direct back end.

    python benchmarks/live_coverage.py --tests 300 --out docs/live-coverage.json

Each test takes one of the shipped scenes in turn; its world (adhesion, modulus, thickness, peeling rate, tilt, chamber,
load train) is drawn anew and is never told to the prediction. Afterwards the frames up to a given part of the true way
to pull-off are given to the predictor, and its intervals are held against what was then measured.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from drivers.emulated.truth import Truth
from rig import emulation
from rig.bench import load_bench
from rig.console.app import shipped_scenes
from rig.library import find_scene
from rig.live import LivePrediction, LivePredictor
from rig.live_data import Evidence, Gathering, Glance
from rig.observe import StepEvent, Watcher
from rig.scene import Scene, parse_scene
from rig.session import Request, run_scene
from sequences.frame import Frame

PARTS = (0.0, 0.25, 0.5, 0.75, 0.9)
narrow_truth = emulation.truth


def wide_truth(scene: Scene, seed: int) -> Truth:
    """The plant's own variation of specimens, and more: adhesion 12 %, modulus 3 %, peeling rate 30 % (1 sigma)."""
    truth: Any = narrow_truth(scene, seed)
    draw = np.random.default_rng([seed, 77]).standard_normal
    line = dataclasses.replace(
        truth.specimen.line,
        receding=truth.specimen.line.receding * float(np.exp(0.12 * draw())),
        line_speed=truth.specimen.line.line_speed * float(np.exp(0.3 * draw())),
    )
    modulus = truth.specimen.youngs_modulus * (1 + 0.03 * draw())
    specimen = dataclasses.replace(truth.specimen, line=line, youngs_modulus=modulus)
    return dataclasses.replace(truth, specimen=specimen)


class Collector(Watcher):
    """Gathers what the live prediction sees."""

    def __init__(self) -> None:
        self.gathering = Gathering()

    def step(self, event: StepEvent) -> None:
        """Take in a step."""
        if event.phase == "started":
            self.gathering.step(event)

    def frame(self, frame: Frame) -> None:
        """Take in a frame."""
        self.gathering.add(Glance.at(frame))


def run_test(name: str, seed: int, folder: Path) -> tuple[Scene, Evidence]:
    text, source = find_scene(name)
    text = text.replace("preload_dwell_s = 30.0", "preload_dwell_s = 3.0")
    scene = parse_scene(text, source)
    bench, bench_text = load_bench(None)
    collector = Collector()
    out = folder / f"{seed}.h5"
    request = Request(scene, text, bench, bench_text, out, seed=seed, wire=False, live=False, observers=[collector])
    ending = run_scene(request)
    out.unlink()
    if ending.exit_code:
        raise RuntimeError(ending.reason)
    return scene, collector.gathering.evidence()


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
    emulation.truth = wide_truth
    scenes, tests, began = [s for s in shipped_scenes() if is_pull_off(s)], [], time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(told.tests):
            name, seed = scenes[number % len(scenes)], told.first_seed + number
            try:
                scene, evidence = run_test(name, seed, Path(folder))
            except RuntimeError as error:
                print(f"{name} seed {seed}: no pull-off to judge: {error}", flush=True)
                continue
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
    scene = parse_scene(*find_scene(name))
    return scene.protocol.name == "pull_off" and scene.gripper.kind == "rigid" and name.startswith(("flat", "sphere"))


if __name__ == "__main__":
    main()
