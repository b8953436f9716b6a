"""``rig replay``: feed a recording through the same loop again."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    from model import MODELS

    parser.add_argument("file", type=Path, help="recording")
    parser.add_argument("--speed", default="max", help="times real time, or max (default)")
    parser.add_argument("--verify", action="store_true", help="demand every derived value identical to the bit")
    parser.add_argument("--model", choices=MODELS, help="what if: predict with this model")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="what if: another scene value")
    parser.add_argument("--console", action="store_true", help="watch the replay in the console's window")
    parser.add_argument("--link", action="store_true", help="let consoles attach")
    parser.add_argument("--no-live", action="store_true", help="no live prediction")


def run(arguments: argparse.Namespace) -> int:
    """Replay the recording; with ``--verify`` return 1 on any difference."""
    import math
    import sys
    import time
    from contextlib import ExitStack

    from rig.commands.run import parse_speed
    from rig.observe import Controls, Observer
    from rig.recording import load_recording
    from rig.replay import Pace
    from rig.replay_session import replay, what_if
    from rig.terminal import Terminal

    if arguments.console:
        from rig.commands import console

        return console.replay_with_console(arguments)
    recording = load_recording(arguments.file)
    speed = parse_speed(arguments.speed)
    controls = Controls()
    observers: list[Observer] = [] if arguments.verify else [Terminal()]
    with ExitStack() as links:
        if arguments.link:
            from rig.link_server import LinkServer

            observers.append(links.enter_context(LinkServer(controls)))
        began = time.perf_counter()
        outcome = replay(
            recording,
            pace=Pace(math.inf if speed is None else speed),
            observers=observers,
            controls=controls,
            live=not arguments.no_live,
            what_if=what_if(recording, arguments.model, arguments.set),
        )
        wall = time.perf_counter() - began
    seconds = recording.force.size / recording.rate
    print(f"{arguments.file}: {seconds:.1f} s replayed in {wall:.2f} s ({seconds / wall:.0f} times real time)")
    if not arguments.verify:
        return 0
    for difference in outcome.differences[:20]:
        print(f"rig replay: {difference}", file=sys.stderr)
    print("identical" if not outcome.differences else f"{len(outcome.differences)} differences")
    return 1 if outcome.differences else 0
