"""``rig reference``: reference the stage, with the operator's confirmation."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rig.commands import BENCH


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--bench", type=Path, required=True, help=BENCH)
    parser.add_argument("--path-is-clear", action="store_true", help="confirm without being asked")


def run(arguments: argparse.Namespace) -> int:
    """Ask, then move: the stage may run its full travel."""
    from rig.bench import load_bench
    from rig.errors import Refused
    from rig.library import load_scene
    from rig.session import Request, reference_only

    bench, bench_text = load_bench(arguments.bench)
    if not arguments.path_is_clear:
        print("The stage will run to its switch, up to its full travel. Take specimen and gripper out of its path.")
        print("Type 'clear' when the path is clear: ", end="", flush=True)
        if sys.stdin is None or sys.stdin.readline().strip() != "clear":
            raise Refused("not confirmed, nothing has moved. Remedy: type clear, or give --path-is-clear.")
    scene, text = load_scene("sphere-60mm-vented")
    position = reference_only(Request(scene, text, bench, bench_text, Path()))
    print(f"referenced; the stage stands at {position * 1e3:.4f} mm")
    return 0
