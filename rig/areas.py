"""Contact areas measured after the test: a CSV file with one line a recording, read beside the recordings."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from analysis.quantity import Quantity
from analysis.run import Run
from rig.errors import FileError
from rig.library import read_text

SETTINGS = {
    "area_mm2": "contact_area_mm2",
    "uncertainty_mm2": "contact_area_uncertainty_mm2",
    "real_um2": "real_area_um2",
    "real_uncertainty_um2": "real_area_uncertainty_um2",
    "projected_um2": "projected_area_um2",
    "projected_uncertainty_um2": "projected_area_uncertainty_um2",
}
"""Columns beside ``recording``, and the key of the scene each one stands for."""

USED_BY = {
    "contact_area_mm2": ("pull_off", "indentation", "punch"),
    "real_area_um2": ("fiber",),
    "projected_area_um2": ("fiber",),
}
"""Protocols that each area is of use to."""

Areas = Mapping[str, Mapping[str, float]]
"""Settings by the recording's name."""


def read_areas(path: Path) -> Areas:
    """Read an areas file.

    Parameters
    ----------
    path
        CSV with a header: ``recording`` (its name in the analysis, with or without ``.h5``) and any columns of
        ``SETTINGS``. Empty cells say nothing; of two lines for one recording the later adds to the earlier.

    Raises
    ------
    FileError
        Names the file, the line and the cell that is not an area.
    """
    text = read_text("areas", path, ", or write one with rig contact-area")
    lines = csv.DictReader(text.splitlines(), skipinitialspace=True)
    columns = [(name or "").strip() for name in lines.fieldnames or ()]
    lines.fieldnames = columns
    unknown = [name for name in columns if name not in SETTINGS and name != "recording"]
    if "recording" not in columns or unknown:
        raise FileError(f"{path}: columns {', '.join(columns)}. Remedy: recording and any of {', '.join(SETTINGS)}")
    found: dict[str, dict[str, float]] = {}
    for cells in lines:
        where = f"{path}, line {lines.line_num}"
        if None in cells:
            raise FileError(f"{where}: more cells than columns. Remedy: write the decimal point as a point")
        name = (cells["recording"] or "").strip().removesuffix(".h5")
        settings = {SETTINGS[key]: _area(f"{where}, {key}", text) for key, text in cells.items() if _given(key, text)}
        if not name:
            raise FileError(f"{where}: names no recording. Remedy: write its file name into the column recording")
        found.setdefault(name, {}).update(settings)
    return found


def _given(column: str, text: str | None) -> bool:
    return column != "recording" and bool((text or "").strip())


def _area(where: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value <= 0:
        raise FileError(f"{where}: {text.strip()!r} is no area. Remedy: a number above zero")
    return value


def with_area(run: Run, areas: Areas) -> Run:
    """Return the run with the areas measured for it; they replace those of its scene."""
    mine = areas.get(run.name)
    return run if mine is None else replace(run, settings={**run.settings, **mine})


def strangers(areas: Areas, names: Iterable[str]) -> list[str]:
    """Return the recordings of an areas file that are not among ``names``: left out, or misspelt."""
    return sorted(set(areas) - set(names))


def useless(areas: Areas, runs: Iterable[Run]) -> list[str]:
    """Say which areas are of no use to the runs they were measured for."""
    return [
        f"{run.name}: {key} is of no use to a {run.protocol} test"
        for run in runs
        for key, protocols in USED_BY.items()
        if key in areas.get(run.name, {}) and run.protocol not in protocols
    ]


def area_line(recording: str, area: Quantity) -> str:
    """Return the line of an areas file for a contact area, without its end."""
    return f"{recording},{area.value * 1e6:.5g},{area.uncertainty * 1e6:.2g}"


HEADER = "recording,area_mm2,uncertainty_mm2"
"""Of an areas file as ``add_area`` begins it."""


def add_area(path: Path, recording: str, area: Quantity) -> None:
    """Add a line to an areas file; a new one gets a header.

    Raises
    ------
    FileError
        The file has other columns, or cannot be written.
    """
    try:
        before = read_text("areas", path) if path.exists() else HEADER + "\n"
        if before.partition("\n")[0].strip() != HEADER:
            raise FileError(f"{path}: has other columns than {HEADER}. Remedy: another file, or add the line by hand")
        end = "" if before.endswith("\n") else "\n"
        path.write_text(f"{before}{end}{area_line(recording, area)}\n", encoding="utf-8", newline="\n")
    except OSError as error:
        raise FileError(f"{path}: {error}. Remedy: name a file that can be written") from error
