"""``rig recover``: repair a recording left by a crash."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("file", type=Path, nargs="+", help="recording")
    parser.add_argument("--force", action="store_true", help="even if its writer seems to be alive")


def run(arguments: argparse.Namespace) -> int:
    """Repair each file; say what was kept."""
    from rig.recovery import recover

    for path in arguments.file:
        found = recover(path, force=arguments.force)
        state = "repaired" if found.repaired else "needs no repair"
        print(f"{path}: {state}, {found.samples} samples in {found.frames} frames")
    return 0
