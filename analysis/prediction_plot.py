"""A predicted pull-off test as a picture: F_r and P_a against retraction."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from model.prediction import Prediction

FORCE, PRESSURE = "#0072B2", "#D55E00"  # colour-blind safe


def draw_prediction(prediction: Prediction, title: str, path: Path) -> None:
    """Write force and pressure against retraction to ``path``, peak and detachment marked."""
    from matplotlib.figure import Figure

    from analysis.figures.style import format_of, plain

    kind = format_of(path)
    figure = Figure(figsize=(7, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.set_title(f"{plain(title)} - {prediction.label}")
    axes.set_xlabel("retraction $z_r$ (mm)")
    axes.set_ylabel("reaction force $F_r$ (N), compression positive", color=FORCE)
    if prediction.position.size == 0:
        axes.text(0.5, 0.5, prediction.outcome.value, ha="center", va="center", transform=axes.transAxes)
    else:
        _draw_profile(prediction, axes)
    figure.savefig(path, dpi=150, format=kind)


def _draw_profile(prediction: Prediction, axes) -> None:  # type: ignore[no-untyped-def]
    retraction = prediction.retraction * 1e3
    axes.axhline(0, color="0.7", linewidth=0.8)
    axes.plot(retraction, prediction.force, color=FORCE)
    axes.plot([retraction[-1]] * 2, [prediction.force[-1], 0], color=FORCE, linestyle=":")
    axes.plot(prediction.retraction_at_pull_off * 1e3, -prediction.pull_off_force, "o", color=FORCE)
    axes.annotate(
        f"$F_p$ = {prediction.pull_off_force:.4f} N",
        (prediction.retraction_at_pull_off * 1e3, -prediction.pull_off_force),
        xytext=(8, -14),
        textcoords="offset points",
    )
    axes.annotate(
        f"$D_p$ = {prediction.pull_off_distance * 1e3:.3f} mm",
        (retraction[-1], 0),
        xytext=(-4, 6),
        textcoords="offset points",
        ha="right",
    )
    # The compressive start of a small sphere would dwarf the adhesion.
    axes.set_ylim(-1.25 * prediction.pull_off_force, 1.0 * prediction.pull_off_force)
    axes.set_xlim(max(retraction[0], -0.5 * retraction[-1]), 1.08 * retraction[-1])
    right = axes.twinx()
    right.plot(retraction, prediction.pressure * 1e-3, color=PRESSURE, linestyle="--")
    right.set_ylabel("pressure $P_a$ (kPa, gauge)", color=PRESSURE)
