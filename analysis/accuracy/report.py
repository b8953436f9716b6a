"""Run the studies and write page, pictures and CSV."""

from __future__ import annotations

import importlib
import math
import pkgutil
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from analysis.accuracy.section import Progress, Section

if TYPE_CHECKING:
    import pandas as pd

FOLDER = "accuracy"


def studies() -> list[str]:
    """Return the names of the modules that contribute, in the order of the page."""
    import analysis.accuracy

    return sorted(name for _, name, _ in pkgutil.iter_modules(analysis.accuracy.__path__) if name.endswith("_study"))


def write_report(folder: Path, *, quick: bool, progress: Progress) -> Path:
    """Run all studies; write ``accuracy.md`` into ``folder`` and pictures and CSV into its subfolder.

    ``quick`` runs the reduced form: smaller grids, fewer random scenes, fewer repeats.
    """
    files = folder / FOLDER
    files.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    parts: list[str] = []
    for name in studies():
        parts += [_write_section(section, files) for section in _sections(name)(quick, progress)]
    page = folder / "accuracy.md"
    seconds = time.perf_counter() - begin
    page.write_text("\n".join([_heading(quick, seconds), *parts]), encoding="utf-8", newline="\n")
    return page


def _sections(study: str) -> Callable[[bool, Progress], list[Section]]:
    function: Callable[[bool, Progress], list[Section]] = importlib.import_module(f"analysis.accuracy.{study}").sections
    return function


def _heading(quick: bool, seconds: float) -> str:
    import mpmath
    import numpy as np
    import scipy

    form = "reduced" if quick else "full"
    versions = (
        f"Python {platform.python_version()}, NumPy {np.__version__}, SciPy {scipy.__version__}, "
        f"mpmath {mpmath.__version__}"
    )
    return (
        "# Error against run time\n\n"
        f"Written by `rig accuracy{' --quick' if quick else ''}` ({form} form, {seconds:.0f} s) with {versions} on "
        f"{platform.machine()}, {platform.system()}. Errors are relative to an independent solution in high precision "
        "unless said otherwise; run times are medians of warm repeats in one process (seconds of its CPU), so only "
        "their ratios travel.\n"
    )


def _write_section(section: Section, files: Path) -> str:
    lines = [f"## {section.title}\n", section.text.strip() + "\n"]
    for name, table in section.tables.items():
        table.to_csv(files / f"{name}.csv", index=False, lineterminator="\n")
        caption = section.captions.get(name, "")
        if name not in section.csv_only:
            lines += [markdown(table), ""]
        lines.append(f"{caption} ([CSV]({FOLDER}/{name}.csv))\n".strip() + "\n")
    for name, draw in section.figures.items():
        draw(files / f"{name}.png")
        lines.append(f"![{section.captions.get(name, name)}]({FOLDER}/{name}.png)\n")
        if name in section.captions:
            lines.append(f"*{section.captions[name]}*\n")
    return "\n".join(lines)


def markdown(table: pd.DataFrame) -> str:
    """Return a table as Markdown, numbers to four digits."""
    rows = [list(table.columns), ["---"] * len(table.columns)]
    rows += [[_cell(value) for value in row] for row in table.itertuples(index=False)]
    return "\n".join("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows)


def _cell(value: object) -> str:
    if isinstance(value, float):
        if math.isnan(value):
            return "-"
        return f"{value:.4g}"
    return str(value).replace("|", "\\|")
