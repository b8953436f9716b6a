"""Record an emulated run and say on standard output what is acknowledged: run as a script, to be killed.

Each line: samples acknowledged, how long the oldest of those samples had waited, s of wall time, and the moment, s of
the monotonic clock. A third word ``journalled`` makes the recording survive a power cut.
"""

from __future__ import annotations

import os
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

from conftest import SHORT, scene_text

from rig.bench import load_bench
from rig.recorder import Recorder
from rig.scene import Scene
from rig.session import Request, run_scene


def main() -> None:
    """Record into the file named, at the speed named (``max`` for virtual time)."""
    out, speed, out_of_sight = Path(sys.argv[1]), sys.argv[2], sys.stdout.fileno()
    append, flush = Recorder.append, Recorder.flush
    waiting: list[float] = []

    def appended(self: Recorder, frame: Any, *rest: Any) -> None:
        # The first sample of a frame is as old as the frame is long when it arrives; virtual time has no age.
        waiting.append(time.perf_counter() - (frame.force.size / frame.rate if speed != "max" else 0.0))
        append(self, frame, *rest)

    def flushed(self: Recorder) -> None:
        flush(self)
        age = time.perf_counter() - waiting[0] if waiting else 0.0
        waiting.clear()
        os.write(out_of_sight, f"{self.acknowledged} {age:.6f} {time.monotonic():.6f}\n".encode())

    Recorder.append, Recorder.flush = appended, flushed  # type: ignore[method-assign]
    text = scene_text("sphere-60mm-low", **SHORT)
    bench, bench_text = load_bench(None)
    recording = bench.recording.model_copy(update={"survives_power_cut": "journalled" in sys.argv[3:]})
    bench = bench.model_copy(update={"recording": recording})
    scene = Scene.model_validate(tomllib.loads(text))
    pace = None if speed == "max" else float(speed)
    run_scene(Request(scene, text, bench, bench_text, out, seed=7, speed=pace, wire=False, live=False))


if __name__ == "__main__":
    main()
