"""``rig accuracy``: error against run time of every solver, as a page with plots and CSV."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--quick", action="store_true", help="the reduced form: seconds instead of minutes")
    parser.add_argument("--only", metavar="STUDY", help="renew one study (cone, stability, ...), keep the others")
    parser.add_argument(
        "--out", type=Path, default=Path("docs"), metavar="DIR", help="folder of accuracy.md (default: docs)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Write the report and say where."""
    from rig.errors import FileError

    try:
        import mpmath  # noqa: F401
    except ImportError as error:
        raise FileError("rig accuracy needs mpmath for its reference. Remedy: pip install mpmath") from error
    from analysis.accuracy.report import write_report
    from model import InvalidParameter

    try:
        page = write_report(arguments.out, quick=arguments.quick, progress=_say, only=arguments.only)
    except InvalidParameter as error:
        raise FileError(f"--only {arguments.only}: {error}") from error
    except OSError as error:
        raise FileError(
            f"--out {arguments.out}: cannot be written ({error}). Remedy: choose another folder."
        ) from error
    print(page)
    return 0


def _say(what: str) -> None:
    if sys.stderr.isatty():
        print(f"\r\033[K{what}", end="", file=sys.stderr, flush=True)
