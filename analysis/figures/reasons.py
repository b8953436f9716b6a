"""Why the analysis decided as it did: one run's tare, contact point, peak and detachment, close up."""

from __future__ import annotations

from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from analysis.figures.style import BLACK, BLUE, CYCLE, GREEN, GREY, ORANGE, canvas, encode, mark_emulated, thin
from analysis.numerics import LocalFit, running_mean
from analysis.pipeline import Analysis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def reasons(analysis: Analysis, kind: str = "png") -> bytes:
    """Return the picture as bytes; panels whose step failed say why."""
    with canvas(8.4, 5.6) as figure:
        draw_reasons(figure, analysis)
        return encode(figure, kind)


def draw_reasons(figure: Figure, analysis: Analysis) -> None:
    """Draw the four panels."""
    panels = figure.subplots(2, 2).ravel()
    drawers = (("tare", _tare), ("contact", _contact), ("pull-off", _peak), ("detachment", _detachment))
    for axes, (step, drawer) in zip(panels, drawers, strict=True):
        if step in analysis.work.details:
            drawer(axes, analysis)
        else:
            axes.set_axis_off()
            words = f"{step}: {analysis.work.failed.get(step, 'does not belong to this protocol')}"
            axes.text(0.5, 0.5, words, ha="center", va="center", wrap=True, transform=axes.transAxes, fontsize=8)
    if analysis.run.emulated:
        mark_emulated(figure)


def _title(axes: Axes, step: str, decision: object) -> None:
    axes.set_title(fill(f"{step}: {decision}", 56), loc="left", fontsize=8.5)


def _tare(axes: Axes, analysis: Analysis) -> None:
    run, work = analysis.run, analysis.work
    details, baseline = work.details["tare"], work.baseline
    center = float(baseline(0.0))
    line = baseline(np.arange(run.force.size, dtype=np.float64)) - center
    fitted = (work.force + line) * 1e3  # what the line was fitted to: with creep put back
    axes.plot(*thin(run.time, fitted), color=GREY, linewidth=0.6)
    windows = details["windows"]
    assert isinstance(windows, list)
    for start, stop in windows:
        axes.plot(*thin(run.time[start:stop], fitted[start:stop], 500), color=BLUE, linewidth=0.8)
    axes.plot(run.time[[0, -1]], line[[0, -1]] * 1e3, color=ORANGE)
    noise = 1e3 * work.noise.sigma
    axes.set_ylim(1e3 * float(line.min()) - 8 * noise, 1e3 * float(line.max()) + 8 * noise)
    _title(axes, "Tare", details["decision"])
    axes.set_xlabel("Time [s]")
    axes.set_ylabel("Force minus tare [mN]")


def _contact(axes: Axes, analysis: Analysis) -> None:
    details = analysis.work.details["contact"]
    separation, force = np.asarray(details["separation"]), np.asarray(details["force"])
    origin = analysis.features.value("contact_height_m")
    near = 1e6 * max(20 * analysis.features.value("contact_spread_m"), 0.01 * float(np.ptp(separation)))
    place = (separation - origin) * 1e6
    shown = (force < 0.3 * force.max()) & (np.abs(place) < near)
    axes.plot(place[shown], force[shown] * 1e3, ".", color=GREY, markersize=2)
    methods = details["methods"]
    assert isinstance(methods, dict)
    for (name, place), color in zip(methods.items(), CYCLE, strict=False):
        axes.axvline(
            (place - origin) * 1e6, color=color, linewidth=1.2, label=f"{name}: {(place - origin) * 1e6:+.1f} µm"
        )
    axes.axvline(0, color=BLACK, linestyle=":", linewidth=1.2)
    _title(axes, "Contact", details["decision"])
    axes.set_xlim(-near, near)
    axes.set_xlabel("Separation from contact [µm]")
    axes.set_ylabel("Force [mN]")
    axes.legend(  # away from the zero force on this side, and mostly from the lines in the middle
        loc="upper right" if sum(axes.get_ylim()) > 0 else "lower right",
        fontsize=6.5,
        handlelength=0.8,
        frameon=True,
        framealpha=1.0,
        edgecolor="none",
    )


def _peak(axes: Axes, analysis: Analysis) -> None:
    work, details = analysis.work, analysis.work.details["pull-off"]
    fit = details["fit"]
    assert isinstance(fit, LocalFit)
    width = fit.stop - fit.start
    start, stop = max(0, fit.start - width), min(work.force.size, fit.stop + width)
    time = np.arange(start, stop) / analysis.run.rate
    axes.plot(*thin(time, work.force[start:stop] * 1e3), color=GREY, linewidth=0.6)
    inside = np.linspace(fit.start, fit.stop - 1, 200)
    axes.plot(inside / analysis.run.rate, fit.polynomial(inside) * 1e3, color=ORANGE)
    axes.plot(work.peak / analysis.run.rate, fit(work.peak) * 1e3, "v", color=BLACK)
    _title(axes, "Pull-off", details["decision"])
    axes.set_xlabel("Time [s]")
    axes.set_ylabel("Force [mN]")


def _detachment(axes: Axes, analysis: Analysis) -> None:
    work, rate = analysis.work, analysis.run.rate
    duration = analysis.features.value("snap_duration_s")
    reach = round(max(0.05, 5 * (0.0 if np.isnan(duration) else duration)) * rate)
    start, stop = max(0, int(work.release) - reach), min(work.force.size, int(work.release) + reach)
    time = (np.arange(start, stop) - work.release) / rate * 1e3
    axes.plot(time, work.force[start:stop] * 1e3, ".-", color=BLUE, markersize=3, linewidth=0.6)
    smooth = running_mean(work.force[start:stop], max(1, round(0.005 * rate)))
    axes.plot(time, smooth * 1e3, color=GREEN, linewidth=0.8)
    axes.axvline(0, color=BLACK, linestyle=":")
    axes.axhline(0, color=GREY, linewidth=0.7)
    _title(axes, "Detachment", work.details["detachment"]["decision"])
    axes.set_xlabel("Time from detachment [ms]")
    axes.set_ylabel("Force [mN]")
