"""Tables S1 to S5 in the layout of PNAS 2017, filled from groups of analysed runs."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from analysis.derived import adhesion_efficiency, adhesion_stress, enhancement_ratio, full_contact_area
from analysis.quantity import Quantity, with_uncertainty
from analysis.repeats import Group, Pooled

if TYPE_CHECKING:
    import pandas as pd

RIGID_ADHESION_STRESS = Quantity(100.8e3, math.nan, "Pa", "sigma_ad of the rigid system, Table S3 as published")
SOFT_ADHESION_STRESS = Quantity(72.5e3, math.nan, "Pa", "sigma_ad of the soft system, Table S4 as published")
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
            columns.setdefault(condition.substrate, []).append(members)
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
        f"Efficiencies against σ_ad = {stress.value / 1e3:.1f} kPa ({stress.explanation}).",
        "Forces: mean ± standard uncertainty of the mean. Stress is F_off / (π r_e²).",
    )
    return Table(name, ("Characterization Parameters", *cells), rows, notes)


def _column(groups: Sequence[Group], reference: Quantity) -> tuple[str, ...]:
    by_force = sorted(groups, key=lambda members: _mean(members, "pull_off_force_N").value)
    least, largest = by_force[0], by_force[-1]
    low, high = _mean(least, "pull_off_force_N"), _mean(largest, "pull_off_force_N")
    pressures = [_mean(m, "initial_pressure_Pa") for m in groups if m.pooled("initial_pressure_Pa")]
    pressures.sort(key=lambda pressure: pressure.value)
    area = _area(least)
    counts = ", ".join(str(len(members.kept)) for members in (least, largest))
    head = (
        NOT_AVAILABLE if area is None else f"{area.value * 1e4:.2f}",
        _text(pressures[-1], 1e-3) if pressures else NOT_AVAILABLE,
        _text(pressures[0], 1e-3) if pressures else NOT_AVAILABLE,
        _text(low),
        _text(high),
        NOT_AVAILABLE if least is largest else _text(enhancement_ratio(high, low)),
    )
    if area is None:
        return (*head, *[NOT_AVAILABLE] * 4, counts)
    stresses = [adhesion_stress(force, area) for force in (low, high)]
    efficiencies = [adhesion_efficiency(stress, _certain(reference)) for stress in stresses]
    return (*head, *(_text(s, 1e-3) for s in stresses), *(_text(e, 100) for e in efficiencies), counts)


def _area(members: Group) -> Quantity | None:
    """Return pi r_e^2 where the contact is full (as ``analysis.retraction.stress`` decides), else ``None``."""
    if members.pooled("adhesion_stress_Pa") is None:
        return None
    parameters = members.kept[0].run.parameters
    return None if parameters is None else full_contact_area(parameters.gripper.effective_radius)


def _certain(quantity: Quantity) -> Quantity:
    """A published value without a stated uncertainty adds none."""
    uncertainty = quantity.uncertainty if math.isfinite(quantity.uncertainty) else 0.0
    return Quantity(quantity.value, uncertainty, quantity.unit, quantity.explanation)


def _mean(members: Group, feature: str) -> Quantity:
    pooled = members.pooled(feature)
    assert pooled is not None
    return _quantity(pooled)


def _quantity(pooled: Pooled) -> Quantity:
    return Quantity(pooled.mean, pooled.uncertainty, pooled.unit)


def _text(quantity: Quantity, factor: float = 1.0) -> str:
    return with_uncertainty(quantity.value * factor, quantity.uncertainty * factor)


def jkr_summary(groups: Iterable[Group], gripper: str = "rigid") -> Table:
    """Return Table S3 (rigid) or S4 (soft): pull-off force and projected area by position, then w and sigma_ad.

    Work of adhesion and stress are given twice: as published (all forces, the areas there are) and from the positions
    with an area alone, because the published tables mix the two populations.
    """
    found = [m for m in groups if m.condition.protocol == "indentation" and m.condition.gripper == gripper]
    found = [m for m in found if m.pooled("pull_off_force_N")]
    rows = [
        (
            m.condition.place or str(m.condition),
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
    if areas:
        stress = adhesion_stress(_average(forces), _average(areas))
        same = adhesion_stress(_average([_mean(m, "pull_off_force_N") for m in both]), _average(areas))
        rows.append(("Adhesion Stress, σ_ad [kPa]", _text(stress, 1e-3), ""))
        rows.append(("Adhesion Stress, positions with an area alone [kPa]", _text(same, 1e-3), ""))
    number = "S3" if gripper == "rigid" else "S4"
    title = f"Table {number} | Summary of F_off, ω_ad and σ_ad of the FAM for the {gripper} adhesion system"
    header = ("Position", "Pull-off force, F_off [mN]", "Projected Contact Area, A_pc [mm²]")
    return Table(title, header, tuple(rows), ("AVG. ± standard uncertainty of the mean over positions.",))


def _pooled_text(members: Group, feature: str, factor: float) -> str:
    pooled = members.pooled(feature)
    return "" if pooled is None else _text(_quantity(pooled), factor)


def _average(quantities: Sequence[Quantity]) -> Quantity:
    """Mean over positions; the positions' spread is part of its uncertainty."""
    n = len(quantities)
    mean = sum(q.value for q in quantities) / n
    own = math.sqrt(sum(q.uncertainty**2 for q in quantities)) / n
    spread = math.sqrt(sum((q.value - mean) ** 2 for q in quantities) / (n - 1) / n) if n > 1 else 0.0
    return Quantity(mean, max(own, spread), quantities[0].unit)


def _average_text(quantities: Sequence[Quantity], factor: float = 1.0) -> str:
    return _text(_average(quantities), factor) if quantities else NOT_AVAILABLE


@dataclass(frozen=True, slots=True)
class FiberSample:
    """A sample of the single-fibre test: name, F_off, real and projected contact area of its fibres (N, m^2)."""

    name: str
    force: Quantity
    real_area: float
    projected_area: float
    fibers: int = 3


def fiber_samples(groups: Iterable[Group]) -> list[FiberSample]:
    """Return the samples of the protocol ``fiber``; areas: ``real_area_um2``, ``projected_area_um2`` of the scene."""
    found = []
    for members in groups:
        if members.condition.protocol != "fiber" or members.pooled("pull_off_force_N") is None:
            continue
        settings: Mapping[str, float | str] = members.kept[0].run.settings
        real, projected = (
            float(settings.get(key, math.nan)) * 1e-12 for key in ("real_area_um2", "projected_area_um2")
        )
        force = _mean(members, "pull_off_force_N")
        found.append(FiberSample(members.condition.place, force, real, projected, int(settings.get("fibers", 3))))
    return found


def fiber_summary(samples: Sequence[FiberSample]) -> Table:
    """Return Table S5: adhesion and areas by sample, then single-fibre force, area and stresses."""
    force = _average([sample.force for sample in samples])
    real = sum(sample.real_area for sample in samples) / len(samples)
    projected = sum(sample.projected_area for sample in samples) / len(samples)
    fibers = samples[0].fibers
    rows = [
        (s.name, _text(s.force, 1e3), f"{s.real_area * 1e12:.1f}", f"{s.projected_area * 1e12:.1f}") for s in samples
    ]
    rows.append(("AVG.", _text(force, 1e3), f"{real * 1e12:.1f}", f"{projected * 1e12:.1f}"))
    single = Quantity(force.value / fibers, force.uncertainty / fibers, "N")
    of_real, of_projected = (Quantity(force.value / area, force.uncertainty / area, "Pa") for area in (real, projected))
    rows += [
        ("Single Fiber Adhesion, F_off|sf [mN]", _text(single, 1e3), "", ""),
        ("Single Fiber Real Contact Area, A_rc|sf [µm²]", f"{real / fibers * 1e12:.1f}", "", ""),
        ("Single Fiber Adhesion Stress, σ_ad|sf [kPa]", _text(of_real, 1e-3), "", ""),
        (f"{fibers} Fibers Adhesion Stress, σ_ad|{fibers}f [kPa]", _text(of_projected, 1e-3), "", ""),
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
