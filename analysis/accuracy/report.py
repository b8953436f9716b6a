"""Run the studies and write page, pictures and CSV."""

from __future__ import annotations

import importlib
import math
import pkgutil
import platform
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from analysis.accuracy.section import Progress, Section
from model.errors import InvalidParameter

if TYPE_CHECKING:
    import pandas as pd

FOLDER = "accuracy"


def studies() -> list[str]:
    """Return the names of the modules that contribute, in the order of the page."""
    import analysis.accuracy

    return sorted(name for _, name, _ in pkgutil.iter_modules(analysis.accuracy.__path__) if name.endswith("_study"))


def write_report(folder: Path, *, quick: bool, progress: Progress, only: str | None = None) -> Path:
    """Run the studies; write ``accuracy.md`` into ``folder`` and pictures and CSV into its subfolder.

    ``quick`` runs the reduced form: smaller grids, fewer random scenes, fewer repeats. ``only`` renews one study
    (``cone`` for ``cone_study``) and keeps the parts of the others as they were written before.

    Raises
    ------
    InvalidParameter
        There is no such study.
    """
    files = folder / FOLDER
    files.mkdir(parents=True, exist_ok=True)
    names = studies()
    if only is not None and f"{only}_study" not in names:
        known = ", ".join(name.removesuffix("_study") for name in names)
        raise InvalidParameter(f"no study {only!r}; choose one of {known}")
    for name in names:
        if only is None or name == f"{only}_study":
            begin = time.perf_counter()
            parts = [_write_section(section, files) for section in _sections(name)(quick, progress)]
            note = _conditions(name, quick, time.perf_counter() - begin)
            (files / f"{name}.md").write_text("\n".join([*parts, note]), encoding="utf-8", newline="\n")
    page = folder / "accuracy.md"
    fragments = [files / f"{name}.md" for name in names]
    written = [_from_above(fragment.read_text(encoding="utf-8")) for fragment in fragments if fragment.exists()]
    page.write_text("\n".join([HEADING, *written]), encoding="utf-8", newline="\n")
    return page


def _from_above(part: str) -> str:
    """Return a part with links that start in the folder above, where the page is; it is written with its own."""
    return re.sub(r"\]\((?!\w+:)", f"]({FOLDER}/", part)


def _sections(study: str) -> Callable[[bool, Progress], list[Section]]:
    function: Callable[[bool, Progress], list[Section]] = importlib.import_module(f"analysis.accuracy.{study}").sections
    return function


HEADING = """# Error against run time

Written by `rig accuracy`. Errors are relative to an independent solution in high precision unless said otherwise; run
times are those of warm repeats in one process (seconds of its CPU), so only their ratios travel.
"""


def _conditions(study: str, quick: bool, seconds: float) -> str:
    """Return what the numbers of a study were made with."""
    import mpmath
    import numpy as np
    import scipy

    form = "reduced" if quick else "full"
    return (
        f"*{study.removesuffix('_study')}: {form} form, {seconds:.0f} s; Python {platform.python_version()}, "
        f"NumPy {np.__version__}, SciPy {scipy.__version__}, mpmath {mpmath.__version__}, {platform.machine()}, "
        f"{platform.system()}.*\n"
    )


def _write_section(section: Section, files: Path) -> str:
    lines = [f"## {section.title}\n", section.text.strip() + "\n"]
    for name, table in section.tables.items():
        table.to_csv(files / f"{name}.csv", index=False, lineterminator="\n")
        caption = section.captions.get(name, "")
        if name not in section.csv_only:
            lines += [markdown(table), ""]
        lines.append(f"{caption} ([CSV]({name}.csv))\n".strip() + "\n")
    for name, draw in section.figures.items():
        draw(files / f"{name}.png")
        lines.append(f"![{section.captions.get(name, name)}]({name}.png)\n")
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
