"""What a flush of the recording costs, with and without the journal that survives a power cut; a run in real time each.

python benchmarks/journal_cost.py [--folder where the recordings go: the disk is what counts]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from conftest import scene_text

from rig.bench import load_bench
from rig.recorder import Recorder
from rig.scene import Scene
from rig.session import Request, run_scene

SHORT = {"tare_s": 1.0, "preload_dwell_s": 5.0, "retract_speed_um_s": 100.0}


def flushes(folder: Path, journalled: bool) -> tuple[np.ndarray, str]:
    """Record one test in real time; return how long each flush took, s, and how the run ended."""
    text = scene_text("sphere-60mm-low", **SHORT)
    bench, bench_text = load_bench(None)
    recording = bench.recording.model_copy(update={"survives_power_cut": journalled})
    bench = bench.model_copy(update={"recording": recording})
    scene = Scene.model_validate(tomllib.loads(text))
    flush, taken = Recorder.flush, []

    def timed(recorder: Recorder) -> None:
        begin = time.perf_counter()
        flush(recorder)
        taken.append(time.perf_counter() - begin)

    out = folder / f"{journalled}.h5"
    with patch.object(Recorder, "flush", timed):
        ending = run_scene(Request(scene, text, bench, bench_text, out, seed=7, speed=1.0, wire=False, live=False))
    return np.array(taken), ending.reason


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        for journalled in (False, True):
            taken, reason = flushes(Path(folder), journalled)
            p50, p99, most = np.quantile(taken, [0.5, 0.99, 1.0]) * 1e3
            name = "with the journal" if journalled else "without"
            print(f"{name}: {taken.size} flushes, p50 {p50:.2f} p99 {p99:.2f} max {most:.2f} ms; {reason}", flush=True)


if __name__ == "__main__":
    main()
