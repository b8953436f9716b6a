"""One look for every picture: colours that colour-blind readers tell apart, units in every label, fixed metadata."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.errors import UnknownFormat
from analysis.numerics import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
SKY, YELLOW, BLACK, GREY = "#56B4E9", "#E69F00", "#000000", "#767676"
CYCLE = (BLUE, YELLOW, GREEN, PURPLE, ORANGE, SKY, BLACK)
"""Okabe and Ito's colours, in the order used."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X")

SETTINGS: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.spines.top": False,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 150,
    "svg.hashsalt": "rig",
    "pdf.fonttype": 42,
    "path.simplify": True,
}


@contextmanager
def canvas(width: float = 7.0, height: float = 5.0) -> Iterator[Figure]:
    """Give a figure of so many inches in the house style; the style ends with the block, so save inside it."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(SETTINGS):
        figure = Figure(figsize=(width, height))
        FigureCanvasAgg(figure)
        yield figure


def mark_emulated(figure: Figure, *, partly: bool = False) -> None:
    """Say on a picture that what it shows, or part of it, is no experiment."""
    words = "partly EMULATED, no experiment" if partly else "EMULATED, no experiment"
    figure.supxlabel(words, x=0.99, ha="right", fontsize=8, color=ORANGE, weight="bold")


FORMATS: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
"""Formats of pictures, and what of their metadata changes from one writing to the next."""


def format_of(path: Path) -> str:
    """Return the format that the ending of a picture's name asks for.

    Raises
    ------
    UnknownFormat
        It is none of ``FORMATS``.
    """
    kind = path.suffix.lstrip(".").lower() or "png"
    if kind not in FORMATS:
        raise UnknownFormat(f"picture {path}: no format {kind!r}. Remedy: end its name in .{', .'.join(FORMATS)}.")
    return kind


def save(figure: Figure, path: Path) -> None:
    """Write PNG, SVG or PDF by the ending of ``path``; same content, same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode(figure, format_of(path)))


def encode(figure: Figure, kind: str = "png") -> bytes:
    """Return the picture's bytes without dates and versions."""
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, metadata=FORMATS[kind])
    return stream.getvalue()


def plain(text: object) -> str:
    """Return a text that Matplotlib shows as it is: names of files and scenes are no formulas."""
    return str(text).replace("$", r"\$")


def thin(x: Array, y: Array, count: int = 2000) -> tuple[Array, Array]:
    """Reduce a long line to the least and largest sample of each of ``count`` stretches; it looks the same."""
    if x.size <= 4 * count:
        return x, y
    length = x.size // count
    whole = y[: count * length].reshape(count, length)
    rows = np.arange(count) * length
    keep = np.unique(np.concatenate([rows + whole.argmin(axis=1), rows + whole.argmax(axis=1), [0, x.size - 1]]))
    return x[keep], y[keep]
