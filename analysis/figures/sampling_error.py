"""Error of F_p and D_p against sample rate and filter, and against run time, as one picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.figures.parts import scene
from analysis.figures.registry import Material, paper_figure
from analysis.figures.style import CYCLE, MARKERS
from analysis.sampling import READERS, study
from analysis.synthetic import Profile

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def retraction_profile(material: Material) -> Profile:
    """Return the model's profile on the 60 mm sphere at -1 kPa, from a moderate compression on."""
    whole = Profile.of(material.predict(scene(60e-3, -1e3)))
    first = int(np.argmax(whole.force < 0.4))
    return Profile(whole.retraction[first:], whole.force[first:], whole.pressure[first:])


@paper_figure("sampling", "Error of F_p and D_p against sample rate, filter and run time", (9.6, 3.9))
def figure_sampling(figure: Figure, material: Material) -> pd.DataFrame:
    """Draw root mean square errors over twelve synthetic tests per rate, made from the model on a 60 mm sphere."""
    data = study(retraction_profile(material))
    force, distance, cost = figure.subplots(1, 3)
    _against_rate(force, data, "pull_off_force_error_N", 1e3, "Error of $F_p$, rms [mN]")
    _against_rate(distance, data, "pull_off_distance_error_m", 1e6, "Error of $D_p$, rms [µm]")
    for (name, rows), color, marker in zip(_by_reader(data), CYCLE, MARKERS, strict=False):
        cost.loglog(rows["seconds"] * 1e3, rows["pull_off_force_error_N"] * 1e3, marker, color=color, label=name)
    cost.set_xlabel("Time per run [ms]")
    cost.set_ylabel("Error of $F_p$, rms [mN]")
    figure.legend(*force.get_legend_handles_labels(), loc="outside upper center", ncols=5)
    return data


def _by_reader(data: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    return [(name, data[data["reader"] == name]) for name in READERS]


def _against_rate(axes: Axes, data: pd.DataFrame, column: str, factor: float, label: str) -> None:
    for (name, rows), color, marker in zip(_by_reader(data), CYCLE, MARKERS, strict=False):
        axes.loglog(rows["rate_Hz"], rows[column] * factor, marker=marker, color=color, label=name)
    axes.set_xlabel("Sample rate [Hz]")
    axes.set_ylabel(label)
