"""Pictures of the accuracy report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axis import Axis

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
FLOOR = 1e-17
"""Errors below this are drawn here: the solver and the reference agree to the last bit."""


def work_precision(
    table: pd.DataFrame,
    errors: Sequence[tuple[str, str]],
    path: Path,
    *,
    work: str = "evaluations of the energy or its derivatives",
) -> None:
    """Draw error against run time and against ``work``, the column evaluations, one row of panels per quantity.

    The table has the columns method, median_s, lower_s, upper_s, evaluations and one per error (relative); the second
    of each pair in ``errors`` is its label.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 3.6 * len(errors)), layout="constrained")
    axes = figure.subplots(len(errors), 2, squeeze=False, sharex="col")
    for row, (column, label) in zip(axes, errors, strict=True):
        for k, (method, part) in enumerate(table.groupby("method", sort=False)):
            style = {"color": COLOURS[k % 7], "marker": MARKERS[k % 7], "markersize": 5, "label": str(method)}
            error = part[column].clip(lower=FLOOR)
            spread = [part["median_s"] - part["lower_s"], part["upper_s"] - part["median_s"]]
            row[0].errorbar(part["median_s"], error, xerr=spread, elinewidth=0.8, **style)
            row[1].plot(part["evaluations"], error, **style)
        for panel in row:
            panel.set(xscale="log", yscale="log", ylabel=label)
            panel.grid(alpha=0.3)
    axes[-1][0].set_xlabel("run time (s), median and quartiles")
    axes[-1][1].set_xlabel(work)
    axes[0][1].legend(fontsize=8)
    for panel in axes.flat:
        _label_decades(panel.xaxis)
        _label_decades(panel.yaxis)
    figure.savefig(path, dpi=110)


def _label_decades(axis: Axis) -> None:
    """Label the decades alone where several are in view, also 2 and 5 where not: all parts of one would overlap."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = sorted(axis.get_view_interval())
    if high >= 100 * low:
        axis.set_minor_formatter(NullFormatter())
    else:
        axis.set_minor_locator(LogLocator(subs=(2, 5)))
        for format_with in (axis.set_major_formatter, axis.set_minor_formatter):
            format_with(FuncFormatter(lambda value, _: f"{value:g}"))


def limits(panels: Sequence[tuple[str, str, str, pd.DataFrame]], path: Path) -> None:
    """Draw deviations against a parameter; a panel is (title, x label, y label, table with x, y and series)."""
    from matplotlib.figure import Figure

    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.2 * columns, 3.3 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flat
    for axis, (title, x_label, y_label, table) in zip(axes, panels, strict=False):
        for k, (series, part) in enumerate(table.groupby("series", sort=False)):
            y = part["y"].clip(lower=FLOOR)
            axis.loglog(part["x"], y, MARKERS[k % 7] + "-", color=COLOURS[k % 7], markersize=3.5, label=str(series))
        axis.set(title=title, xlabel=x_label, ylabel=y_label)
        if table["y"].max() < 10 * table["y"].min():  # less than a decade: plain numbers
            axis.set_yscale("linear")
        axis.grid(alpha=0.3)
        if table["series"].nunique() > 1:
            axis.legend(fontsize=7)
    for axis in list(axes):
        axis.set_visible(False)
    figure.savefig(path, dpi=110)


def scatter(table: pd.DataFrame, x: tuple[str, str], y: tuple[str, str], path: Path) -> None:
    """Draw one column against another on logarithmic axes with the diagonal."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 4), layout="constrained")
    axis = figure.subplots()
    for k, (series, part) in enumerate(table.groupby("series", sort=False)):
        axis.loglog(
            part[x[0]].clip(lower=FLOOR), part[y[0]].clip(lower=FLOOR), ".", color=COLOURS[k % 7], label=str(series)
        )
    low, high = axis.get_xlim()
    axis.plot([low, high], [low, high], "k--", linewidth=0.8, label="equal")
    axis.set(xlabel=x[1], ylabel=y[1])
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    figure.savefig(path, dpi=110)
