"""Tables S1 to S5 in the layout of PNAS 2017, filled from groups of analysed runs."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import mean, stdev
from typing import TYPE_CHECKING

from analysis.derived import adhesion_efficiency, adhesion_stress, enhancement_ratio
from analysis.pipeline import Analysis
from analysis.published import TABLE_S3, TABLE_S4, JkrTable
from analysis.quantity import Quantity, with_uncertainty
from analysis.repeats import Condition, Group, Pooled

if TYPE_CHECKING:
    import pandas as pd


def _published_stress(table: JkrTable, system: str) -> Quantity:
    """Return the printed sigma_ad; uncertain by the scatter of the positions' forces and areas, as a mean is."""
    forces = [float(force) for _, force, _ in table.rows]
    areas = [float(area) for _, _, area in table.rows if area is not None]
    value = float(table.stress) * 1e3
    relative = math.hypot(*(stdev(found) / mean(found) / math.sqrt(len(found)) for found in (forces, areas)))
    return Quantity(value, value * relative, "Pa", f"σ_ad of the {system} system, Table {table.name} as published")


RIGID_ADHESION_STRESS = _published_stress(TABLE_S3, "rigid")
SOFT_ADHESION_STRESS = _published_stress(TABLE_S4, "soft")
PUBLISHED_STRESS = {"rigid": RIGID_ADHESION_STRESS, "soft": SOFT_ADHESION_STRESS}

NOT_AVAILABLE = "N/A"


@dataclass(frozen=True)
class Table:
    """A table as text cells: title, header and rows of equal length, and notes below."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    def markdown(self) -> str:
        """Return the table as Markdown."""
        lines = [f"**{self.title}**", "", _line(self.header), "|" + "---|" * len(self.header), *map(_line, self.rows)]
        return "\n".join([*lines, *(["", *self.notes] if self.notes else []), ""])

    def html(self) -> str:
        """Return the table as an HTML fragment."""
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in self.header)
        body = "\n".join(
            "<tr><th>"
            + html.escape(row[0])
            + "</th>"
            + "".join(f"<td>{html.escape(c)}</td>" for c in row[1:])
            + "</tr>"
            for row in self.rows
        )
        notes = "".join(f'<p class="note">{html.escape(note)}</p>' for note in self.notes)
        caption = html.escape(self.title)
        return (
            f"<table><caption>{caption}</caption><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table>{notes}"
        )

    def frame(self) -> pd.DataFrame:
        """Return the table as a DataFrame of text."""
        import pandas as pd

        return pd.DataFrame(list(self.rows), columns=list(self.header))


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def characterization(groups: Iterable[Group], gripper: str = "rigid", reference: Quantity | None = None) -> Table:
    """Return Table S1 (rigid) or S2 (soft): one column per substrate, least and largest force over all pressures.

    Parameters
    ----------
    groups
        All groups; those of the protocol ``pull_off`` and of this gripper are used.
    reference
        sigma_ad of the membrane from its JKR test; the published one where ``None``.
    """
    stress = reference or PUBLISHED_STRESS.get(gripper, RIGID_ADHESION_STRESS)
    columns: dict[str, list[Group]] = {}
    for members in groups:
        condition = members.condition
        if condition.protocol == "pull_off" and condition.gripper == gripper and members.pooled("pull_off_force_N"):
            name = ", ".join(filter(None, (condition.substrate, condition.distinction)))
            columns.setdefault(name, []).append(members)
    cells = {substrate: _column(found, stress) for substrate, found in columns.items()}
    labels = (
        "Contact Area, A_c [cm²]",
        "Highest initial Pressure, P_0|h [kPa]",
        "Lowest initial Pressure, P_0|l [kPa]",
        "Min. Pull-off Force, F_off|Min [N]",
        "Max. Pull-off Force, F_off|Max [N]",
        "Enhancing Ratio, F_off|Max / F_off|Min",
        "Min. Adhesion Stress, σ_ad|Min [kPa]",
        "Max. Adhesion Stress, σ_ad|Max [kPa]",
        "Min. Adhesion Efficiency, ε_ad|Min [%]",
        "Max. Adhesion Efficiency, ε_ad|Max [%]",
        "Repeats at F_off|Min, F_off|Max",
    )
    rows = tuple((label, *(cells[substrate][i] for substrate in cells)) for i, label in enumerate(labels))
    name = {"rigid": "Table S1 | Characterization results of the rigid adhesion system"}.get(
        gripper, f"Table S2 | Characterization results of the {gripper} adhesion system"
    )
    notes = (
        f"Efficiencies, of glass only, against σ_ad = {_text(stress, 1e-3)} kPa ({stress.explanation}).",
        "Forces: mean ± standard uncertainty of the mean. Stress is F_off / A_c; A_c was measured, or is π r_e².",
        "A single pressure counts as the lowest where it is suction, and as the highest otherwise.",
    )
    return Table(name, ("Characterization Parameters", *cells), rows, notes)


def _column(groups: Sequence[Group], reference: Quantity) -> tuple[str, ...]:
    by_force = sorted(groups, key=lambda members: _mean(members, "pull_off_force_N").value)
    area, on_glass = _area(groups), groups[0].condition.on_glass
    ends: tuple[Group | None, Group | None] = (by_force[0], by_force[-1])
    if len(groups) == 1:
        gas = groups[0].pooled("initial_pressure_Pa")
        ends = (None, groups[0]) if gas is not None and gas.mean < 0 else (groups[0], None)
    forces = [None if members is None else _mean(members, "pull_off_force_N") for members in ends]
    stresses = [None if force is None or area is None else adhesion_stress(force, area) for force in forces]
    low, high = forces
    return (
        NOT_AVAILABLE if area is None else f"{area.value * 1e4:.2f}",
        *(_optional(pressure, 1e-3) for pressure in _pressures(groups, ends)),
        *map(_optional, forces),
        NOT_AVAILABLE if low is None or high is None else _text(enhancement_ratio(high, low)),
        *(_optional(stress, 1e-3) for stress in stresses),
        *(_optional(None if s is None or not on_glass else adhesion_efficiency(s, reference), 100) for s in stresses),
        ", ".join(NOT_AVAILABLE if members is None else str(len(members.kept)) for members in ends),
    )


def _pressures(groups: Sequence[Group], ends: tuple[Group | None, Group | None]) -> tuple[Quantity | None, ...]:
    """Return the highest and the lowest initial pressure; where there is but one, at the end it stands for."""
    found = [_mean(members, "initial_pressure_Pa") for members in groups if members.pooled("initial_pressure_Pa")]
    found.sort(key=lambda pressure: pressure.value)
    if len(found) < 2:
        only = found[0] if found else None
        return (None, only) if ends[0] is None else (only, None)
    return found[-1], found[0]


def _area(groups: Iterable[Group]) -> Quantity | None:
    """Return the mean of the areas that the stresses were taken of, those measured if any was, or ``None``."""
    known = [a for members in groups for a in members.kept if "adhesion_stress_Pa" in a.features]
    known = [a for a in known if "contact_area_mm2" in a.run.settings] or known
    return _average([_area_under(a) for a in known]) if known else None


def _area_under(analysis: Analysis) -> Quantity:
    """Return the area that a run's stress was taken of."""
    force, stress = (analysis.features[name] for name in ("pull_off_force_N", "adhesion_stress_Pa"))
    sources = (stress.budget.get(source, 0.0) for source in ("contact area", "effective radius"))
    area = force.value / stress.value
    return Quantity(area, area * math.hypot(*sources) / stress.value, "m^2", budget={"repeats": 0.0})


def _mean(members: Group, feature: str) -> Quantity:
    pooled = members.pooled(feature)
    assert pooled is not None
    return _quantity(pooled)


def _quantity(pooled: Pooled) -> Quantity:
    return Quantity(pooled.mean, pooled.uncertainty, pooled.unit, budget=pooled.budget)


def _text(quantity: Quantity, factor: float = 1.0) -> str:
    return with_uncertainty(quantity.value * factor, quantity.uncertainty * factor)


def _optional(quantity: Quantity | None, factor: float = 1.0) -> str:
    return NOT_AVAILABLE if quantity is None else _text(quantity, factor)


def jkr_summary(groups: Iterable[Group], gripper: str = "rigid") -> Table:
    """Return Table S3 (rigid) or S4 (soft): pull-off force and projected area by position, then w and sigma_ad.

    Work of adhesion and stress are given twice: as published (all forces, the areas there are) and from the positions
    with an area alone, because the published tables mix the two populations.
    """
    found = [m for m in groups if m.condition.protocol == "indentation" and m.condition.gripper == gripper]
    found = [m for m in found if m.pooled("pull_off_force_N")]
    rows = [
        (
            _place(m.condition),
            _pooled_text(m, "pull_off_force_N", 1e3),
            _pooled_text(m, "projected_area_m2", 1e6),
        )
        for m in found
    ]
    forces = [_mean(m, "pull_off_force_N") for m in found]
    both = [m for m in found if m.pooled("projected_area_m2")]
    areas = [_mean(m, "projected_area_m2") for m in both]
    works = [_mean(m, "work_of_adhesion_J_m2") for m in found if m.pooled("work_of_adhesion_J_m2")]
    rows.append(("AVG.", _average_text(forces, 1e3), _average_text(areas, 1e6)))
    rows.append(("Work of Adhesion, ω_ad [J·m⁻²]", _average_text(works), ""))
    stress = adhesion_stress(_average(forces), _average(areas)) if areas else None
    same = adhesion_stress(_average([_mean(m, "pull_off_force_N") for m in both]), _average(areas)) if areas else None
    rows.append(("Adhesion Stress, σ_ad [kPa]", _optional(stress, 1e-3), ""))
    rows.append(("Adhesion Stress, positions with an area alone [kPa]", _optional(same, 1e-3), ""))
    number = "S3" if gripper == "rigid" else "S4"
    title = f"Table {number} | Summary of F_off, ω_ad and σ_ad of the FAM for the {gripper} adhesion system"
    header = ("Position", "Pull-off force, F_off [mN]", "Projected Contact Area, A_pc [mm²]")
    notes = ("AVG. ± standard uncertainty of the mean over positions.", *_mixed(found))
    return Table(title, header, tuple(rows), notes)


def _place(condition: Condition) -> str:
    """Name a row: the place on the membrane or the sample, and what tells it from others there."""
    return ", ".join(filter(None, (condition.place, condition.distinction))) or str(condition)


def _mixed(groups: Iterable[Group]) -> tuple[str, ...]:
    """Warn of an average over what does not belong together."""
    different = any(members.condition.distinction for members in groups)
    return ("AVG. is over different conditions, as the rows name them.",) if different else ()


def _pooled_text(members: Group, feature: str, factor: float) -> str:
    pooled = members.pooled(feature)
    return _optional(None if pooled is None else _quantity(pooled), factor)


def _average(quantities: Sequence[Quantity]) -> Quantity:
    """Mean over positions; their spread is part of its uncertainty, and what calibration they share does not shrink."""
    n = len(quantities)
    value = sum(q.value for q in quantities) / n
    random = [q.budget.get("repeats", q.uncertainty) for q in quantities]
    own = math.hypot(*random) / n
    spread = math.sqrt(sum((q.value - value) ** 2 for q in quantities) / (n - 1) / n) if n > 1 else 0.0
    common = [math.sqrt(max(0.0, q.uncertainty**2 - r**2)) for q, r in zip(quantities, random, strict=True)]
    return Quantity(value, math.hypot(max(own, spread), sum(common) / n), quantities[0].unit)


def _average_text(quantities: Sequence[Quantity], factor: float = 1.0) -> str:
    return _text(_average(quantities), factor) if quantities else NOT_AVAILABLE


@dataclass(frozen=True, slots=True)
class FiberSample:
    """A sample of the single-fibre test: name, F_off, real and projected contact area of its fibres, where measured."""

    name: str
    force: Quantity
    real_area: Quantity | None
    projected_area: Quantity | None
    fibers: int = 3


def fiber_samples(groups: Iterable[Group]) -> list[FiberSample]:
    """Return the samples of the protocol ``fiber``."""
    found = []
    for members in groups:
        if members.condition.protocol != "fiber" or members.pooled("pull_off_force_N") is None:
            continue
        areas = [members.pooled(name) for name in ("real_area_m2", "projected_area_m2")]
        real, projected = (None if area is None else _quantity(area) for area in areas)
        force = _mean(members, "pull_off_force_N")
        fibers = int(members.kept[0].run.settings.get("fibers", 3))
        found.append(FiberSample(_place(members.condition), force, real, projected, fibers))
    return found


def fiber_summary(samples: Sequence[FiberSample]) -> Table:
    """Return Table S5: adhesion and areas by sample, then single-fibre force, area and stresses.

    Stresses take force and area of the samples that have the area.
    """
    fibers = samples[0].fibers
    force = _average([sample.force for sample in samples])
    real = [(s.force, s.real_area) for s in samples if s.real_area is not None]
    projected = [(s.force, s.projected_area) for s in samples if s.projected_area is not None]
    areas = [_average([area for _, area in found]) if found else None for found in (real, projected)]
    stresses = [
        None if area is None else adhesion_stress(_average([force for force, _ in found]), area)
        for found, area in zip((real, projected), areas, strict=True)
    ]
    rows: list[tuple[str, ...]] = [
        (s.name, _text(s.force, 1e3), _optional(s.real_area, 1e12), _optional(s.projected_area, 1e12)) for s in samples
    ]
    rows += [
        ("AVG.", _text(force, 1e3), *(_optional(area, 1e12) for area in areas)),
        ("Single Fiber Adhesion, F_off|sf [mN]", _text(force, 1e3 / fibers), "", ""),
        ("Single Fiber Real Contact Area, A_rc|sf [µm²]", _optional(areas[0], 1e12 / fibers), "", ""),
        ("Single Fiber Adhesion Stress, σ_ad|sf [kPa]", _optional(stresses[0], 1e-3), "", ""),
        (f"{fibers} Fibers Adhesion Stress, σ_ad|{fibers}f [kPa]", _optional(stresses[1], 1e-3), "", ""),
    ]
    header = ("Sample", "Adhesion, F_off [mN]", "Real Contact Area, A_rc [µm²]", "Projected Contact Area, A_pc [µm²]")
    title = "Table S5 | F_off, A_c and σ_ad of a single fiber and small area of microfiber array"
    return Table(title, header, tuple(rows))


def all_tables(groups: Sequence[Group]) -> list[Table]:
    """Return every table of the supporting information that the groups can fill."""
    tables = []
    for gripper in ("rigid", "soft"):
        measured = _measured_stress(groups, gripper)
        table = characterization(groups, gripper, measured)
        if len(table.header) > 1:
            tables.append(table)
        if any(m.condition.protocol == "indentation" and m.condition.gripper == gripper for m in groups):
            tables.append(jkr_summary(groups, gripper))
    samples = fiber_samples(groups)
    return [*tables, fiber_summary(samples)] if samples else tables


def _measured_stress(groups: Iterable[Group], gripper: str) -> Quantity | None:
    """Return sigma_ad of this campaign's own JKR tests, positions with an area, or ``None``."""
    found = [m for m in groups if m.condition.protocol == "indentation" and m.condition.gripper == gripper]
    both = [m for m in found if m.pooled("pull_off_force_N") and m.pooled("projected_area_m2")]
    if not both:
        return None
    force = _average([_mean(m, "pull_off_force_N") for m in both])
    area = _average([_mean(m, "projected_area_m2") for m in both])
    stress = adhesion_stress(force, area)
    return Quantity(stress.value, stress.uncertainty, "Pa", "JKR tests of this campaign")
