"""The papers' experimental figures: EML 2a, 2b, 3a to 3e, 5a to 5c, SI S9. Without recordings: the models alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from analysis.errors import AnalysisError
from analysis.figures.parts import (
    BAND,
    PAPER_MEMBRANE,
    Series,
    draw_band,
    draw_model,
    frame_profile,
    kilopascal,
    named,
    profile_axes,
    scene,
    shades,
)
from analysis.figures.registry import Material, paper_figure
from analysis.figures.run_overview import draw_against_time, force_axis, pressure_axis
from analysis.figures.style import BLACK, BLUE, CYCLE, GREEN, GREY, MARKERS, ORANGE, PURPLE, SKY, YELLOW, plain
from analysis.indentation import fit_contact, indenter_radius
from analysis.numerics import running_mean
from analysis.pipeline import Analysis
from analysis.published import experiments
from analysis.repeats import Condition, Group
from model import jkr
from model.parameters import Gripper, Membrane, Parameters

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

EXAMPLE = "60 mm sphere, $P_0$ = -3.2 kPa at $V_0$; contact makes the volume smaller"
EXAMPLE_NAME = "60 mm, P_0 = -3.2 kPa at V_0"
"""The example without recordings; the gas law is anchored before contact, so P_a begins above P_0."""

RETRACT_SPEED = 10e-6
"""EML 2020 section 2, m/s: turns a predicted profile into one against time."""


def _published_scenes(diameter: float | None) -> list[tuple[float, Parameters]]:
    """Return (P_0, scene) at the highest and lowest pressure of Table S1, and in between."""
    high, low = (test.pressure for test in experiments() if test.diameter == diameter)
    pressures = [high, 0.0, low] if high * low < 0 else [high, low]
    return [(pressure, scene(diameter, pressure)) for pressure in pressures]


def _of_substrate(material: Material, diameter: float | None) -> list[Group]:
    """Return the pull-off groups on one substrate, from the highest pressure to the lowest."""
    return [
        members
        for members in material.pull_offs()
        if members.condition.on_glass
        and members.condition.flat == (diameter is None)
        and (diameter is None or abs(members.condition.diameter - diameter) < 1e-6)
    ]


def _parameters(members: Group) -> Parameters:
    parameters = members.kept[0].run.parameters
    if parameters is None:
        raise AnalysisError(f"{members.condition}: the recording holds no parameters to predict with")
    return parameters


def _example(material: Material) -> Group | None:
    """Return the group closest to the papers' example: 60 mm sphere under the strongest suction."""
    found = material.pull_offs()
    if not found:
        return None
    return min(found, key=lambda m: (abs(m.condition.diameter - 60e-3) > 1e-6, m.condition.pressure or 0.0))


@paper_figure("2a", "EML 2a: force and pressure against time", (6.4, 3.8))
def figure_2a(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r and P_a of one run against time with the six moments; without a recording, the predicted retraction."""
    axes, series = figure.subplots(), Series()
    example = _example(material)
    if example is not None:
        analysis = example.kept[0]
        draw_against_time(axes, analysis.run, analysis)
        _add_thinned(series, analysis)
        return series.frame()
    prediction = material.predict(scene(60e-3, -3.2e3))
    stable = prediction.stable
    time = (prediction.position[stable] - prediction.position[stable][0]) / RETRACT_SPEED
    axes.plot(np.append(time, time[-1]), np.append(prediction.force[stable], 0.0), "--", color=BLUE)
    axes.set_xlabel("Time since the start of the retraction at 10 µm/s [s]")
    force_axis(axes)
    pressure_axis(axes).plot(time, prediction.pressure[stable] * 1e-3, "--", color=ORANGE)
    axes.set_title(f"model {material.model}: {EXAMPLE}", loc="left", fontsize=9)
    series.add(
        EXAMPLE_NAME,
        f"model {prediction.model}",
        time_s=time,
        force_N=prediction.force[stable],
        pressure_Pa=prediction.pressure[stable],
    )
    return series.frame()


def _add_thinned(series: Series, analysis: Analysis) -> None:
    run = analysis.run
    keep = np.linspace(0, run.force.size - 1, min(4000, run.force.size)).astype(int)
    width = max(1, run.force.size // 4000)
    columns = {"time_s": run.time[keep], "force_N": running_mean(analysis.force, width)[keep]}
    if run.pressure is not None:
        columns["pressure_Pa"] = running_mean(run.pressure, width)[keep]
    series.add(run.name, "measured", [analysis], **columns)


@paper_figure("2b", "EML 2b: force and pressure against retraction, repeats as bands", (6.0, 4.0))
def figure_2b(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw mean and standard deviation of F_r and P_a over the repeats of one condition."""
    axes, series = figure.subplots(), Series()
    example = _example(material)
    profile_axes(axes)
    force_axis(axes)
    twin = pressure_axis(axes)
    if example is None:
        prediction = material.predict(scene(60e-3, -3.2e3))
        draw_model(axes, prediction, BLUE, EXAMPLE_NAME, series)
        stable = prediction.stable
        twin.plot(prediction.retraction[stable] * 1e3, prediction.pressure[stable] * 1e-3, "--", color=ORANGE)
        axes.set_title(f"model {material.model}: {EXAMPLE}", loc="left", fontsize=9)
        return series.frame()
    mean = draw_band(axes, example, BLUE, str(example.condition), series)
    if mean is not None and mean.pressure is not None and mean.pressure_deviation is not None:
        shown = mean.retraction <= axes.get_xlim()[1] * 1e-3
        place, gas, spread = (v[shown] for v in (mean.retraction * 1e3, mean.pressure, mean.pressure_deviation))
        twin.plot(place, gas * 1e-3, color=ORANGE)
        twin.fill_between(place, (gas - spread) * 1e-3, (gas + spread) * 1e-3, color=ORANGE, alpha=0.25, linewidth=0)
    title = f"{named(example.condition)}; {len(example.kept)} repeats"
    axes.set_title(f"{title}\n{BAND}" if len(example.kept) > 1 else title, loc="left", fontsize=9)
    return series.frame()


def _by_pressure(figure: Figure, material: Material, diameter: float) -> pd.DataFrame:
    axes, series = figure.subplots(), Series()
    groups = _of_substrate(material, diameter)
    if groups:
        for members, color in zip(groups, shades(len(groups)), strict=True):
            gas = "vented" if members.condition.pressure is None else kilopascal(members.condition.pressure)
            label = ", ".join(filter(None, (gas, members.condition.distinction)))
            draw_band(axes, members, color, label, series)
        words = f"$d_b$ = {diameter * 1e3:g} mm"
        repeated = any(len(members.kept) > 1 for members in groups)
        axes.set_title(f"{words}\n{BAND}" if repeated else words, loc="left", fontsize=9)
    else:
        scenes = _published_scenes(diameter)
        for (pressure, parameters), color in zip(scenes, shades(len(scenes)), strict=True):
            draw_model(axes, material.predict(parameters), color, kilopascal(pressure), series)
        words = f"$d_b$ = {diameter * 1e3:g} mm, model {material.model} (no recordings)"
        axes.set_title(words, loc="left", fontsize=9)
    profile_axes(axes)
    frame_profile(axes)
    axes.legend(title="$P_0$")
    return series.frame()


@paper_figure("3a", "EML 3a: profiles by initial pressure, d_b = 15 mm")
def figure_3a(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z_r on the 15 mm sphere for every P_0 recorded."""
    return _by_pressure(figure, material, 15e-3)


@paper_figure("3b", "EML 3b: profiles by initial pressure, d_b = 30 mm")
def figure_3b(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z_r on the 30 mm sphere for every P_0 recorded."""
    return _by_pressure(figure, material, 30e-3)


@paper_figure("3c", "EML 3c: profiles by initial pressure, d_b = 60 mm")
def figure_3c(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z_r on the 60 mm sphere for every P_0 recorded."""
    return _by_pressure(figure, material, 60e-3)


SPHERES = (15e-3, 30e-3, 60e-3)


def _at_end(material: Material, diameter: float, *, highest: bool) -> Group | None:
    found = [m for m in _of_substrate(material, diameter) if m.condition.pressure is not None]
    if not found:
        return None
    return (max if highest else min)(found, key=lambda m: m.condition.pressure or 0.0)


def _spheres(figure: Figure, material: Material, *, highest: bool, with_model: bool) -> pd.DataFrame:
    axes, series = figure.subplots(), Series()
    for diameter, color in zip(SPHERES, CYCLE, strict=False):
        members = _at_end(material, diameter, highest=highest)
        scenes = _published_scenes(diameter)
        pressure, parameters = scenes[0] if highest else scenes[-1]
        label = f"{diameter * 1e3:g} mm, {kilopascal(pressure)}"
        if members is not None:
            parameters = _parameters(members)
            label = f"{diameter * 1e3:g} mm, {kilopascal(members.condition.pressure or 0.0)}"
            label = ", ".join(filter(None, (label, members.condition.distinction)))
            draw_band(axes, members, color, label, series)
        if with_model or members is None:
            draw_model(axes, material.predict(parameters), color, "" if members else label, series, name=label)
    profile_axes(axes)
    frame_profile(axes)
    axes.legend(title="$d_b$, $P_0$")
    if not material.pull_offs():
        axes.set_title(f"model {material.model} (no recordings)", loc="left", fontsize=9)
    elif with_model:
        axes.set_title(f"solid: experiment, dashed: model {material.model}\n{BAND}", loc="left", fontsize=9)
    return series.frame()


@paper_figure("3d", "EML 3d: profiles by sphere diameter at the highest pressures")
def figure_3d(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z_r on 15, 30 and 60 mm spheres at their highest P_0."""
    return _spheres(figure, material, highest=True, with_model=False)


@paper_figure("3e", "EML 3e: membrane and rigid punch on flat glass", (6.0, 3.8))
def figure_3e(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z_r of the membrane (FAM) and of the fibres on a rigid punch (FARP), and the energy of each.

    Of several pressures of the membrane the one nearest to zero is drawn. The papers hold no model of the punch:
    without a recording of it only the membrane is drawn.
    """
    axes, series = figure.subplots(), Series()
    punches = material.pull_offs("punch")
    punches += [m for m in material.groups if m.condition.protocol == "punch"]
    flats = _of_substrate(material, None)
    if flats:
        unloaded = min(flats, key=lambda members: abs(members.condition.pressure or 0.0))
        membrane, pressure = _parameters(unloaded).membrane, unloaded.condition.pressure
        gas = "vented" if pressure is None else f"$P_0$ = {kilopascal(pressure)}"
        draw_band(axes, unloaded, BLUE, f"FAM, {gas}" + _energy(unloaded), series)
    else:
        membrane = PAPER_MEMBRANE
        draw_model(axes, material.predict(scene(None, 0.0)), BLUE, f"FAM, $P_0$ = 0, model {material.model}", series)
    if punches:
        draw_band(axes, punches[0], ORANGE, "FARP" + _energy(punches[0]), series)
    here = f"FAM of {membrane.thickness * 1e6:g} µm, {membrane.youngs_modulus * 1e-6:g} MPa; EML: 75 µm, polyurethane"
    lacking = "" if punches else "\nFARP: no recording, and no model in the papers"
    axes.set_title(here + lacking, loc="left", fontsize=9)
    profile_axes(axes)
    frame_profile(axes)
    axes.legend()
    return series.frame()


def _energy(members: Group) -> str:
    pooled = members.pooled("adhesion_energy_J")
    return "" if pooled is None else f", {pooled.mean * 1e3:.3f} mJ"


@paper_figure("5a", "EML 5a: experiment and model at positive pressure")
def figure_5a(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw measured and predicted profiles at the highest P_0 of each sphere."""
    return _spheres(figure, material, highest=True, with_model=True)


@paper_figure("5b", "EML 5b: experiment and model at negative pressure")
def figure_5b(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw measured and predicted profiles at the lowest P_0 of each sphere."""
    return _spheres(figure, material, highest=False, with_model=True)


@paper_figure("5c", "EML 5c: pull-off force against initial pressure", (6.0, 4.0))
def figure_5c(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_p against P_0: measured means with standard deviations, predictions dashed, Table S1 as open symbols."""
    axes, series = figure.subplots(), Series()
    substrates: Sequence[float | None] = (*SPHERES, None)
    for diameter, color, marker in zip(substrates, CYCLE, MARKERS, strict=False):
        label = "flat" if diameter is None else f"{diameter * 1e3:g} mm"
        printed = _printed(axes, diameter, color, marker)
        groups = [m for m in _of_substrate(material, diameter) if m.pooled("pull_off_force_N")]
        ends = printed
        if groups:
            ends = np.concatenate([printed, _measured_points(axes, groups, color, marker, label, series)])
        low, high = float(ends.min()), float(ends.max())
        margin = 0.05 * (high - low)
        pressures = np.linspace(low - margin, high + margin, 15)
        for base in _gripping(groups) if groups else [scene(diameter, 0.0)]:
            predictions = [material.predict(base.with_changes(initial_pressure=float(p))) for p in pressures]
            forces = np.array([prediction.pull_off_force for prediction in predictions])
            axes.plot(pressures * 1e-3, forces, "--", color=color, label=None if groups else label)
            series.add(label, f"model {material.model}", initial_pressure_Pa=pressures, pull_off_force_N=forces)
    axes.set_title(f"open: published, Table S1; dashed: model {material.model}", loc="left", fontsize=9)
    axes.set_xlabel("Initial pressure $P_0$ [kPa]")
    axes.set_ylabel("Pull-off force $F_p$ [N]")
    axes.set_ylim(bottom=0)
    axes.legend(title="$d_b$")
    return series.frame()


def _gripping(groups: Sequence[Group]) -> list[Parameters]:
    """Return one scene for each gripper and membrane among the groups."""
    found: dict[tuple[Gripper, Membrane], Parameters] = {}
    for parameters in map(_parameters, groups):
        found.setdefault((parameters.gripper, parameters.membrane), parameters)
    return list(found.values())


def _printed(
    axes: Axes, diameter: float | None, color: str, marker: str
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Draw the two published points; return their pressures, Pa."""
    tests = [test for test in experiments() if test.diameter == diameter]
    pressures = np.array([test.pressure for test in tests])
    forces = [test.force for test in tests]
    axes.plot(pressures / 1e3, forces, marker, color=color, markerfacecolor="none", markersize=6)
    return pressures


def _measured_points(
    axes: Axes, groups: Sequence[Group], color: str, marker: str, label: str, series: Series
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Draw mean and standard deviation of each group; return their pressures, Pa."""
    forces = [members.pooled("pull_off_force_N") for members in groups]
    gases = [members.pooled("initial_pressure_Pa") for members in groups]
    mean = np.array([force.mean for force in forces if force is not None])
    spread = np.nan_to_num(np.array([force.deviation for force in forces if force is not None]))
    pressure = np.array([0.0 if gas is None else gas.mean for gas in gases])
    axes.errorbar(pressure * 1e-3, mean, yerr=spread, fmt=marker, color=color, markersize=5, capsize=2, label=label)
    series.add(
        label,
        "measured",
        [member for members in groups for member in members.kept],
        initial_pressure_Pa=pressure,
        pull_off_force_N=mean,
        pull_off_force_standard_deviation_N=spread,
        count=np.array([float(len(members.kept)) for members in groups]),
    )
    return pressure


JKR_RADIUS = 4e-3
JKR_MODULUS = 1.9e6
"""Contact modulus of the fibrillar layer that gives the papers' contact of 0.5 mm radius at 78 mN, Pa."""
JKR_PRELOAD = 0.1
"""N."""


@paper_figure("S9", "SI S9: JKR test of the membrane, rigid and soft system", (8.6, 3.8))
def figure_s9(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw F_r against z of the JKR tests with the fitted JKR, DMT and Maugis curves.

    Without recordings: JKR's curve for the works of adhesion of Tables S3 and S4.
    """
    series = Series()
    panels = figure.subplots(1, 2, sharey=True)
    for axes, gripper, work, letter in zip(panels, ("soft", "rigid"), (3.3, 4.1), "AB", strict=True):
        found = [m for m in material.groups if m.condition.protocol == "indentation" and m.condition.gripper == gripper]
        if found:
            _draw_indentations(axes, [members.kept[0] for members in found], series)
            axes.set_title(f"{letter}  {gripper} system", loc="left")
        else:
            contact = jkr.jkr_contact_under(JKR_PRELOAD, work, JKR_RADIUS, JKR_MODULUS)
            curve = jkr.jkr_curve(work, JKR_RADIUS, JKR_MODULUS, largest_contact=contact)
            last = curve.indentation[-1] * 1e3
            axes.plot(np.append(curve.indentation * 1e3, last), np.append(curve.force * 1e3, 0), "--", color=BLUE)
            axes.set_title(f"{letter}  {gripper} system: JKR, $\\omega$ = {work} J/m² (no recordings)", loc="left")
            series.add(f"{gripper} system", "model JKR", displacement_m=curve.indentation, force_N=curve.force)
        axes.set_xlabel("Vertical displacement z [mm], compression positive")
        axes.axhline(0, color=BLACK, linewidth=0.6)
        axes.locator_params(axis="x", nbins=5)
    panels[0].set_ylabel(r"Reaction force $F_r$ [mN]")
    return series.frame()


def _draw_indentations(axes: Axes, analyses: Sequence[Analysis], series: Series) -> None:
    """Draw every position, and over the one nearest to the mean force the fitted models."""
    forces = np.array([analysis.features.value("pull_off_force_N") for analysis in analyses])
    middle = int(np.nanargmin(np.abs(forces - np.nanmean(forces)))) if np.isfinite(forces).any() else 0
    ends: list[tuple[float, float]] = []
    few = (BLACK, BLUE, SKY, YELLOW, GREY)
    colors = few[: len(analyses)] if len(analyses) <= len(few) else shades(len(analyses))
    for number, (analysis, color) in enumerate(zip(analyses, colors, strict=True)):
        work = analysis.work
        origin = _origin(analysis)
        width = max(1, work.force.size // 4000)
        force, depth = running_mean(work.force, width)[::width], origin - work.separation[::width]
        place = plain(Condition.of(analysis.run).place or analysis.run.name)
        axes.plot(depth * 1e3, force * 1e3, label=place, color=color, linewidth=1.6 if number == middle else 0.8)
        series.add(analysis.run.name, "measured", [analysis], displacement_m=depth, force_N=force)
        if "detachment" in work.details:
            ends.append((float(depth.max()) * 1e3, (origin - work.release_separation) * 1e3))
    if ends:
        deepest, last = max(end for end, _ in ends), min(end for _, end in ends)
        axes.set_xlim(min(2.0 * last, -0.5 * deepest), 1.1 * deepest)
    if "detachment" in analyses[middle].work.details:
        _draw_fits(axes, analyses[middle], series)
    axes.legend(fontsize=7)


def _origin(analysis: Analysis) -> float:
    """Return the separation at contact, or where the approach shows none that at the zero of force, m."""
    features = analysis.features
    return features.value("contact_height_m" if "contact_height_m" in features else "zero_force_height_m")


def _draw_fits(axes: Axes, analysis: Analysis, series: Series) -> None:
    work = analysis.work
    start, _ = work.retraction()
    origin = _origin(analysis)
    part = slice(start, int(work.release))
    fits = fit_contact(work.separation[part], work.force[part], indenter_radius(analysis.run))
    place = plain(Condition.of(analysis.run).place)
    for fit, color, style in zip(fits, (ORANGE, GREEN, PURPLE), ("--", ":", "-."), strict=True):
        label = f"{fit.model} ({place}): {fit.work_of_adhesion:.2f} J/m²"
        axes.plot((origin - fit.separation) * 1e3, fit.force * 1e3, style, color=color, label=label)
        series.add(
            f"{analysis.run.name} {fit.model}",
            f"model {fit.model}",
            [analysis],
            displacement_m=origin - fit.separation,
            force_N=fit.force,
        )
