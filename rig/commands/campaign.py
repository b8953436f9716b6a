"""``rig campaign``: run a matrix of scenes, resumable."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rig.commands import BENCH, count

if TYPE_CHECKING:
    from rig.bench import Bench
    from rig.campaign import Journal, PlannedTest
    from rig.observe import Observer
    from rig.operator import Keyboard
    from rig.session import Request


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("file", type=Path, help="campaign file, or the name of one that ships")
    parser.add_argument("--bench", type=Path, help=f"{BENCH}; without one everything is emulated")
    parser.add_argument("--out", type=Path, help="folder of the recordings (default: recordings/<campaign>)")
    parser.add_argument("--direct", action="store_true", help="emulated bench: without the wires between")
    parser.add_argument("--jobs", type=count, default=1, help="emulated bench: tests at the same time")
    parser.add_argument("--yes", action="store_true", help="do not wait for the operator's hands")
    parser.add_argument("--report", type=Path, metavar="HTML", help="analyse the whole campaign into one page")


def run(arguments: argparse.Namespace) -> int:
    """Run what is not yet done; return the first failure's exit code."""
    import sys

    from tqdm import tqdm

    from rig.bench import load_bench
    from rig.campaign import Journal, load_campaign
    from rig.check import check
    from rig.errors import FileError
    from rig.output import prepare

    prepare("--report", arguments.report, ".html", ".htm")
    campaign, tests = load_campaign(arguments.file)
    bench, bench_text = load_bench(arguments.bench)
    if arguments.jobs > 1 and not bench.is_emulated:
        raise FileError("--jobs: a real rig runs one test at a time. Remedy: leave it out.")
    for scene in {test.scene_text: test.scene for test in tests}.values():
        check(scene, bench)
    folder = arguments.out or Path("recordings") / arguments.file.stem
    folder.mkdir(parents=True, exist_ok=True)
    journal = Journal(folder)
    journal.check(tests)
    adopted = journal.adopt(tests, _is_whole)
    done = journal.done()
    todo = [test for test in tests if test.key not in done]
    found = f", {len(adopted)} of them found whole without an entry" if adopted else ""
    print(f"{campaign.title}: {len(tests)} tests, {len(tests) - len(todo)} done{found}", file=sys.stderr)
    with tqdm(total=len(todo), unit="test", disable=not (sys.stderr.isatty() and bench.is_emulated)) as bar:
        for number, code in enumerate(_run_all(todo, bench, bench_text, journal, arguments), start=1):
            if code:
                return code
            bar.update()
            if bar.disable:
                print(f"{number} of {len(todo)} tests done", file=sys.stderr)
    print(f"recordings {folder}", file=sys.stderr)
    if arguments.report is not None:
        from rig.cli import main

        entries = journal.done()
        files = [str(folder / entries[test.key]) for test in tests]
        return main(["analyze", *files, "--report", str(arguments.report), "--title", campaign.title])
    return 0


def _run_all(
    tests: list[PlannedTest], bench: Bench, bench_text: str, journal: Journal, arguments: argparse.Namespace
) -> Iterator[int]:
    """Run the tests one after another, or on the emulated bench several at once; yield exit codes as they come."""
    if arguments.jobs <= 1:
        from rig.operator import Keyboard

        keyboard = None if bench.is_emulated else Keyboard()
        setup = None
        for test in tests:
            if keyboard is not None and not arguments.yes and test.prompt and test.setup != setup:
                keyboard.confirm(test.prompt)
            setup = test.setup
            out = journal.free_name(test.key)
            yield _enter(journal, test, *_run_one(test, bench, bench_text, out, arguments.direct, keyboard))
        return
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from concurrent.futures.process import BrokenProcessPool
    from multiprocessing import get_context

    from rig.errors import RigError

    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        futures = {
            pool.submit(_run_one, test, bench, bench_text, journal.free_name(test.key), arguments.direct): test
            for test in tests
        }
        try:
            for future in as_completed(futures):
                try:
                    outcome = future.result()
                except BrokenProcessPool as error:
                    raise RigError(
                        "campaign: a process was killed, and with it the tests under way. Remedy: the same command "
                        "goes on where it stopped; with fewer --jobs if memory has run out."
                    ) from error
                yield _enter(journal, futures[future], *outcome)
        finally:
            pool.shutdown(cancel_futures=True)  # after a failure or Ctrl-C no further test is begun


def _run_one(
    test: PlannedTest, bench: Bench, bench_text: str, out: Path, direct: bool, keyboard: Keyboard | None = None
) -> tuple[str, int, str, bool]:
    """Run a test; return its recording's name, how it has ended, and whether no other is to follow."""
    from rig.session import Request, run_scene

    request = Request(
        scene=test.scene,
        scene_text=test.scene_text,
        bench=bench,
        bench_text=bench_text,
        out=out,
        seed=test.seed,
        wire=not direct,
        live=False,
        repeat=test.repeat,
        repeats=test.repeats,
        place=test.place,
    )
    request.observers = _observers(request, keyboard)
    ending = run_scene(request)
    return out.name, ending.exit_code, ending.reason, request.controls.ending


def _observers(request: Request, keyboard: Keyboard | None) -> list[Observer]:
    """On a real rig the operator sees every step and answers prompts; emulated, the progress bar is enough."""
    if keyboard is None:
        return []
    from rig.operator import Prompts
    from rig.terminal import Terminal
    from rig.voice import Voice

    voice = Voice()
    return [Terminal(voice), Prompts(keyboard, request.controls, voice)]


def _enter(journal: Journal, test: PlannedTest, recording: str, code: int, reason: str, stopped: bool) -> int:
    """Enter a test that has succeeded; say why one has not, or that the operator stopped when it was all but over."""
    from rig.errors import StoppedByOperator
    from rig.voice import say

    if code:
        say(f"rig campaign: {test.key}: {reason}")
    else:
        journal.write(test.key, recording, scene=test.digest)
        if stopped:
            say(f"rig campaign: stopped by the operator after {test.key}")
            return StoppedByOperator.exit_code
    return code


def _is_whole(path: Path, test: PlannedTest) -> bool:
    """Whether the recording is of this test and came to its end; one left by a crash is kept, but is not whole."""
    from rig.errors import FileError
    from rig.recording import load_recording

    try:
        recording = load_recording(path)
    except FileError:
        return False
    told = recording.configuration
    same = told.get("scene") == test.scene_text and told.get("place", "") == test.place
    return same and recording.ending is not None and recording.ending[1] == 0
