"""``rig run``: take a scene through its sequence, record it, and show the prediction beside the measurement."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rig.commands import BENCH, SCENE, natural

if TYPE_CHECKING:
    from rig.campaign import PlannedTest
    from rig.observe import Ending, Observer
    from rig.operator import Keyboard
    from rig.session import Request

DEFAULT_SCENE = "sphere-60mm-low"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scene", nargs="?", default=DEFAULT_SCENE, help=SCENE)
    parser.add_argument("--bench", type=Path, help=f"{BENCH}; without one everything is emulated")
    parser.add_argument("--out", type=Path, help="recording to write (default: recordings/<scene>-<time>.h5)")
    parser.add_argument("--seed", type=natural, default=0, help="emulated bench: which specimen and which noise")
    parser.add_argument("--speed", default="max", help="emulated bench: times real time, or max (default)")
    parser.add_argument("--direct", action="store_true", help="emulated bench: without the wires between")
    parser.add_argument("--faults", type=Path, help="emulated bench: fault script")
    parser.add_argument("--repeat", type=natural, default=1, help="how many tests in a row, up to 1000")
    parser.add_argument("--console", action="store_true", help="watch and command the run in the console's window")
    parser.add_argument("--link", action="store_true", help="let consoles attach")
    parser.add_argument("--no-live", action="store_true", help="no live prediction")
    parser.add_argument("--no-picture", action="store_true", help="no analysis and no picture at the end")


def run(arguments: argparse.Namespace) -> int:
    """Run the scene once or several times; return the first failure's exit code."""
    if arguments.console:
        from rig.commands import console

        return console.run_with_console(arguments)
    from rig.errors import StoppedByOperator
    from rig.operator import Keyboard

    keyboard, place, ending_asked = Keyboard(), "", False
    for test, request in _requests(arguments):
        if ending_asked:
            raise StoppedByOperator(f"stopped by the operator before {test.key}")
        if test.place != place and not request.bench.is_emulated:
            if arguments.link:  # a console cannot attach before the run
                request.hands = test.prompt.rstrip(".")
            else:
                keyboard.confirm(test.prompt)
        place = test.place
        ending = _run_once(request, arguments, keyboard)
        if ending.exit_code:
            return ending.exit_code
        ending_asked = request.controls.ending  # when the test was all but over
    return 0


def _requests(arguments: argparse.Namespace) -> Iterator[tuple[PlannedTest, Request]]:
    """Yield the tests of the scene: its places, each so often."""
    from rig.bench import load_bench
    from rig.campaign import MOST_REPEATS, single
    from rig.errors import FileError
    from rig.library import load_scene
    from rig.recorder import insist_on_new
    from rig.session import Request

    if not 1 <= arguments.repeat <= MOST_REPEATS:
        raise FileError(f"--repeat {arguments.repeat}: not from 1 to {MOST_REPEATS}. Remedy: a campaign takes more.")
    scene, text = load_scene(arguments.scene)
    bench, bench_text = load_bench(arguments.bench)
    if not bench.is_emulated and arguments.speed != "max":
        raise FileError("--speed: real instruments run in real time. Remedy: leave it out.")
    faults = None
    if arguments.faults is not None:
        from rig.fault_script import load_faults

        faults = load_faults(arguments.faults)
    tests = single(scene, text, Path(arguments.scene).stem, arguments.repeat, arguments.seed)
    if arguments.out is not None:
        for test in tests:
            insist_on_new(_destination(arguments.out, test.key, len(tests)))
    for number, test in enumerate(tests, 1):
        yield (
            test,
            Request(
                scene=scene,
                scene_text=text,
                bench=bench,
                bench_text=bench_text,
                out=_destination(arguments.out, test.key, len(tests)),
                seed=test.seed,
                speed=parse_speed(arguments.speed),
                wire=not arguments.direct,
                live=not arguments.no_live,
                faults=faults,
                repeat=number,
                repeats=len(tests),
                place=test.place,
            ),
        )


def parse_speed(text: str) -> float | None:
    """Return times real time, or ``None`` for ``max``."""
    from rig.errors import FileError

    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = -1.0
    if not 0 < speed <= 1000:
        raise FileError(f"--speed {text}: neither max nor a number above 0 and up to 1000. Remedy: e.g. --speed 1.")
    return speed


def _destination(out: Path | None, key: str, count: int) -> Path:
    """Return the recording's path; several tests share ``--out`` as the beginning of their names."""
    from datetime import datetime

    if out is None:
        return Path("recordings") / f"{key}-{datetime.now():%Y%m%d-%H%M%S}.h5"
    return out if count == 1 else out.with_name(f"{out.stem}-{key}{out.suffix}")


def _run_once(request: Request, arguments: argparse.Namespace, keyboard: Keyboard) -> Ending:
    import sys
    from contextlib import ExitStack

    from rig.operator import Prompts
    from rig.session import run_scene
    from rig.terminal import Terminal
    from rig.voice import Voice, say

    voice = Voice()
    observers: list[Observer] = [Terminal(voice)]
    if not request.bench.is_emulated:
        observers.append(Prompts(keyboard, request.controls, voice, linked=arguments.link))
    request.observers = observers
    with ExitStack() as links:
        if arguments.link:
            from rig.link_server import LinkServer

            observers.append(links.enter_context(LinkServer(request.controls)))
        ending = run_scene(request)
    if ending.exit_code:
        say(f"rig run: {ending.reason}\nrig run: the recording {request.out} holds {ending.samples} samples.")
    elif not arguments.no_picture:
        from rig.summary import summarise

        say(summarise(request.out), sys.stdout)
    return ending
