"""Bias and coverage of the stated uncertainties over N random synthetic tests (default 240)."""

import sys
import time
from functools import partial

import pandas as pd

from analysis.batch import on_all_cores
from analysis.coverage import CASES, deviations, summary


def one(kind: str, seed: int) -> dict[str, list[float]]:
    """Return the deviations of one test."""
    return deviations(kind, [seed])


def main(count: int) -> None:
    """Print one table per protocol."""
    for kind in CASES:
        begin = time.perf_counter()
        found: dict[str, list[float]] = {}
        for outcome in on_all_cores(partial(one, kind), range(count)):
            for name, scores in outcome.items():
                found.setdefault(name, []).extend(scores)
        with pd.option_context("display.width", 160):
            print(f"{kind}, {count} tests, {time.perf_counter() - begin:.0f} s")
            print(summary(found).to_string(index=False), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 240)
