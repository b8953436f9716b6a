"""``kill -9`` of a recording program, in figures: files readable, samples lost, how long samples wait."""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from test_kill_recording import LIFE, WRITER, check, killed

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
        subprocess.run([sys.executable, str(WRITER), str(path), "max"], check=True, stdout=subprocess.DEVNULL)
        whole = load_recording(path)
        acknowledged_in_all = 0
        for trial in range(arguments.trials):
            path = Path(folder) / "killed.h5"
            acknowledged, _ = killed(path, draw.uniform(0, LIFE))
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
            ages.append(killed(path, draw.uniform(5, 10), "1")[1])
    print(f"{len(found)} kills, {sum(found)} files whole and true, {acknowledged_in_all} samples acknowledged")
    print("longest wait for the acknowledgement in real time, ms:", " ".join(f"{age * 1e3:.0f}" for age in ages))


if __name__ == "__main__":
    main()
