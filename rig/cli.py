"""The command line ``rig``."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from rig.voice import say

COMMANDS = {
    "run": "run a scene on a bench and record it",
    "replay": "feed a recording through the same loop again",
    "predict": "predict one pull-off test",
    "sweep": "predict a table of scenes",
    "load-sharing": "stress under the membrane and its sharing among the fibres",
    "analyze": "turn recordings into features, tables and reports",
    "contact-area": "measure the contact on a still image",
    "recover": "repair a recording left by a crash",
    "accuracy": "error against run time of every solver",
    "figure": "draw a figure of the papers",
    "campaign": "run a matrix of scenes, resumable",
    "doctor": "check the bench; moves nothing",
    "reference": "reference the stage, with the operator's confirmation",
    "emulate": "serve the emulated instruments",
    "console": "the operator's console",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code. Errors are one message on standard error."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = _parser(words)
    parsed, late = parser.parse_known_args(words)
    if late and (any(word.startswith("-") for word in late) or not hasattr(parsed, "recordings")):
        parser.error(f"unrecognized arguments: {' '.join(late)}")
    if late:  # files after an option that came after files
        parsed.recordings += map(Path, late)
    try:
        return _run(parsed)
    finally:
        _flush()


def _run(parsed: argparse.Namespace) -> int:
    try:
        return int(parsed.run(parsed))
    except KeyboardInterrupt:
        say("rig: stopped by the operator")
        return 130
    except BrokenPipeError:
        return 0  # who reads has seen enough
    except Exception as error:
        if _is_ours(error):
            say(f"rig {parsed.command}: {error}")
            return int(getattr(error, "exit_code", 1))
        if isinstance(error, OSError) and error.filename is not None:
            say(f"rig {parsed.command}: {error.filename}: {error.strerror}. Remedy: check its name, folder and rights.")
            return 2
        raise


def _flush() -> None:
    """Write out what is buffered; where nobody reads it, that must not change the exit code."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="rig", description="Pull-off tests of pressurised adhesive membranes.")
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, summary in COMMANDS.items():
        command = commands.add_parser(name, help=summary, description=summary[0].upper() + summary[1:] + ".")
        if name in words:  # only the command at hand is imported
            module = importlib.import_module(f"rig.commands.{name.replace('-', '_')}")
            module.add_arguments(command)
            command.set_defaults(run=module.run)
    return parser


class _Version(argparse.Action):
    """Print the installed version; importlib.metadata is slow to import, so only on demand."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object, **__: object) -> None:
        from importlib.metadata import version

        print(version("membrane-adhesion-rig"))
        parser.exit()


def _is_ours(error: Exception) -> bool:
    """Whether the error is of the project's hierarchy; anything else is a bug and keeps its traceback."""
    return type(error).__module__.split(".")[0] in {"model", "drivers", "sequences", "analysis", "rig"}
