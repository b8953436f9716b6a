"""The whole fault matrix on several processes; writes docs/fault-matrix.md."""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import io
import multiprocessing
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fault_matrix import Verdict, cells, page, play

PAGE = Path(__file__).parents[1] / "docs" / "fault-matrix.md"
ATTEMPTS = 2
"""How often a cell is played whose process has died."""


def title(number: int) -> str:
    trouble, step = cells()[number]
    return f"{trouble.title} in {step}"


def judged(number: int) -> Verdict | str:
    """Play a cell by its number; what could not even be judged is told as text."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        try:
            return play(*cells()[number], Path(folder))
        except Exception as error:  # noqa: BLE001 - the other cells go on
            return f"{title(number)}: {error!r}"


def serve(cell_numbers: Connection) -> None:
    """Play the cells whose numbers come in; a process that crashes tells where."""
    faulthandler.enable(file=sys.__stderr__)
    with contextlib.suppress(EOFError):
        while True:
            cell_numbers.send(judged(cell_numbers.recv()))


@dataclass
class Worker:
    """A process and the cell it is playing."""

    process: BaseProcess
    line: Connection
    number: int


class Team:
    """Plays cells on several processes; yields each cell's number with its verdict.

    A process that dies is replaced and its cell played again once; a cell that kills two has failed.
    """

    def __init__(self, numbers: list[int], workers: int) -> None:
        self._left = deque((number, 1) for number in numbers)
        self._attempt: dict[int, int] = {}
        self._workers: list[Worker] = []
        self.deaths: list[str] = []
        for _ in range(min(workers, len(numbers))):
            self._engage()

    def verdicts(self) -> Iterator[tuple[int, Verdict | str]]:
        """Yield what each cell came to, in the order they end."""
        while self._workers:
            lines = {worker.line: worker for worker in self._workers}
            for line in wait(list(lines)):
                worker = lines[line]  # type: ignore[index]
                try:
                    yield worker.number, worker.line.recv()
                except (EOFError, OSError):
                    yield from self._dead(worker)
                    continue
                if not self._next(worker):
                    self._dismiss(worker)

    def dismiss_all(self) -> None:
        """End every process."""
        for worker in list(self._workers):
            self._dismiss(worker)

    def _next(self, worker: Worker) -> bool:
        if not self._left:
            return False
        worker.number = self._taken()
        worker.line.send(worker.number)
        return True

    def _taken(self) -> int:
        number, attempt = self._left.popleft()
        self._attempt[number] = attempt
        return number

    def _engage(self) -> None:
        """Start a process on the next cell."""
        context = multiprocessing.get_context("spawn")
        line, other = context.Pipe()
        process = context.Process(target=serve, args=(other,), daemon=True)
        process.start()
        other.close()
        worker = Worker(process, line, self._taken())
        line.send(worker.number)
        self._workers.append(worker)

    def _dead(self, worker: Worker) -> Iterator[tuple[int, str]]:
        self._dismiss(worker)
        attempt = self._attempt[worker.number]
        death = f"{title(worker.number)}: its process died with exit code {worker.process.exitcode} (attempt {attempt})"
        self.deaths.append(death)
        if attempt < ATTEMPTS:
            self._left.appendleft((worker.number, attempt + 1))
        else:
            yield worker.number, death
        if self._left:
            self._engage()

    def _dismiss(self, worker: Worker) -> None:
        worker.line.close()
        worker.process.join(10)
        worker.process.kill()
        self._workers.remove(worker)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=1e9, help="write the page with what is there by then")
    parser.add_argument("--only", type=int, nargs="+", help="numbers of cells; no page is written")
    arguments = parser.parse_args()
    deadline = time.monotonic() + 60 * arguments.minutes
    numbers = sorted(range(len(cells())), key=lambda number: cells()[number][1] != "preload")  # every fault once, first
    team = Team(arguments.only or numbers, arguments.workers)
    verdicts: dict[int, Verdict] = {}
    for number, verdict in team.verdicts():
        if isinstance(verdict, str):
            print("FAILED", verdict, flush=True)
        else:
            verdicts[number] = verdict
            if verdict.flaws:
                print(number, verdict.trouble, verdict.step, verdict.ending, verdict.flaws, flush=True)
        if len(verdicts) % 20 == 0:
            print(len(verdicts), "cells", flush=True)
        if time.monotonic() > deadline:
            break
    team.dismiss_all()
    for death in team.deaths:
        print("DIED", death)
    if not arguments.only:
        PAGE.write_text(page([verdicts[number] for number in sorted(verdicts)]), encoding="utf-8")
    print(f"{len(verdicts)} cells, {sum(not verdict.flaws for verdict in verdicts.values())} without a flaw")


if __name__ == "__main__":
    main()
