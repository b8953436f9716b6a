"""One run in one picture: F_r, P_a against time (EML Fig. 2a) and retraction (2b), the model over it (5b)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from analysis.figures.style import BLACK, BLUE, GREY, ORANGE, canvas, encode, plain, save, thin
from analysis.numerics import Array, running_mean
from analysis.pipeline import Analysis
from analysis.run import Run
from model.prediction import Prediction

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


OFFSETS = {1: (-9, 8), 2: (-9, 6), 3: (0, -15), 4: (10, 8), 5: (0, -14), 6: (-10, 8)}
"""Where each number stands beside its point, in points, so that moments close in time stay legible."""


LABEL = {"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
"""Keeps a label legible over a line."""


def overview(run: Run, analysis: Analysis, prediction: Prediction | None, path: Path) -> None:
    """Draw one run and save it; the ending of ``path`` chooses PNG, SVG or PDF.

    Parameters
    ----------
    run, analysis
        The run and its analysis. Parts that are missing are left out: no pressure axis without pressure.
    prediction
        Drawn dashed over the curve, or ``None``.
    path
        Where to write.
    """
    with canvas(7.2, 7.4) as figure:
        draw_overview(figure, run, analysis, prediction)
        save(figure, path)


def overview_bytes(run: Run, analysis: Analysis, prediction: Prediction | None, kind: str = "png") -> bytes:
    """Return the same picture as bytes."""
    with canvas(7.2, 7.4) as figure:
        draw_overview(figure, run, analysis, prediction)
        return encode(figure, kind)


ANCHORED = {"free": ", $P_0$ at $V_0$", "start": ", $P_0$ at $z_0$", "vented": ", vented", "measured": ", as measured"}
"""What the gas law of a prediction starts from; in contact the chamber is smaller than V_0 (EML Eq. 6)."""


def draw_overview(figure: Figure, run: Run, analysis: Analysis, prediction: Prediction | None) -> None:
    """Draw both panels into a figure: force and pressure of a test, the fit of a test of the chamber alone."""
    from analysis.figures.fit_picture import chamber_picture, draw_fit

    fit = chamber_picture(run, analysis)
    if fit is not None:
        draw_fit(figure, fit)
        return
    above, below = figure.subplots(2, 1, height_ratios=[1, 1.25])
    draw_against_time(above, run, analysis)
    if analysis.curve is None:
        below.set_axis_off()
        reason = next(iter(analysis.features.missing.values()), "no retraction")
        below.text(0.5, 0.5, f"No curve: {reason}", ha="center", va="center", transform=below.transAxes)
    else:
        _against_retraction(below, run, analysis, prediction)


def _force_axis(axes: Axes) -> None:
    axes.set_ylabel(r"Reaction force $F_r$ [N]", color=BLUE)
    axes.tick_params(axis="y", colors=BLUE)
    axes.axhline(0, color=GREY, linewidth=0.7, zorder=1)


def _pressure_axis(axes: Axes) -> Axes:
    twin = axes.twinx()
    twin.set_ylabel(r"Air pressure $P_a$ [kPa]", color=ORANGE)
    twin.tick_params(axis="y", colors=ORANGE)
    twin.grid(visible=False)
    return twin


def _smooth(values: Array, rate: float) -> Array:
    return running_mean(values, max(1, round(0.02 * rate)))


def draw_against_time(axes: Axes, run: Run, analysis: Analysis) -> None:
    """Draw force and pressure of a whole run against time, with the six moments of EML Fig. 2."""
    axes.set_title(plain(run.name), loc="left", pad=18)  # above the words of the six moments
    axes.plot(*thin(run.time, analysis.force), color=BLUE, linewidth=1.0)
    _force_axis(axes)
    axes.set_xlabel("Time t [s]")
    axes.margins(x=0.01, y=0.16)
    if run.pressure is not None:
        pressure = _smooth(run.pressure, run.rate) * 1e-3
        _pressure_axis(axes).plot(*thin(run.time, pressure), color=ORANGE, linewidth=1.0)
    places = markers(run, analysis)
    for number, (index, name) in places.items():
        del name
        axes.plot(index / run.rate, analysis.force[int(index)], "o", color=BLACK, markersize=3, zorder=5)
        axes.annotate(
            str(number),
            (index / run.rate, analysis.force[int(index)]),
            xytext=OFFSETS[number],
            textcoords="offset points",
            ha="center",
            fontsize=8,
            fontweight="bold",
            bbox={"boxstyle": "circle,pad=0.18", "facecolor": "white", "edgecolor": BLACK, "linewidth": 0.7},
            zorder=6,
        )
    words = "   ".join(f"{number} {name}" for number, (_, name) in places.items())
    axes.text(0.0, 1.02, words, transform=axes.transAxes, ha="left", va="bottom", fontsize=7.5, color="#333333")


def markers(run: Run, analysis: Analysis) -> dict[int, tuple[float, str]]:
    """Return the six moments of EML Fig. 2 that the run holds: number -> (sample index, name)."""
    work = analysis.work
    found: dict[int, tuple[float, str]] = {}
    if "contact" in work.details:
        found[1] = (float(work.contact_start), "contact")
    if "preload" in work.details and "index" in work.details["preload"]:
        found[2] = (float(np.asarray(work.details["preload"]["index"])), "preload")
    if work.windows.pressurize is not None:
        found[3] = (float(work.windows.pressurize[0]), "pressurize")
    if work.windows.retraction is not None:
        found[4] = (float(work.windows.retraction[0]), "retract")
    if "pull-off" in work.details:
        found[5] = (work.peak, "pull-off")
    if "detachment" in work.details:
        found[6] = (work.release, "detach")
    return found


def _against_retraction(axes: Axes, run: Run, analysis: Analysis, prediction: Prediction | None) -> None:
    curve = analysis.curve
    assert curve is not None
    lines = axes.plot(*thin(curve.retraction * 1e3, curve.force), color=BLUE, label=r"$F_r$ measured")
    _force_axis(axes)
    axes.set_xlabel(r"Retraction $z_r$ [mm]")
    twin = None
    if curve.pressure is not None:
        twin = _pressure_axis(axes)
        smooth = _smooth(curve.pressure, run.rate) * 1e-3
        lines += twin.plot(*thin(curve.retraction * 1e3, smooth), color=ORANGE, label=r"$P_a$ measured")
    if prediction is not None and prediction.retraction.size:
        stable = prediction.stable
        place = prediction.retraction[stable] * 1e3
        label = rf"$F_r$ model ({prediction.model})"
        force = np.append(prediction.force[stable], 0.0)
        lines += axes.plot(np.append(place, place[-1]), force, "--", color=BLACK, linewidth=1.2, label=label)
        if twin is not None:
            label = f"$P_a$ model{ANCHORED.get(prediction.assumptions.get('gas anchor', ''), '')}"
            lines += twin.plot(place, prediction.pressure[stable] * 1e-3, ":", color=BLACK, linewidth=1.4, label=label)
    _limits(axes, analysis, prediction)
    _annotate(axes, twin or axes, analysis)
    axes.legend(handles=lines, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(lines))


def _limits(axes: Axes, analysis: Analysis, prediction: Prediction | None) -> None:
    curve = analysis.curve
    assert curve is not None
    last = analysis.features.value("pull_off_distance_m")
    last = float(curve.retraction.max()) if np.isnan(last) else last
    if prediction is not None and np.isfinite(prediction.pull_off_distance):
        last = max(last, prediction.pull_off_distance)
    first = max(float(curve.retraction.min()), -0.35 * last)
    axes.set_xlim((first - 0.03 * last) * 1e3, 1.22 * last * 1e3)
    seen = curve.force[curve.retraction >= first]
    low, high = float(seen.min()), float(seen.max())
    if prediction is not None and np.isfinite(prediction.pull_off_force):
        low = min(low, -prediction.pull_off_force)
    axes.set_ylim(low - 0.16 * (high - low), high + 0.08 * (high - low))


def _annotate(axes: Axes, foremost: Axes, analysis: Analysis) -> None:
    """Mark F_p and D_p on the force; the words stand on the foremost axes, above every curve."""
    features = analysis.features
    if "pull_off_force_N" in features:
        force, place = features.value("pull_off_force_N"), features.value("retraction_at_pull_off_m") * 1e3
        axes.plot(place, -force, "v", color=BLACK, markersize=6, zorder=6)
        foremost.annotate(
            rf"$F_p$ = {features['pull_off_force_N']}",
            (place, -force),
            xytext=(0, -9),
            xycoords=axes.transData,
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=8,
            bbox=LABEL,
        )
    if "pull_off_distance_m" in features:
        distance = features.value("pull_off_distance_m") * 1e3
        axes.plot(distance, 0, "|", color=BLACK, markersize=10, zorder=6)
        foremost.annotate(
            rf"$D_p$ = {features['pull_off_distance_m']}",
            (distance, 0),
            xytext=(-4, 5),
            xycoords=axes.transData,
            textcoords="offset points",
            ha="right",
            va="bottom",
            fontsize=8,
            bbox=LABEL,
        )
