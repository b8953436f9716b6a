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
from analysis.numerics import Array
from model import predict
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


def _headline(axes: Axes, model: str, scenes: Sequence[Parameters]) -> None:
    """Name the model, and below it what all scenes of the picture have in common."""
    shown: list[tuple[str, Callable[[Parameters], str]]] = [
        ("$P_0$", lambda p: kilopascal(p.gas.initial_pressure) if p.gas.initial_pressure else "0 (assumed)"),
        ("$d_b$", lambda p: f"{p.substrate.diameter * 1e3:g} mm" if p.substrate.diameter else ""),
        ("$E_m$", lambda p: f"{p.membrane.youngs_modulus * 1e-6:g} MPa"),
        ("$h_0$", lambda p: f"{p.membrane.thickness * 1e3:g} mm"),
        (r"$\omega_a$", lambda p: f"{p.membrane.work_of_adhesion:g} J/m²"),
    ]
    found = [(symbol, {words(parameters) for parameters in scenes}) for symbol, words in shown]
    common = [f"{symbol} = {values.pop()}" for symbol, values in found if len(values) == 1 and all(values)]
    axes.set_title(f"model {model}\n{', '.join(common)}", loc="left", fontsize=8)


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
    _headline(axes, material.model, [parameters for _, parameters in scenes])
    return series.frame(), axes


def _by_diameter(figure: Figure, material: Material, pressure: float) -> pd.DataFrame:
    scenes = [(f"{d * 1e3:g} mm", scene(float(d), pressure)) for d in DIAMETERS]
    return _profiles(figure, material, scenes, legend="$d_b$")[0]


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
    for pressure, color, marker, published in ((1e3, BLUE, "o", "8 %"), (-1e3, ORANGE, "s", "26 %")):
        diameters, distances = _distances(material, pressure)
        label = f"$P_0$ = {kilopascal(pressure)}"
        if np.isfinite(distances).any():
            best = int(np.nanargmax(distances))
            axes.plot(diameters[best] * 1e3, distances[best] * 1e3, marker, color=color)
            drop = 100 * (1 - distances[-1] / distances[best])
            label += f": max. at {diameters[best] * 1e3:.1f} mm, {drop:.0f} % less at 60 mm"
        axes.plot(diameters * 1e3, distances * 1e3, "-", color=color, label=f"{label} (EML: 32 mm, {published})")
        series.add(kilopascal(pressure), f"model {material.model}", diameter_m=diameters, pull_off_distance_m=distances)
    axes.axvline(32, color=GREY, linestyle=":", linewidth=1.0, label="maximum in EML 2020")
    axes.set_xlabel("Sphere diameter $d_b$ [mm]")
    axes.set_ylabel("Pull-off distance $D_p$ [mm]")
    axes.legend(loc="lower right", fontsize=7, frameon=True, framealpha=1.0, edgecolor="none")
    _headline(axes, material.model, [scene(float(d), p) for d in (8e-3, 60e-3) for p in (1e3, -1e3)])
    return series.frame()


def _distances(material: Material, pressure: float) -> tuple[Array, Array]:
    """Return sphere diameters, closer about the cusp of D_p, and D_p there, m."""

    def distance(diameters: Array) -> Array:
        return np.array([_distance(material.predict(scene(float(d), pressure))) for d in diameters])

    coarse = np.arange(8.0, 61.0) * 1e-3
    found = distance(coarse)
    if not np.isfinite(found).any():
        return coarse, found
    best = float(coarse[int(np.nanargmax(found))])
    fine = best + np.linspace(-1e-3, 1e-3, 21)
    fine = fine[np.abs(fine - best) < 0.99e-3]
    diameters = np.unique(np.round(np.concatenate([coarse, fine]), 9))
    return diameters, distance(diameters)


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
    scenes: list[Parameters] = []
    for diameter, color, marker in zip(FIG_6_DIAMETERS, colors, MARKERS, strict=False):
        line = [build(float(diameter), float(value)) for value in values]
        scenes += line
        found = np.array([read(material.predict(parameters)) for parameters in line])
        label = f"{diameter * 1e3:g} mm"
        axes.plot(values * x[2], found * y[2], marker=marker, markersize=3.5, color=color, label=label)
        series.add(label, f"model {material.model}", **{x[1]: values, y[1]: found})
    axes.set_xlabel(x[0])
    axes.set_ylabel(y[0])
    axes.legend(title="$d_b$", loc="center left", bbox_to_anchor=(1.0, 0.5))
    _headline(axes, material.model, scenes)
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
    """Draw F_r against z_r on flat glass for r_e from 5 to almost 8 mm, and the beginning for the largest.

    At r_e = R_0 = 8 mm the free annulus vanishes, which the model does not allow; 0.1 um of it are left. The published
    difference scheme shows small instabilities there; here the derivatives are exact and the curve is smooth.
    """
    whole, begin = figure.subplots(1, 2)
    series = Series()
    radii = (5.0, 6.0, 7.0, 7.3, 7.6, 7.9999)
    for radius, color in zip(radii, shades(len(radii)), strict=True):
        parameters = scene(None, 0.0, gripper=Gripper(effective_radius=radius * 1e-3))
        draw_model(whole, material.predict(parameters, "cone-2017"), color, f"{radius:g} mm", series, style="-")
    profile_axes(whole)
    whole.legend(title="$r_e$", loc="upper right", bbox_to_anchor=(0.95, 0.95))
    _headline(whole, "cone-2017", [parameters])
    whole.set_title(f"A  {whole.get_title(loc='left')}", loc="left", fontsize=8)
    begin.set_title(f"B  beginning, $r_e$ = {radius:g} mm of $R_0$ = 8 mm", loc="left", fontsize=8)
    _draw_beginning(begin, predict(parameters, "cone-2017", points=4000), color, series)
    return series.frame()


def _draw_beginning(axes: Axes, prediction: Prediction, color: str, series: Series) -> None:
    """Draw the first 100 um from where the line begins to recede; the force before that in words."""
    receding = prediction.stable & (prediction.contact_radius < prediction.contact_radius.max())
    pinned = prediction.stable & ~receding
    start, force = float(prediction.retraction[pinned].max()), float(prediction.force[pinned].min())
    shown = (receding | (prediction.force == force)) & (prediction.retraction < 100e-6)
    axes.plot(prediction.retraction[shown] * 1e6, prediction.force[shown], ".-", color=color, markersize=3)
    words = f"In the first {start * 1e9:.0f} nm the line is pinned:\n$F_r$ falls from 0 to {force:.4f} N."
    axes.text(0.97, 0.95, words, transform=axes.transAxes, ha="right", va="top", fontsize=8)
    axes.set_xlabel(r"Retraction $z_r$ [µm]")
    axes.set_ylabel(r"Reaction force $F_r$ [N]")
    series.add(
        "beginning",
        f"model {prediction.model}",
        retraction_m=prediction.retraction[shown],
        force_N=prediction.force[shown],
    )
