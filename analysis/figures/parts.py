"""Parts that several figures share: axes of a force profile, bands of repeats, dashed model lines, long tables."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from analysis.figures.style import GREY, plain
from analysis.numerics import Array
from analysis.repeats import Band, Condition, Group, band
from model.parameters import Gas, GasAnchor, Gripper, Membrane, Parameters, Substrate

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

    from analysis.pipeline import Analysis
    from model.prediction import Prediction

PAPER_MEMBRANE = Membrane(youngs_modulus=2.0e6, thickness=200e-6, work_of_adhesion=4.0)
"""The PDMS-based membrane of EML 2020, section 4."""


def scene(
    diameter: float | None,
    pressure: float,
    *,
    membrane: Membrane = PAPER_MEMBRANE,
    gripper: Gripper | None = None,
    flat: bool = False,
) -> Parameters:
    """Return the papers' rigid gripper on a sphere, a flat disk, or (``diameter`` None) an unbounded flat; SI units."""
    return Parameters(
        substrate=Substrate("flat" if flat or diameter is None else "sphere", diameter),
        gripper=gripper or Gripper(),
        membrane=membrane,
        gas=Gas(initial_pressure=pressure, anchor=GasAnchor.FREE),
    )


class Series:
    """Collects what a figure draws into one long table, and the names of the runs it is drawn from."""

    def __init__(self) -> None:
        self._rows: list[pd.DataFrame] = []
        self._runs: list[str] = []

    def add(self, series: str, source: str, runs: Iterable[Analysis] = (), **columns: Array) -> None:
        """Add one line: its name, ``"measured"`` or ``"model ..."``, and its columns with units in their names.

        ``runs`` are those that a measured line shows. Where one of them is emulated, the column ``EMULATED`` says so.
        """
        import pandas as pd

        shown = list(runs)
        self._runs += [analysis.run.name for analysis in shown]
        frame = pd.DataFrame(columns)
        emulated = [analysis.run.emulated for analysis in shown]
        if any(emulated):
            frame.insert(0, "EMULATED", "yes" if all(emulated) else "partly")
        frame.insert(0, "source", source)
        frame.insert(0, "series", series)
        self._rows.append(frame)

    def frame(self) -> pd.DataFrame:
        """Return the long table; its ``attrs["runs"]`` names the runs."""
        import pandas as pd

        table = pd.concat(self._rows, ignore_index=True) if self._rows else pd.DataFrame(columns=["series", "source"])
        table.attrs["runs"] = self._runs
        return table


def profile_axes(axes: Axes) -> None:
    """Label the axes of a force profile."""
    axes.set_xlabel(r"Retraction $z_r$ [mm]")
    axes.set_ylabel(r"Reaction force $F_r$ [N]")
    axes.axhline(0, color=GREY, linewidth=0.7, zorder=1)


BAND = "± 1 standard deviation up to the first detachment; bar: $D_p$"
"""What ``draw_band`` shows of several repeats."""


def draw_band(axes: Axes, members: Group, color: str, label: str, series: Series) -> Band | None:
    """Draw the mean of a group's curves with its standard deviation shaded, and D_p with its own as a bar.

    A single curve is drawn to a little beyond its detachment.
    """
    mean = band(members)
    if mean is None:
        return None
    pooled = members.pooled("pull_off_distance_m")
    last = np.inf if pooled is None else 1.06 * pooled.mean
    shown = mean.retraction <= last
    place, force, spread = (values[shown] for values in (mean.retraction, mean.force, mean.force_deviation))
    axes.plot(place * 1e3, force, color=color, label=label)
    columns = {"retraction_m": place, "force_N": force, "force_standard_deviation_N": spread}
    if mean.pressure is not None:
        columns["pressure_Pa"] = mean.pressure[shown]
    if mean.count == 1:
        series.add(label, "measured", members.kept, **columns)
        return mean
    axes.fill_between(place * 1e3, force - spread, force + spread, color=color, alpha=0.25, linewidth=0)
    if pooled is not None:
        axes.errorbar(pooled.mean * 1e3, 0.0, xerr=pooled.deviation * 1e3, fmt="|", color=color, capsize=2)
    count = np.full(place.size, float(mean.count))
    series.add(label, "measured", members.kept, **columns, repeats_in_contact=count)
    return mean


def named(condition: Condition) -> str:
    """Return a condition with its symbols set as symbols."""
    return plain(condition).replace("d_b ", "$d_b$ = ").replace("P_0", "$P_0$")


def draw_model(
    axes: Axes,
    prediction: Prediction,
    color: str,
    label: str,
    series: Series,
    *,
    style: str = "--",
    name: str = "",
    from_zero: bool = False,
) -> None:
    """Draw a predicted profile up to detachment and its drop to zero, against z_r, or ``from_zero`` against z."""
    stable = prediction.stable
    if not stable.any():
        return
    place, force = prediction.retraction[stable], prediction.force[stable]
    order = np.argsort(place, kind="stable")
    place, force = place[order], force[order]
    position = prediction.position[stable][order]
    shown = position if from_zero else place
    axes.plot(np.append(shown, shown[-1]) * 1e3, np.append(force, 0.0), style, color=color, label=label or None)
    series.add(
        name or label,
        f"model {prediction.model}",
        **({"position_m": position} if from_zero else {"retraction_m": place}),
        force_N=force,
        pressure_Pa=prediction.pressure[stable][order],
        contact_radius_m=prediction.contact_radius[stable][order],
    )


def shades(count: int, name: str = "viridis") -> list[str]:
    """Return ``count`` colours that stay in order when printed grey."""
    import matplotlib as mpl
    from matplotlib.colors import to_hex

    return [to_hex(mpl.colormaps[name](x)) for x in np.linspace(0.05, 0.88, count)]


def kilopascal(pressure: float) -> str:
    """Write a pressure for a legend."""
    return f"{pressure / 1e3:+.1f} kPa"


def frame_profile(axes: Axes) -> None:
    """Leave out most of the compression: the papers show the tension."""
    drawn = [np.asarray(line.get_ydata(), dtype=np.float64) for line in axes.get_lines()]
    depth = -min((float(values.min()) for values in drawn if values.size), default=-1.0)
    if depth > 0:
        axes.set_ylim(-1.12 * depth, min(axes.get_ylim()[1], 0.4 * depth))
    left, right = axes.get_xlim()
    axes.set_xlim(max(left, -0.25 * right), right)
