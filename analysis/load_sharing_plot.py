"""Picture of the load sharing: stress in the film near its edge, and along the interface."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from model.load_sharing import Load

if TYPE_CHECKING:
    from model.load_sharing import LoadSharing


def draw_load_sharing(
    stuck: LoadSharing, fibred: LoadSharing, loads: Sequence[tuple[float, float]], title: str, path: Path
) -> None:
    """Draw sigma_22 in the film at the last load, and along the interface at every load, stuck and with fibres."""
    from matplotlib.figure import Figure

    from analysis.figures.style import format_of, plain

    kind = format_of(path)
    figure = Figure(figsize=(9, 10), layout="constrained")
    top, wide, near = figure.subplots(3, 1, height_ratios=[1, 1.4, 1.4])
    _map(figure, top, fibred, Load(*loads[-1]))
    colours = ["C0", "C3", "C2", "C4", "C1"]
    edge = fibred.film.contact_radius
    for i, pair in enumerate(loads):
        load, colour = Load(*pair), colours[i % len(colours)]
        label = f"P = {load.pressure / 1e3:g} kPa, u_0 = {load.lift * 1e6:.0f} um"
        wide.plot(fibred.position * 1e3, fibred.traction(load) / 1e3, colour, label=label)
        near.plot((edge - fibred.position) * 1e6, fibred.traction(load) / 1e3, colour, label=f"{label}, fibre layer")
        inside = stuck.position < edge - 2e-6
        near.plot(
            (edge - stuck.position[inside]) * 1e6, stuck.traction(load)[inside] / 1e3, colour, ls=":", label="sticking"
        )
    wide.set(xlabel="x (mm)", ylabel="sigma_22 at the interface (kPa)", title="with the fibre layer")
    wide.axhline(0, color="0.7", lw=0.8, zorder=0)
    wide.legend(frameon=False)
    peak = max(fibred.peak_stress(Load(*pair)) for pair in loads) / 1e3
    near.set(
        xlabel="distance from the contact edge (um)",
        ylabel="sigma_22 (kPa)",
        xlim=(600, 0),
        ylim=(-0.35 * peak, 2.2 * peak),
        title="near the edge; a sticking film has no finite peak",
    )
    near.axhline(0, color="0.7", lw=0.8, zorder=0)
    near.legend(frameon=False, fontsize="small", ncols=2)
    figure.suptitle(f"{plain(title)}: load sharing, {fibred.formulation.value}")
    figure.savefig(path, dpi=130, format=kind)


def _map(figure: object, axes: object, solved: LoadSharing, load: Load) -> None:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.tri import Triangulation

    assert isinstance(axes, Axes)
    assert isinstance(figure, Figure)
    stress = (load.lift * solved.stress.by_lift + load.pressure * solved.stress.by_pressure) / 1e3
    x, y = solved.stress.points * 1e3
    limit = 1.2 * solved.peak_stress(load) / 1e3
    filled = axes.tripcolor(
        Triangulation(x, y, solved.stress.triangles.T),
        np.clip(stress, -limit, limit),
        shading="gouraud",
        cmap="RdBu_r",
        vmin=-limit,
        vmax=limit,
        rasterized=True,
    )
    edge = solved.film.contact_radius * 1e3
    left = max(edge - 1.5, 0)
    axes.plot([left, edge], [0, 0], "k", lw=4)
    axes.set(
        xlim=(left, solved.film.radius * 1e3),
        xlabel="x (mm); black: in contact",
        ylabel="y (mm)",
        title=f"sigma_22 in the film at P = {load.pressure / 1e3:g} kPa (kPa)",
    )
    figure.colorbar(filled, ax=axes)
