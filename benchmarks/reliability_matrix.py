"""The whole fault matrix on several processes; writes docs/fault-matrix.md."""

from __future__ import annotations

import argparse
import contextlib
import io
import multiprocessing
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fault_matrix import Verdict, cells, page, play

PAGE = Path(__file__).parents[1] / "docs" / "fault-matrix.md"


def judged(number: int) -> Verdict | str:
    """Play a cell by its number; what could not even be judged is told as text."""
    trouble, step = cells()[number]
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        try:
            return play(trouble, step, Path(folder))
        except Exception as error:  # noqa: BLE001 - the other cells go on
            return f"{trouble.title} in {step}: {error!r}"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=1e9, help="write the page with what is there by then")
    arguments = parser.parse_args()
    deadline = time.monotonic() + 60 * arguments.minutes
    verdicts: list[Verdict] = []
    numbers = sorted(range(len(cells())), key=lambda number: cells()[number][1] != "preload")  # every fault once, first
    with multiprocessing.get_context("spawn").Pool(arguments.workers) as pool:
        for verdict in pool.imap_unordered(judged, numbers):
            if isinstance(verdict, str):
                print("FAILED", verdict, flush=True)
                continue
            verdicts.append(verdict)
            if verdict.flaws:
                print(verdict.trouble, verdict.step, verdict.ending, verdict.flaws, flush=True)
            if len(verdicts) % 20 == 0:
                print(len(verdicts), "cells", flush=True)
            if time.monotonic() > deadline:
                break
    order = {(trouble.title, step): number for number, (trouble, step) in enumerate(cells())}
    verdicts.sort(key=lambda verdict: order[verdict.trouble, verdict.step])
    PAGE.write_text(page(verdicts), encoding="utf-8")
    print(f"{len(verdicts)} cells, {sum(not verdict.flaws for verdict in verdicts)} without a flaw")


if __name__ == "__main__":
    main()
