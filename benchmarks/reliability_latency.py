"""From the sample that passes the limit to the stop byte, by frame length, on an idle and on a loaded computer."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from latency import measure


def busy() -> None:
    while True:
        pass


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--frames", type=float, nargs="+", default=[5.0, 10.0, 20.0, 50.0])
    arguments = parser.parse_args()
    for load in (0, os.cpu_count() or 1):
        burners = [multiprocessing.Process(target=busy, daemon=True) for _ in range(load)]
        for burner in burners:
            burner.start()
        for frame_ms in arguments.frames:
            with tempfile.TemporaryDirectory() as folder:
                latencies, endings = measure(Path(folder), frame_ms, arguments.trials)
            p50, p99, most = np.quantile(latencies, [0.5, 0.99, 1.0]) * 1e3 if len(latencies) else [np.nan] * 3
            print(
                f"{load} busy processes, frame {frame_ms:g} ms: {len(latencies)} of {len(endings)} trips, "
                f"p50 {p50:.1f} p99 {p99:.1f} max {most:.1f} ms, load {os.getloadavg()[0]:.1f}",
                flush=True,
            )
        for burner in burners:
            burner.kill()


if __name__ == "__main__":
    main()
