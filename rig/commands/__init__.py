"""One module per command: ``add_arguments(parser)`` and ``run(arguments) -> int``.

The modules import only argparse at the top; whatever a command needs is imported when it runs.
"""

from __future__ import annotations

import argparse

SCENE = "scene file, or the name of one that ships"
BENCH = "bench file, or the name of one that ships"


def count(text: str) -> int:
    """Return the number of an option that counts something; at least one."""
    try:
        number = int(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from error
    if number < 1:
        raise argparse.ArgumentTypeError(f"{number}: must be at least 1")
    return number


def natural(text: str) -> int:
    """Read an option that counts, from 0."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number of 0 or more")
    return int(text)
