"""The papers' model figures: EML 5d to 5f, 6a to 6i, and SI S8."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.figures.parts import (
    PAPER_MEMBRANE,
    Series,
    draw_model,
    frame_profile,
    kilopascal,
    profile_axes,
    scene,
    shades,
)
from analysis.figures.registry import Material, paper_figure
from analysis.figures.style import BLUE, GREY, MARKERS, ORANGE
from model.parameters import Gripper, Parameters
from model.prediction import Outcome, Prediction

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DIAMETERS = np.array([8, 10, 12, 15, 20, 25, 30, 32, 40, 50, 60]) * 1e-3
"""Sphere diameters of EML Fig. 5d and 5e, m."""

FIG_6_PRESSURE = 0.0
"""P_0 of EML Fig. 6a to 6g, Pa; the paper does not state it, zero is the default of PNAS Fig. 4."""

WORKS = np.array([0.1, 1.0, 3.0, 5.0, 7.0, 9.0])
THICKNESSES = np.array([0.1, 0.2, 0.4, 0.6, 0.8, 1.0]) * 1e-3
FIG_6_DIAMETERS = np.array([12, 20, 30, 45, 60]) * 1e-3


def _profiles(
    figure: Figure,
    material: Material,
    scenes: Sequence[tuple[str, Parameters]],
    *,
    legend: str,
    from_zero: bool = False,
) -> tuple[pd.DataFrame, Axes]:
    axes = figure.subplots()
    series = Series()
    for (label, parameters), color in zip(scenes, shades(len(scenes)), strict=True):
        prediction = material.predict(parameters)
        label_shown = label if prediction.stable.any() else ""
        draw_model(axes, prediction, color, label_shown, series, style="-", name=label, from_zero=from_zero)
    profile_axes(axes)
    frame_profile(axes)
    axes.legend(title=legend, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return series.frame(), axes


def _by_diameter(figure: Figure, material: Material, pressure: float) -> pd.DataFrame:
    scenes = [(f"{d * 1e3:g} mm", scene(float(d), pressure)) for d in DIAMETERS]
    data, axes = _profiles(figure, material, scenes, legend="$d_b$")
    axes.set_title(f"$P_0$ = {kilopascal(pressure)}", loc="left")
    return data


@paper_figure("5d", "EML 5d: model profiles by sphere diameter, P_0 = +1 kPa")
def figure_5d(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z_r for sphere diameters from 8 to 60 mm."""
    return _by_diameter(figure, material, 1e3)


@paper_figure("5e", "EML 5e: model profiles by sphere diameter, P_0 = -1 kPa")
def figure_5e(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z_r for sphere diameters from 8 to 60 mm."""
    return _by_diameter(figure, material, -1e3)


@paper_figure("5f", "EML 5f: model pull-off distance against sphere diameter")
def figure_5f(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw D_p against d_b at P_0 = +1 and -1 kPa, with the maxima marked."""
    axes, series = figure.subplots(), Series()
    diameters = np.concatenate([np.arange(8.0, 45.0, 1.0), np.arange(45.0, 61.0, 2.5)]) * 1e-3
    for pressure, color, marker, published in ((1e3, BLUE, "o", "8 %"), (-1e3, ORANGE, "s", "26 %")):
        distances = np.array([_distance(material.predict(scene(float(d), pressure))) for d in diameters])
        label = f"$P_0$ = {kilopascal(pressure)}"
        if np.isfinite(distances).any():
            best = int(np.nanargmax(distances))
            axes.plot(diameters[best] * 1e3, distances[best] * 1e3, marker, color=color)
            drop = 100 * (1 - distances[-1] / distances[best])
            label += f": max. at {diameters[best] * 1e3:.0f} mm, {drop:.0f} % less at 60 mm"
        axes.plot(diameters * 1e3, distances * 1e3, "-", color=color, label=f"{label} (EML: 32 mm, {published})")
        series.add(kilopascal(pressure), f"model {material.model}", diameter_m=diameters, pull_off_distance_m=distances)
    axes.axvline(32, color=GREY, linestyle=":", linewidth=1.0, label="maximum in EML 2020")
    axes.set_xlabel("Sphere diameter $d_b$ [mm]")
    axes.set_ylabel("Pull-off distance $D_p$ [mm]")
    axes.legend(loc="lower right", fontsize=7, frameon=True, framealpha=1.0, edgecolor="none")
    return series.frame()


def _distance(prediction: Prediction) -> float:
    return prediction.pull_off_distance if prediction.outcome is Outcome.PULL_OFF else np.nan


def _force(prediction: Prediction) -> float:
    return prediction.pull_off_force if prediction.outcome is Outcome.PULL_OFF else np.nan


def _fig_6_scene(diameter: float, *, work: float = 4.0, thickness: float = 200e-6) -> Parameters:
    membrane = replace(PAPER_MEMBRANE, work_of_adhesion=work, thickness=thickness)
    return scene(diameter, FIG_6_PRESSURE, membrane=membrane)


def _feature_lines(
    figure: Figure,
    material: Material,
    values: np.ndarray[tuple[int], np.dtype[np.float64]],
    build: Callable[[float, float], Parameters],
    read: Callable[[Prediction], float],
    x: tuple[str, str, float],
    y: tuple[str, str, float],
) -> pd.DataFrame:
    """One line per sphere diameter; ``x`` and ``y`` are (label, column, factor for display)."""
    axes, series = figure.subplots(), Series()
    colors = shades(FIG_6_DIAMETERS.size)
    for diameter, color, marker in zip(FIG_6_DIAMETERS, colors, MARKERS, strict=False):
        found = np.array([read(material.predict(build(float(diameter), float(value)))) for value in values])
        label = f"{diameter * 1e3:g} mm"
        axes.plot(values * x[2], found * y[2], marker=marker, markersize=3.5, color=color, label=label)
        series.add(label, f"model {material.model}", **{x[1]: values, y[1]: found})
    axes.set_xlabel(x[0])
    axes.set_ylabel(y[0])
    axes.legend(title="$d_b$", loc="center left", bbox_to_anchor=(1.0, 0.5))
    return series.frame()


WORK_AXIS = (r"Work of adhesion $\omega_a$ [J/m²]", "work_of_adhesion_J_m2", 1.0)
THICKNESS_AXIS = ("Thickness $h_0$ [mm]", "thickness_m", 1e3)
FORCE_AXIS = ("Pull-off force $F_p$ [N]", "pull_off_force_N", 1.0)
DISTANCE_AXIS = ("Pull-off distance $D_p$ [mm]", "pull_off_distance_m", 1e3)
MANY_WORKS = np.array([0.1, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0])
MANY_THICKNESSES = np.array([0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0]) * 1e-3


def _with_work(diameter: float, work: float) -> Parameters:
    return _fig_6_scene(diameter, work=work)


def _with_thickness(diameter: float, thickness: float) -> Parameters:
    return _fig_6_scene(diameter, thickness=thickness)


@paper_figure("6a", "EML 6a: model profiles by work of adhesion, d_b = 30 mm")
def figure_6a(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z_r for works of adhesion from 0.1 to 9 J/m^2."""
    scenes = [(f"{w:g} J/m²", _with_work(30e-3, float(w))) for w in WORKS]
    return _profiles(figure, material, scenes, legend=r"$\omega_a$")[0]


@paper_figure("6b", "EML 6b: model pull-off force against work of adhesion")
def figure_6b(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_p against omega_a for sphere diameters from 12 to 60 mm."""
    return _feature_lines(figure, material, MANY_WORKS, _with_work, _force, WORK_AXIS, FORCE_AXIS)


@paper_figure("6c", "EML 6c: model pull-off distance against work of adhesion")
def figure_6c(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw D_p against omega_a for sphere diameters from 12 to 60 mm."""
    return _feature_lines(figure, material, MANY_WORKS, _with_work, _distance, WORK_AXIS, DISTANCE_AXIS)


@paper_figure("6d", "EML 6d: model profiles by membrane thickness, d_b = 30 mm")
def figure_6d(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z_r for thicknesses from 0.1 to 1 mm."""
    scenes = [(f"{h * 1e3:g} mm", _with_thickness(30e-3, float(h))) for h in THICKNESSES]
    return _profiles(figure, material, scenes, legend="$h_0$")[0]


@paper_figure("6e", "EML 6e: model pull-off force against membrane thickness")
def figure_6e(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_p against h_0 for sphere diameters from 12 to 60 mm."""
    return _feature_lines(figure, material, MANY_THICKNESSES, _with_thickness, _force, THICKNESS_AXIS, FORCE_AXIS)


@paper_figure("6f", "EML 6f: model pull-off distance against membrane thickness")
def figure_6f(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw D_p against h_0 for sphere diameters from 12 to 60 mm."""
    return _feature_lines(figure, material, MANY_THICKNESSES, _with_thickness, _distance, THICKNESS_AXIS, DISTANCE_AXIS)


@paper_figure("6g", "EML 6g: model profiles by membrane thickness, d_b = 60 mm")
def figure_6g(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z_r for thicknesses from 0.1 to 1 mm."""
    scenes = [(f"{h * 1e3:g} mm", _with_thickness(60e-3, float(h))) for h in THICKNESSES]
    return _profiles(figure, material, scenes, legend="$h_0$")[0]


def _disks(figure: Figure, material: Material, pressure: float) -> pd.DataFrame:
    diameters = np.arange(8, 16) * 1e-3
    scenes = [(f"{d * 1e3:g} mm", scene(float(d), pressure, flat=True)) for d in diameters]
    data, axes = _profiles(figure, material, scenes, legend="$d_b$ (disk)", from_zero=True)
    axes.set_xlabel("Retraction from $z$ = 0 [mm]")
    axes.set_title(f"$P_0$ = {kilopascal(pressure)}", loc="left")
    return data


@paper_figure("6h", "EML 6h: model profiles on flat disks, P_0 = +1 kPa")
def figure_6h(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z for flat disks of 8 to 15 mm diameter; 15 mm is wider than the contact can be.

    Here the paper counts D_p from z = 0, not from the zero of the force: it is the same for every disk.
    """
    return _disks(figure, material, 1e3)


@paper_figure("6i", "EML 6i: model profiles on flat disks, P_0 = -1 kPa")
def figure_6i(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z for flat disks of 8 to 15 mm diameter."""
    return _disks(figure, material, -1e3)


@paper_figure("S8", "SI S8: model profiles on flat glass by effective contact radius", (8.6, 3.8))
def figure_s8(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z_r on flat glass for r_e from 5 to 8 mm, and the beginning of the retraction for r_e = 8 mm.

    At r_e = R_0 the free annulus vanishes and the published difference scheme shows small instabilities; here the
    derivatives are exact and the curve is smooth.
    """
    whole, begin = figure.subplots(1, 2)
    series = Series()
    radii = (5.0, 6.0, 7.0, 7.3, 7.6, 8.0)
    for radius, color in zip(radii, shades(len(radii)), strict=True):
        gripper = Gripper(effective_radius=min(radius, 7.9999) * 1e-3)
        prediction = material.predict(scene(None, 0.0, gripper=gripper), "cone-2017")
        draw_model(whole, prediction, color, f"{radius:g} mm", series, style="-")
        if radius == 8.0:
            first = prediction.stable & (prediction.retraction < prediction.retraction.min() + 20e-6)
            place, force = prediction.retraction[first], prediction.force[first]
            begin.plot(place * 1e3, force, ".-", color=color)
    for axes in (whole, begin):
        profile_axes(axes)
    whole.legend(title="$r_e$", loc="upper right", bbox_to_anchor=(0.95, 0.95))
    whole.set_title("A", loc="left")
    begin.set_title("B  beginning, $r_e$ = 8 mm", loc="left")
    return series.frame()
