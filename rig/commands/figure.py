"""``rig figure``: draw a figure of the papers, with its data as CSV."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analysis.figures.registry import Material
    from rig.collection import Collection


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from model import MODELS

    parser.add_argument("number", help="2a ... 6i, S8, S9, sampling; 'all', or 'list' to see what there is")
    parser.add_argument(
        "recordings",
        nargs="*",
        type=Path,
        help="recordings, or folders of recordings, to draw from; without any the models stand alone",
    )
    parser.add_argument("--out", type=Path, help="picture (.png, .svg, .pdf) or directory (default: figures/)")
    parser.add_argument("--model", choices=MODELS, default="cone", help="model of the theory")


def run(arguments: argparse.Namespace) -> int:
    """Draw one figure, or all; print where picture and data are. Recordings that none shows are named."""
    from analysis.figures.registry import Material, draw, find, load
    from analysis.repeats import group
    from rig.collection import collect
    from rig.errors import FileError
    from rig.output import PICTURES, prepare, writing

    if arguments.number == "list":
        for number, figure in load().items():
            print(f"{number:9s} {figure.title}")
        return 0
    numbers = list(load()) if arguments.number == "all" else [find(arguments.number).number]
    pictures = {number: _path(number, arguments.out, several=len(numbers) > 1) for number in numbers}
    for picture in pictures.values():
        prepare("--out", picture, *PICTURES)
    found = collect(arguments.recordings)
    found.leave_calibrations()
    if arguments.recordings and not found.runs:
        found.tell()
        raise FileError("none of the recordings can be drawn. Remedy: leave them out for the models alone.")
    material = Material(group(analyzed.analysis for analyzed in found.runs), arguments.model)
    for number, picture in pictures.items():
        with writing("--out", picture):
            table = draw(number, material, picture)
        print(f"{picture}  {table}")
    return _tell_unused(found, material, arguments.number)


def _path(number: str, out: Path | None, *, several: bool) -> Path:
    if out is not None and out.suffix and not several and not out.is_dir():
        return out
    return (out or Path("figures")) / f"figure-{number}.png"


def _tell_unused(found: Collection, material: Material, number: str) -> int:
    """Say which recordings no figure shows, and why; return the exit code."""
    shown = "no figure" if number == "all" else f"nothing of figure {number}"
    found.tell()
    unused = []
    for members in material.groups:
        for analysis in members.members:
            name = analysis.run.name
            if name in material.used:
                continue
            if name in members.outliers:
                reason = f"an outlier: {members.outliers[name]}"
            elif analysis.curve is None:
                reason = f"no curve: {analysis.no_curve}"
            else:
                reason = f"{shown} shows it ({members.condition})"
            unused.append(f"not used: {name}: {reason}")
    if found.runs and not material.used:
        unused.append("no recording could be used: the models stand alone")
    for line in unused:
        print(line, file=sys.stderr)
    return found.exit_code or int(bool(unused))
