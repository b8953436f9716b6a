"""Repeats of one condition: bands on a common z_r grid, outliers by a stated rule, pooled numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.numerics import Array, on_grid
from analysis.pipeline import Analysis
from analysis.quantity import Quantity
from analysis.run import Run

if TYPE_CHECKING:
    import pandas as pd

OUTLIER_RULE = (
    "Grubbs' test at 5 % on F_p and on D_p of the repeats of one condition, at least four repeats, one outlier at a "
    "time: how far a value is from the mean of the others, over their standard deviation and its own standard "
    "uncertainty. Outliers are left out of means and bands, and listed."
)

RANDOM_SOURCES = frozenset({"noise", "sampling", "drift", "contact point"})
"""Sources that differ from repeat to repeat; the others (calibration) are common to all."""


@dataclass(frozen=True, slots=True, order=True)
class Condition:
    """What repeats have in common.

    Attributes
    ----------
    protocol, gripper
        As in the scene.
    diameter
        d_b, m; 0 stands for an unbounded flat.
    flat
        Whether the substrate is flat.
    pressure
        Nominal P_0, Pa gauge, or ``None`` vented.
    place
        Position on the membrane (indentation) or name of the sample; empty where there is none.
    details
        Symbol and value of every other setting: gripper, membrane, preload, speeds, dwell.
    material
        Of the substrate.
    place_number
        Which of the scene's places it is; orders them.
    shown
        Symbols of the details in which conditions of this kind differ; ``group`` finds them, the name holds them.
    """

    protocol: str
    gripper: str = "rigid"
    flat: bool = False
    diameter: float = 0.0
    pressure: float | None = None
    place: str = ""
    details: tuple[tuple[str, str], ...] = ()
    material: str = "glass"
    place_number: float = field(default=0.0, compare=False)
    shown: tuple[str, ...] = field(default=(), compare=False)

    @classmethod
    def of(cls, run: Run) -> Condition:
        """Read the condition from the run's scene."""
        gripper = str(run.settings.get("gripper", "rigid"))
        place = str(run.settings.get("position", run.settings.get("sample", "")))
        number = float(run.settings.get("place_number", 0))
        details = tuple(_details(run))
        material = str(run.settings.get("material", "glass"))
        if run.parameters is None:
            return cls(run.protocol, gripper, place=place, details=details, material=material, place_number=number)
        substrate = run.parameters.substrate
        pressure = None if run.pressure is None else run.parameters.gas.initial_pressure
        flat, diameter = substrate.shape == "flat", substrate.diameter or 0.0
        return cls(run.protocol, gripper, flat, diameter, pressure, place, details, material, number)

    @property
    def on_glass(self) -> bool:
        """Whether the substrate is of the papers' usual material."""
        return self.material.casefold() == "glass"

    @property
    def substrate(self) -> str:
        """Name of the substrate as in the papers' tables."""
        if self.flat and not self.diameter:
            return "Flat Glass" if self.on_glass else self.material
        words = f"{'flat disk' if self.flat else 'd_b'} {self.diameter * 1e3:g} mm"
        return words if self.on_glass else f"{words}, {self.material}"

    @property
    def distinction(self) -> str:
        """What tells this condition from others of its kind; empty where nothing has to."""
        return ", ".join(f"{symbol} {value}" for symbol, value in self.details if symbol in self.shown)

    def __str__(self) -> str:
        pressure = "vented" if self.pressure is None else f"P_0 = {_kilopascal(self.pressure)}"
        parts = [self.substrate, pressure] if self.protocol == "pull_off" else [self.protocol, self.place]
        if self.protocol != "pull_off" and not self.on_glass:
            parts.append(self.material)
        if self.gripper != "rigid":
            parts.insert(0, f"{self.gripper} gripper")
        return ", ".join(part for part in (*parts, self.distinction) if part)


_SETTINGS = {
    "preload": ("preload_N", "N"),
    "approach": ("approach_speed_um_s", "µm/s"),
    "retraction": ("retract_speed_um_s", "µm/s"),
    "dwell": ("preload_dwell_s", "s"),
    "R": ("indenter_radius_mm", "mm"),
    "fibers": ("fibers", ""),
}
"""Settings of a protocol that make another condition: symbol, key of the scene and unit."""


def _details(run: Run) -> Iterator[tuple[str, str]]:
    if run.parameters is not None:
        gripper, membrane = run.parameters.gripper, run.parameters.membrane
        yield "R_0", f"{gripper.radius * 1e3:g} mm"
        yield "r_e", f"{gripper.effective_radius * 1e3:g} mm"
        yield "V_0", f"{gripper.chamber_volume * 1e6:g} mL"
        yield "E_m", f"{membrane.youngs_modulus * 1e-6:g} MPa"
        yield "h_0", f"{membrane.thickness * 1e6:g} µm"
        yield "ω_a", f"{membrane.work_of_adhesion:g} J/m²"
        if run.pressure is not None and run.protocol != "pull_off":
            yield "P_0", _kilopascal(run.parameters.gas.initial_pressure)
    for symbol, (key, unit) in _SETTINGS.items():
        if key in run.settings:
            yield symbol, f"{run.settings[key]:g} {unit}".strip()


def _kilopascal(pressure: float) -> str:
    tenths = f"{pressure / 1e3:+.1f}"
    return f"{tenths if abs(float(tenths) * 1e3 - pressure) < 1e-6 else f'{pressure / 1e3:+g}'} kPa"


@dataclass(frozen=True)
class Pooled:
    """One number over the repeats.

    Attributes
    ----------
    mean, deviation
        Mean and standard deviation (n - 1) of the repeats.
    count
        How many.
    uncertainty
        Standard uncertainty of the mean: deviation / sqrt(n), and the sources common to all repeats.
    budget
        The same by source; what differs from repeat to repeat under ``"repeats"``.
    """

    mean: float
    deviation: float
    count: int
    uncertainty: float
    unit: str
    budget: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Group:
    """The repeats of one condition; ``outliers`` names those left out and why."""

    condition: Condition
    members: tuple[Analysis, ...]
    outliers: Mapping[str, str] = field(default_factory=dict)
    rule: str = OUTLIER_RULE

    @property
    def kept(self) -> tuple[Analysis, ...]:
        """The repeats that count."""
        return tuple(member for member in self.members if member.run.name not in self.outliers)

    def pooled(self, feature: str) -> Pooled | None:
        """Return a feature over the repeats, or ``None`` where no repeat has it."""
        found = [member.features[feature] for member in self.kept if feature in member.features]
        return pool(found) if found else None

    def features(self) -> list[str]:
        """Return the names of all features that any repeat has, in order."""
        return list(dict.fromkeys(name for member in self.kept for name in member.features))


def pool(quantities: Sequence[Quantity]) -> Pooled:
    """Pool one quantity over repeats."""
    values = np.array([quantity.value for quantity in quantities])
    deviation = float(values.std(ddof=1)) if values.size > 1 else float("nan")
    random = deviation / np.sqrt(values.size) if values.size > 1 else _random(quantities[0])
    sources = dict.fromkeys(source for quantity in quantities for source in quantity.budget)
    common = {
        source: float(np.mean([quantity.budget.get(source, 0.0) for quantity in quantities]))
        for source in sources
        if source not in RANDOM_SOURCES
    }
    total = float(np.sqrt(random**2 + sum(part**2 for part in common.values())))
    unit = quantities[0].unit
    return Pooled(float(values.mean()), deviation, values.size, total, unit, {"repeats": float(random), **common})


def _random(quantity: Quantity) -> float:
    """What of a number's uncertainty is not common to all repeats."""
    if not quantity.budget:
        return quantity.uncertainty
    return float(np.sqrt(sum(part**2 for source, part in quantity.budget.items() if source in RANDOM_SOURCES)))


def group(analyses: Iterable[Analysis]) -> list[Group]:
    """Put analyses of equal condition together, in the order of substrate and pressure, and look for outliers."""
    members: dict[Condition, list[Analysis]] = {}
    for analysis in analyses:
        members.setdefault(Condition.of(analysis.run), []).append(analysis)
    named = sorted(map(_named(members), members), key=_order)
    return [Group(condition, tuple(members[condition]), _outliers(members[condition])) for condition in named]


def _named(conditions: Iterable[Condition]) -> Callable[[Condition], Condition]:
    """Return what gives a condition the details to be named by: those that differ within its kind at any pressure."""
    found: dict[Condition, dict[str, set[str]]] = {}
    for condition in conditions:
        kind = found.setdefault(_kind(condition), {})
        for symbol, value in condition.details:
            kind.setdefault(symbol, set()).add(value)
    return lambda condition: replace(
        condition, shown=tuple(symbol for symbol, values in found[_kind(condition)].items() if len(values) > 1)
    )


def _kind(condition: Condition) -> Condition:
    return replace(condition, pressure=None, details=())


def _order(condition: Condition) -> tuple[object, ...]:
    pressure = np.inf if condition.pressure is None else -condition.pressure
    kind = (condition.protocol, condition.gripper, not condition.on_glass, condition.flat, condition.diameter)
    return (*kind, condition.material, pressure, condition.place_number, condition.place, condition.details)


def _outliers(members: Sequence[Analysis]) -> dict[str, str]:
    found: dict[str, str] = {}
    for feature, symbol in (("pull_off_force_N", "F_p"), ("pull_off_distance_m", "D_p")):
        named = [(m.run.name, m.features[feature]) for m in members if feature in m.features]
        for name, words in _grubbs(named).items():
            found.setdefault(name, f"{symbol} {words}")
    return found


def _grubbs(named: Sequence[tuple[str, Quantity]]) -> dict[str, str]:
    """Return the outliers of one quantity, by name, with what gave them away.

    Grubbs (Technometrics 11, 1, 1969) in its equal form with the mean and deviation of the others. At 5 %, the level of
    ISO 5725-2 for stragglers: at 1 % one of five has to be 11 of their deviations away, at 5 % it is 6.5.
    """
    from scipy.stats import t

    left = list(named)
    found: dict[str, str] = {}
    while len(left) >= 4:
        values = np.array([quantity.value for _, quantity in left])
        n = len(left)
        far = int(np.argmax(np.abs(values - values.mean())))
        others = np.delete(values, far)
        deviation = np.hypot(others.std(ddof=1), np.nan_to_num(left[far][1].uncertainty)) * np.sqrt(n / (n - 1))
        distance = abs(float(values[far] - others.mean()))
        limit = float(t.ppf(1 - 0.05 / (2 * n), n - 2))
        if distance <= limit * deviation:
            break
        name, quantity = left.pop(far)
        found[name] = f"= {quantity}, {distance / deviation:.1f} deviations from the others (limit {limit:.1f})"
    return found


@dataclass(frozen=True)
class Band:
    """Mean and standard deviation of the curves of a group on one grid of z_r: the shaded areas of the papers.

    All arrays have the length of ``retraction``; pressures are ``None`` where a repeat has none. The mean of several
    ends where the first of them detaches.
    """

    retraction: Array
    force: Array
    force_deviation: Array
    pressure: Array | None
    pressure_deviation: Array | None
    count: int

    def frame(self) -> pd.DataFrame:
        """Return the band as a DataFrame with units in the column names."""
        import pandas as pd

        columns = {
            "retraction_m": self.retraction,
            "force_N": self.force,
            "force_standard_deviation_N": self.force_deviation,
        }
        if self.pressure is not None and self.pressure_deviation is not None:
            columns |= {"pressure_Pa": self.pressure, "pressure_standard_deviation_Pa": self.pressure_deviation}
        columns["repeats_in_contact"] = np.full(self.retraction.size, float(self.count))
        return pd.DataFrame(columns)


def band(members: Group, points: int = 400) -> Band | None:
    """Average the curves of a group on ``points`` values of z_r common to all; ``None`` where none has a curve.

    The grid runs from where the last of the curves begins to where the first detaches: beyond it a mean over repeats
    that hold and repeats that do not is none of them. A single curve runs to its end. Each curve is averaged within
    the cells of the grid first, so that noise does not enter the deviation.
    """
    drawn = [member for member in members.kept if member.curve is not None]
    curves = [member.curve for member in drawn if member.curve is not None]
    if not curves:
        return None
    start = max(float(curve.retraction[:16].mean()) for curve in curves)
    stop = min(float(curve.retraction.max()) for curve in curves)
    if len(curves) > 1:
        detached = [member.features.value("pull_off_distance_m") for member in drawn]
        first = min((place for place in detached if np.isfinite(place)), default=stop)
        stop = min(stop, first - (first - start) / (2 * points))  # half a cell, so that no cell holds a snap
    if stop <= start:
        return None
    grid = np.linspace(start, stop, points)
    forces = np.array([on_grid(curve.retraction, curve.force, grid) for curve in curves])
    force, deviation = _mean_and_deviation(forces)
    if any(curve.pressure is None for curve in curves):
        return Band(grid, force, deviation, None, None, len(curves))
    gas = np.array([on_grid(c.retraction, c.pressure, grid) for c in curves if c.pressure is not None])
    return Band(grid, force, deviation, *_mean_and_deviation(gas), len(curves))


def _mean_and_deviation(rows: Array) -> tuple[Array, Array]:
    deviation = rows.std(axis=0, ddof=1) if len(rows) > 1 else np.zeros(rows.shape[1])
    return rows.mean(axis=0), np.asarray(deviation, dtype=np.float64)


def pooled_frame(groups: Iterable[Group]) -> pd.DataFrame:
    """Return one row per condition and feature: mean, standard deviation, count, uncertainty of the mean, unit."""
    import pandas as pd

    rows = [
        (str(members.condition), name, pooled.mean, pooled.deviation, pooled.count, pooled.uncertainty, pooled.unit)
        for members in groups
        for name in members.features()
        if (pooled := members.pooled(name)) is not None
    ]
    columns = ["condition", "feature", "mean", "standard_deviation", "count", "uncertainty_of_mean", "unit"]
    return pd.DataFrame(rows, columns=columns)
