"""One run in one picture: F_r, P_a against time (EML Fig. 2a) and retraction (2b), the model over it (5b)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from analysis.figures.style import BLACK, BLUE, GREY, ORANGE, canvas, encode, mark_emulated, plain, save, thin
from analysis.numerics import Array, running_mean
from analysis.pipeline import Analysis
from analysis.quantity import Quantity, with_uncertainty
from analysis.run import Run
from model.prediction import Prediction

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D


OFFSETS = {1: (-9, 8), 2: (-9, 6), 3: (0, -15), 4: (10, 8), 5: (0, -14), 6: (-10, 8)}
"""Where each number stands beside its point, in points, so that moments close in time stay legible."""


@dataclass(frozen=True, slots=True)
class Scale:
    """A unit that a figure writes its numbers in: its name and how many of it make one SI unit."""

    unit: str
    factor: float

    @classmethod
    def of_force(cls, force: Array) -> Self:
        """Return N, or mN where no force reaches 0.2 N."""
        return cls("N", 1.0) if float(np.abs(force).max(initial=0.0)) > 0.2 else cls("mN", 1e3)

    @classmethod
    def of_length(cls, length: float) -> Self:
        """Return mm, or µm below 0.1 mm."""
        return cls("mm", 1e3) if length >= 1e-4 else cls("µm", 1e6)

    def write(self, quantity: Quantity) -> str:
        """Return a quantity with its uncertainty in this unit."""
        return f"{with_uncertainty(quantity.value * self.factor, quantity.uncertainty * self.factor)} {self.unit}"


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
    if run.emulated:
        mark_emulated(figure)
    above, below = figure.subplots(2, 1, height_ratios=[1, 1.25])
    draw_against_time(above, run, analysis)
    if analysis.curve is None:
        below.set_axis_off()
        reason = next(iter(analysis.features.missing.values()), "no retraction")
        below.text(0.5, 0.5, f"No curve: {reason}", ha="center", va="center", transform=below.transAxes)
    else:
        _against_retraction(below, run, analysis, prediction)


def force_axis(axes: Axes, unit: str = "N") -> None:
    """Colour the axis of the force and draw its zero."""
    axes.set_ylabel(rf"Reaction force $F_r$ [{unit}]", color=BLUE)
    axes.tick_params(axis="y", colors=BLUE)
    axes.axhline(0, color=GREY, linewidth=0.7, zorder=1)


def pressure_axis(axes: Axes) -> Axes:
    """Return a second axis for the pressure."""
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
    scale = Scale.of_force(analysis.force)
    force = analysis.force * scale.factor
    axes.plot(*thin(run.time, force), color=BLUE, linewidth=1.0)
    force_axis(axes, scale.unit)
    axes.set_xlabel("Time t [s]")
    axes.margins(x=0.01, y=0.16)
    if run.pressure is not None:
        pressure = _smooth(run.pressure, run.rate) * 1e-3
        twin = pressure_axis(axes)
        twin.plot(*thin(run.time, pressure), color=ORANGE, linewidth=1.0)
        axes.set_zorder(twin.get_zorder() + 1)  # the numbers of the moments stand above the line of the pressure
        axes.patch.set_visible(False)
    places = markers(run, analysis)
    for number, (index, name) in places.items():
        del name
        axes.plot(index / run.rate, force[int(index)], "o", color=BLACK, markersize=3, zorder=5)
        axes.annotate(
            str(number),
            (index / run.rate, force[int(index)]),
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
    window = _window(analysis, prediction)
    newton, metre = Scale.of_force(curve.force), Scale.of_length(window[1])
    place = curve.retraction * metre.factor
    lines = axes.plot(*thin(place, curve.force * newton.factor), color=BLUE, label=r"$F_r$ measured")
    force_axis(axes, newton.unit)
    axes.set_xlabel(rf"Retraction $z_r$ [{metre.unit}]")
    twin, gas = None, None
    if curve.pressure is not None:
        twin, gas = pressure_axis(axes), _smooth(curve.pressure, run.rate) * 1e-3
        lines += twin.plot(*thin(place, gas), color=ORANGE, label=r"$P_a$ measured")
    if prediction is not None and prediction.retraction.size:
        stable = prediction.stable
        predicted = prediction.retraction[stable] * metre.factor
        label = rf"$F_r$ model ({prediction.model})"
        force = np.append(prediction.force[stable], 0.0) * newton.factor
        drop = np.append(predicted, predicted[-1])
        lines += axes.plot(drop, force, "--", color=BLACK, linewidth=1.2, label=label)
        if twin is not None:
            label = f"$P_a$ model{ANCHORED.get(prediction.assumptions.get('gas anchor', ''), '')}"
            model_gas = prediction.pressure[stable] * 1e-3
            lines += twin.plot(predicted, model_gas, ":", color=BLACK, linewidth=1.4, label=label)
    _limits(axes, analysis, prediction, window, newton, metre)
    if twin is not None and gas is not None:
        _pressure_limits(twin, gas[(curve.retraction >= window[0]) & (curve.retraction <= window[1])])
    lines += _marks(axes, analysis, newton, metre)
    axes.legend(handles=lines, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)


def _window(analysis: Analysis, prediction: Prediction | None) -> tuple[float, float]:
    """Return where the picture begins and ends, m: with the way the load train springs back at detachment."""
    curve, work = analysis.curve, analysis.work
    assert curve is not None
    last = analysis.features.value("pull_off_distance_m")
    if np.isnan(last):
        last = float(curve.retraction.max())
    else:
        after = int(work.release) - work.retraction()[0]
        last = max(last, float(curve.retraction[after : after + work.samples(0.02)].max(initial=last)))
    if prediction is not None and np.isfinite(prediction.pull_off_distance):
        last = max(last, prediction.pull_off_distance)
    return max(float(curve.retraction.min()), -0.35 * last), last


def _limits(
    axes: Axes,
    analysis: Analysis,
    prediction: Prediction | None,
    window: tuple[float, float],
    newton: Scale,
    metre: Scale,
) -> None:
    curve = analysis.curve
    assert curve is not None
    first, last = window
    axes.set_xlim((first - 0.03 * last) * metre.factor, 1.15 * last * metre.factor)
    seen = curve.force[curve.retraction >= first]
    low, high = float(seen.min()), float(seen.max())
    if prediction is not None and np.isfinite(prediction.pull_off_force):
        low = min(low, -prediction.pull_off_force)
    margin = 0.08 * (high - low)
    axes.set_ylim((low - margin) * newton.factor, (high + margin) * newton.factor)


def _pressure_limits(axes: Axes, measured: Array) -> None:
    """The measured pressure fills the axis; the model's may widen it by half on either side, and is cut off beyond."""
    if not measured.size:
        return
    low, high = float(measured.min()), float(measured.max())
    span = max(high - low, 0.1)
    bottom, top = axes.get_ylim()
    axes.set_ylim(max(bottom, low - 0.5 * span), min(top, high + 0.5 * span))


def _marks(axes: Axes, analysis: Analysis, newton: Scale, metre: Scale) -> list[Line2D]:
    """Mark F_p and D_p on the curve; their values stand in the legend, where they hide nothing."""
    features = analysis.features
    drawn: list[Line2D] = []
    if "pull_off_force_N" in features:
        place, force = features.value("retraction_at_pull_off_m"), features["pull_off_force_N"]
        label = f"$F_p$ = {newton.write(force)}"
        at = (place * metre.factor, -force.value * newton.factor)
        drawn += axes.plot(*at, "v", color=BLACK, markersize=6, zorder=6, label=label)
    if "pull_off_distance_m" in features:
        distance = features["pull_off_distance_m"]
        label = f"$D_p$ = {metre.write(distance)}"
        at = (distance.value * metre.factor, 0.0)
        drawn += axes.plot(*at, "|", color=BLACK, markersize=10, zorder=6, label=label)
    return drawn
