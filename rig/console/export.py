"""Save a plot as PNG, SVG or CSV."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

from rig.errors import FileError

if TYPE_CHECKING:
    from rig.console.plots import Plot

PNG_WIDTH = 2000


def save(plot: Plot, path: Path) -> None:
    """Write the plot in the format of the path's suffix; CSV holds every sample in view, in SI units.

    Raises
    ------
    FileError
        The format is unknown or the file cannot be written.
    """
    writers = {".png": _png, ".svg": _svg, ".csv": _csv}
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise FileError(f"export {path}: unknown format. Remedy: end the name in {', '.join(writers)}.")
    try:
        writer(plot, path)
    except OSError as error:
        raise FileError(f"export {path}: cannot be written ({error}). Remedy: choose another folder.") from error
    if not path.is_file():
        raise FileError(f"export {path}: cannot be written. Remedy: choose another folder.")


def _png(plot: Plot, path: Path) -> None:
    from pyqtgraph.exporters import ImageExporter

    exporter = ImageExporter(plot.item)
    exporter.parameters()["width"] = PNG_WIDTH
    exporter.export(str(path))


def _svg(plot: Plot, path: Path) -> None:
    from PySide6.QtCore import QRect
    from PySide6.QtGui import QPainter
    from PySide6.QtSvg import QSvgGenerator

    size = plot.view.size()
    drawing = QSvgGenerator()
    drawing.setFileName(str(path))
    drawing.setSize(size)
    drawing.setViewBox(QRect(0, 0, size.width(), size.height()))
    drawing.setTitle(f"{plot.y.name} against {plot.x.name}")
    painter = QPainter(drawing)
    plot.view.render(painter)
    painter.end()


def _csv(plot: Plot, path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        y = plot.y.column
        table.writerow(["series", plot.x.column, y, f"{y}_low", f"{y}_high"])
        for name, x, values, low, high in plot.table():
            lows = [""] * x.size if low is None else [f"{value:.9g}" for value in low]
            highs = [""] * x.size if high is None else [f"{value:.9g}" for value in high]
            for row in zip(x, values, lows, highs, strict=True):
                table.writerow([name, f"{row[0]:.9g}", f"{row[1]:.9g}", row[2], row[3]])
