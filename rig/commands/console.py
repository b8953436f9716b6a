"""``rig console``: the operator's console."""

from __future__ import annotations

import argparse
from pathlib import Path

from rig.commands import BENCH, SCENE


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scene", nargs="?", help=f"chosen at the start: {SCENE}")
    parser.add_argument("--bench", type=Path, help=f"chosen at the start: {BENCH}")
    parser.add_argument("--replay", type=Path, metavar="FILE", help="replay a recording")
    parser.add_argument("--theme", choices=("dark", "light"), default="dark", help="colours (default: dark)")
    parser.add_argument("--alone", action="store_true", help="do not attach to a run that is already going")


def run(arguments: argparse.Namespace) -> int:
    """Open the window."""
    from rig.console.app import open_console

    return open_console(
        scene=arguments.scene,
        bench=arguments.bench,
        replay=arguments.replay,
        theme=arguments.theme,
        attach=not arguments.alone,
    )


def run_with_console(arguments: argparse.Namespace) -> int:
    """Start ``rig run`` in a process of its own and watch it."""
    from rig.console.app import open_console

    words = ["run", arguments.scene, "--link", "--seed", str(arguments.seed), "--repeat", str(arguments.repeat)]
    for option in ("bench", "out", "faults"):
        value = getattr(arguments, option)
        if value is not None:
            words += [f"--{option}", str(value)]
    words += [f"--{name.replace('_', '-')}" for name in ("direct", "no_live", "no_picture") if getattr(arguments, name)]
    if arguments.bench is None:
        words += ["--speed", arguments.speed]
    return open_console(scene=arguments.scene, bench=arguments.bench, child=words, attach=False)


def replay_with_console(arguments: argparse.Namespace) -> int:
    """Replay a recording in the window."""
    from rig.console.app import open_console

    return open_console(replay=arguments.file, what_if=(arguments.model, tuple(arguments.set)), attach=False)
