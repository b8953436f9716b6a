"""A fit in one picture: what was measured with the fitted line through it, and what the line leaves over."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from analysis.chamber import BoyleFit, Leak
from analysis.figures.style import BLUE, GREY, ORANGE, canvas, mark_emulated, plain, save, thin
from analysis.numerics import Array, block_means, running_mean
from analysis.pipeline import Analysis
from analysis.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class FitPicture:
    """What a fit's picture shows, in the units of its labels.

    Attributes
    ----------
    x, y
        (n,), measured.
    line
        (n,), fitted, at ``x``.
    result
        The outcome in words, written above the picture.
    residual_label, residual_scale
        The lower panel shows (y - line) times the scale.
    joined
        Draw the measurement as a line, not as points.
    emulated
        Whether the instruments were.
    """

    title: str
    result: str
    x: Array
    y: Array
    line: Array
    x_label: str
    y_label: str
    residual_label: str
    residual_scale: float = 1.0
    joined: bool = False
    emulated: bool = False


def draw_fit(figure: Figure, content: FitPicture) -> None:
    """Draw measurement and line above, residuals below."""
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1])
    style = {"linewidth": 1.0} if content.joined else {"linestyle": "none", "marker": "o", "markersize": 3.5}
    order = np.argsort(content.x, kind="stable")
    above.plot(*_shown(content, content.y), color=BLUE, label="measured", **style)
    above.plot(content.x[order], content.line[order], color=ORANGE, linewidth=1.1, label="fit")
    above.set_title(plain(content.title), loc="left")
    above.set_ylabel(content.y_label)
    above.legend(loc="best", title=content.result)
    residual = np.asarray((content.y - content.line) * content.residual_scale, dtype=np.float64)
    below.axhline(0.0, color=GREY, linewidth=0.7, zorder=1)
    below.plot(*_shown(content, residual), color=BLUE, **style)
    below.set_xlabel(content.x_label)
    below.set_ylabel(content.residual_label)
    figure.align_ylabels([above, below])
    if content.emulated:
        mark_emulated(figure)


def _shown(content: FitPicture, y: Array) -> tuple[Array, Array]:
    return thin(content.x, y) if content.joined else (content.x, y)


def save_fit(content: FitPicture, path: Path) -> None:
    """Save the picture; the ending of ``path`` chooses PNG, SVG or PDF."""
    with canvas(7.2, 5.4) as figure:
        draw_fit(figure, content)
        save(figure, path)


def chamber_picture(run: Run, analysis: Analysis) -> FitPicture | None:
    """Return the picture of a volume or leak test, or ``None`` where the fit is missing."""
    details = analysis.work.details.get(run.protocol, {})
    if run.pressure is None:
        return None
    if run.protocol == "volume" and run.pump_volume is not None and isinstance(fit := details.get("fit"), BoyleFit):
        length = max(1, round(0.05 * run.rate))
        pressure, pumped = block_means(run.pressure, length), block_means(run.pump_volume, length)
        return FitPicture(
            title=run.name,
            result=f"$V_0$ = {analysis.features['chamber_volume_m3']}",
            x=pressure * 1e-3,
            y=pumped * 1e6,
            line=(pumped - fit.residual) * 1e6,
            x_label=r"Air pressure $P_a$ [kPa]",
            y_label="Volume pumped in [mL]",
            residual_label="Residual [µL]",
            residual_scale=1e3,
            emulated=run.emulated,
        )
    step = run.step("hold")
    if run.protocol == "leak" and step is not None and isinstance(leak := details.get("leak"), Leak):
        part = slice(step.start, step.stop)
        time = np.asarray(run.time[part] - run.time[step.start], dtype=np.float64)
        pressure = running_mean(run.pressure[part], max(1, round(0.1 * run.rate)))
        line = leak.rate * leak.time_constant * np.exp(-time / leak.time_constant)
        return FitPicture(
            title=run.name,
            result=f"τ = {analysis.features['leak_time_constant_s']}",
            x=time,
            y=pressure * 1e-3,
            line=line * 1e-3,
            x_label="Time since the pump stands still [s]",
            y_label=r"Air pressure $P_a$ [kPa]",
            residual_label="Residual [Pa]",
            residual_scale=1e3,
            joined=True,
            emulated=run.emulated,
        )
    return None
