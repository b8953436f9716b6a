"""Dead man in figures: the program is killed at random moments."""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from dead_man import Halt, kill_in

LONGEST = {"approach": 1.2, "preload": 3.0, "pressurize": 4.0, "retract": 4.0}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=40)
    draw = random.Random(1)
    halts: list[Halt] = []
    for trial in range(parser.parse_args().trials):
        step = draw.choice(sorted(LONGEST))
        with tempfile.TemporaryDirectory() as folder:
            halt = kill_in(step, draw.uniform(0, LONGEST[step]), Path(folder), trial)
        halts.append(halt)
        print(
            f"{trial:3d} {step:10s} +{halt.delay:.2f} s: {halt.overrun * 1e6:5.1f} um, {halt.pumped * 1e9:6.1f} ul, "
            f"+{halt.force_rise:.3f} N, largest {halt.largest_force:.3f} N{'' if halt.at_rest else ', NOT AT REST'}",
            flush=True,
        )
    print(
        f"{len(halts)} trials, {sum(halt.at_rest for halt in halts)} at rest; largest overrun "
        f"{max(halt.overrun for halt in halts) * 1e6:.1f} um, {max(halt.pumped for halt in halts) * 1e9:.0f} ul, "
        f"{max(halt.force_rise for halt in halts):.3f} N; largest force "
        f"{max(halt.largest_force for halt in halts):.3f} N"
    )


if __name__ == "__main__":
    main()
