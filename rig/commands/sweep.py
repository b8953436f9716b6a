"""``rig sweep``: predict a table of scenes, one row per combination of the varied keys."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.commands import SCENE, count

if TYPE_CHECKING:
    from rig.scene import Scene


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from model import MODELS

    parser.add_argument("scene", metavar="SCENE", help=SCENE)
    parser.add_argument(
        "--vary",
        action="append",
        required=True,
        metavar="KEY=START:STOP:N",
        help="a key of the scene file and its values, evenly spaced, or KEY=A,B,C; may be given several times",
    )
    parser.add_argument("--model", choices=MODELS, default="cone", help="adhesion model (default: cone)")
    parser.add_argument("--out", type=Path, metavar="CSV", help="write the table here instead of standard output")
    parser.add_argument("--processes", type=count, metavar="N", help="worker processes (default: one per core)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler, such as tcp://host:8786")
    parser.add_argument("--rigid-bound", action="store_true", help="soft gripper: sweep the rigid one, as a bound")


def run(arguments: argparse.Namespace) -> int:
    """Predict every combination and write the table."""
    from analysis.sweep import sweep
    from rig.commands.predict import refuse_unmodelled
    from rig.library import load_scene
    from rig.output import prepare, writing

    prepare("--out", arguments.out)
    source = arguments.scene
    scene, _ = load_scene(source)
    bound = refuse_unmodelled(scene, source, rigid_bound=arguments.rigid_bound)
    axes = [parse_axis(text) for text in arguments.vary]
    keys = resolve_all(scene, [key for key, _ in axes])
    points = list(itertools.product(*(values for _, values in axes)))
    scenes = [changed(scene, source, dict(zip(keys, point, strict=True))) for point in points]
    table = sweep(
        [one.parameters() for one in scenes],
        arguments.model,
        processes=arguments.processes,
        scheduler=arguments.scheduler,
        progress=show_progress,
    )
    for position, (key, values) in enumerate(zip(keys, zip(*points, strict=True), strict=True)):
        table.insert(position, key, list(values))
    if bound is not None:
        table["note"] = bound
    if arguments.out is None:
        table.to_csv(sys.stdout, index=False, lineterminator="\n")
    else:
        with writing("--out", arguments.out):
            table.to_csv(arguments.out, index=False, lineterminator="\n")
        print(f"{len(table)} rows in {arguments.out}", file=sys.stderr)
    return 0


def parse_axis(text: str) -> tuple[str, list[float]]:
    """Return key and values of ``KEY=START:STOP:N`` or ``KEY=A,B,C``."""
    from rig.errors import FileError

    key, _, values = text.partition("=")
    try:
        if ":" in values:
            start, stop, count = values.split(":")
            return key.strip(), _evenly(float(start), float(stop), int(count))
        return key.strip(), [float(value) for value in values.split(",")]
    except ValueError as error:
        raise FileError(
            f"--vary {text}: not of the form KEY=START:STOP:N (N at least 1) or KEY=A,B,C. Remedy: "
            "for example --vary diameter_mm=12:60:25"
        ) from error


def _evenly(start: float, stop: float, count: int) -> list[float]:
    if count < 1:
        raise ValueError(count)
    if count == 1:
        return [start]
    return [start + (stop - start) * k / (count - 1) for k in range(count - 1)] + [stop]


def resolve_all(scene: Scene, keys: Sequence[str]) -> list[str]:
    """Return the full keys.

    Raises
    ------
    FileError
        As ``resolve``; or one is given twice.
    """
    from rig.errors import FileError

    found: list[str] = []
    for key in keys:
        found.append(resolve(scene, key))
        if found[-1] in found[:-1]:
            raise FileError(f"--vary {key}: {found[-1]} is varied twice. Remedy: give all its values in one --vary.")
    return found


def resolve(scene: Scene, key: str) -> str:
    """Return the full key, ``substrate.diameter_mm`` for ``diameter_mm``.

    Raises
    ------
    FileError
        The scene has no such number, or several.
    """
    import difflib

    from rig.errors import FileError

    known = [
        f"{section}.{name}"
        for section, values in scene.model_dump().items()
        if isinstance(values, dict)
        for name, value in values.items()
        if not isinstance(value, str)
    ]
    matches = [one for one in known if one == key or one.rpartition(".")[2] == key]
    if len(matches) == 1:
        return matches[0]
    close = difflib.get_close_matches(key, [*known, *(one.rpartition(".")[2] for one in known)], n=1, cutoff=0.5)
    hint = f"did you mean {close[0]}?" if close else f"known keys: {', '.join(known)}"
    raise FileError(f"--vary {key}: {'ambiguous: ' + ', '.join(matches) if matches else 'no such key'} ({hint})")


def changed(scene: Scene, source: str, values: dict[str, float]) -> Scene:
    """Return the scene with keys replaced, checked as if its file had said so."""
    from rig.scene import Scene
    from rig.validation import validated

    content: dict[str, Any] = scene.model_dump()
    for key, value in values.items():
        section, _, name = key.partition(".")
        content[section][name] = value
    return validated(Scene, "scene", content, f"{source} with --vary")


def show_progress(blocks: Iterable[Sequence[Any]], count: int) -> Iterable[Any]:
    """Show a bar on standard error if it is a terminal."""
    from tqdm import tqdm

    return tqdm(blocks, total=count, unit="block", disable=not sys.stderr.isatty() or count < 2)
