"""``kill -9`` of a recording program, in figures: files readable, samples lost, how long samples wait."""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from killed_run import LIFE, record_and_kill, record_whole
from test_kill_recording import check

from rig.errors import RigError
from rig.recording import load_recording


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--real-time", type=int, default=5, help="trials that time the wait")
    arguments = parser.parse_args()
    draw = random.Random(2)
    found: list[bool] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "whole.h5"
        record_whole(path)
        whole = load_recording(path)
        acknowledged_in_all = 0
        for trial in range(arguments.trials):
            path = Path(folder) / "killed.h5"
            acknowledged = record_and_kill(path, draw.uniform(0, LIFE))[-1].samples
            acknowledged_in_all += acknowledged
            try:
                check(path, acknowledged, whole)
                found.append(True)
            except (AssertionError, OSError, RigError) as error:
                found.append(False)
                print(f"trial {trial}: {error!r}")
            path.unlink()
            if trial % 20 == 19:
                print(
                    f"{trial + 1} trials, {sum(found)} intact, {acknowledged_in_all} samples acknowledged", flush=True
                )
        ages = []
        for trial in range(arguments.real_time):
            path = Path(folder) / f"real-{trial}.h5"
            ages.append(max(told.age for told in record_and_kill(path, draw.uniform(5, 10), "1")))
    print(f"{len(found)} kills, {sum(found)} files whole and true, {acknowledged_in_all} samples acknowledged")
    print("longest wait for the acknowledgement in real time, ms:", " ".join(f"{age * 1e3:.0f}" for age in ages))


if __name__ == "__main__":
    main()
