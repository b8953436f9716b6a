"""``rig figure``: draw a figure of the papers, with its data as CSV."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analysis.repeats import Group


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from model import MODELS

    parser.add_argument("number", help="2a ... 6i, S8, S9, sampling; 'all', or 'list' to see what there is")
    parser.add_argument(
        "recordings", nargs="*", type=Path, help="recordings to draw from; without any the models stand alone"
    )
    parser.add_argument("--out", type=Path, help="picture (.png, .svg, .pdf) or directory (default: figures/)")
    parser.add_argument("--model", choices=MODELS, default="cone", help="model of the theory")


def run(arguments: argparse.Namespace) -> int:
    """Draw one figure, or all; print where picture and data are."""
    from analysis.figures.registry import Material, draw, find, load

    if arguments.number == "list":
        for number, figure in load().items():
            print(f"{number:9s} {figure.title}")
        return 0
    numbers = list(load()) if arguments.number == "all" else [find(arguments.number).number]
    material = Material(_groups(arguments.recordings), arguments.model)
    for number in numbers:
        picture = _path(number, arguments.out, several=len(numbers) > 1)
        table = draw(number, material, picture)
        print(f"{picture}  {table}")
    return 0


def _path(number: str, out: Path | None, *, several: bool) -> Path:
    if out is not None and out.suffix and not several:
        return out
    return (out or Path("figures")) / f"figure-{number}.png"


def _groups(recordings: list[Path]) -> list[Group]:
    from analysis.repeats import group
    from rig.commands.analyze import analyze_files

    return group(analyzed.analysis for analyzed in analyze_files(recordings)) if recordings else []
