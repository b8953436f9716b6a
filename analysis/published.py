"""Tables S1 to S5 of PNAS 2017 as printed, and a check of every derived value against the measured ones.

Measured values are the printed forces, pressures, areas and their rows; derived are ratios, stresses, efficiencies,
means and works of adhesion. Each derived value is recomputed twice: from the printed digits as they stand, and by
interval arithmetic on half a unit of the last printed digit. It *reproduces* if the first rounds to what is printed,
*agrees* if the second still overlaps it, and *disagrees* otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum

from analysis.intervals import Interval, as_printed, decimals, mean
from model import Gas, Parameters, Substrate

EFFECTIVE_RADIUS_CM = "0.73"
"""r_e of the rigid system, cm (SI section S3)."""

INDENTER_RADIUS_MM = 4.0
"""R of the JKR test, mm (SI section S4); a nominal value, taken as exact."""


@dataclass(frozen=True)
class Characterization:
    """A column of Table S1 or S2, as printed; ``None`` where the table says N/A."""

    substrate: str
    area: str | None
    highest_pressure: str
    lowest_pressure: str
    least_force: str
    largest_force: str
    ratio: str
    least_stress: str | None
    largest_stress: str | None
    least_efficiency: str | None
    largest_efficiency: str | None


TABLE_S1 = (
    Characterization("d_b 15 mm", None, "2.0", "-0.7", "0.13", "0.15", "1.2", None, None, None, None),
    Characterization("d_b 30 mm", None, "2.7", "-4.1", "0.12", "0.62", "5.0", None, None, None, None),
    Characterization("d_b 60 mm", "1.7", "1.6", "-3.2", "0.30", "0.88", "3.0", "1.2", "3.5", "1.8", "5.2"),
    Characterization("Flat Glass", "1.7", "1.6", "-2.9", "0.52", "1.12", "2.2", "2.0", "4.4", "3.1", "6.6"),
)
TABLE_S2 = (
    Characterization("d_b 15 mm", "0.6", "1.5", "-51.0", "0.18", "1.18", "6.7", "2.8", "18.7", "3.9", "25.7"),
    Characterization("d_b 30 mm", "1.5", "0.6", "-50.7", "0.42", "2.70", "6.4", "2.8", "18.1", "3.9", "25.0"),
    Characterization("d_b 60 mm", "2.5", "3.6", "-52.1", "0.49", "2.91", "6.0", "1.9", "11.4", "2.6", "15.8"),
    Characterization("Flat Glass", "2.5", "1.7", "-51.7", "0.66", "3.61", "5.4", "2.6", "14.2", "3.6", "19.5"),
    Characterization("Rubber Film", "2.5", "0.3", "-50.9", "0.08", "0.61", "7.2", "0.3", "2.4", None, None),
)


DISTANCES = {
    ("d_b 15 mm", "2.0"): ("2.48", "1.7"),
    ("d_b 15 mm", "-0.7"): ("2.21", None),
    ("d_b 60 mm", "1.6"): ("2.24", "1.0"),
    ("d_b 60 mm", "-3.2"): ("1.14", None),
}
"""D_p and z_r at F_p in mm by column and pressure of Table S1, where the text of EML gives them (section 3)."""


@dataclass(frozen=True, slots=True)
class Experiment:
    """One pull-off test of the rigid gripper; ``None`` where nothing is printed.

    Attributes
    ----------
    substrate
        Its column of Table S1.
    diameter
        d_b, m; ``None`` for the flat.
    pressure, force
        P_0, Pa gauge, and F_p, N.
    distance, retraction_at_force
        D_p and z_r at F_p, m.
    """

    substrate: str
    diameter: float | None
    pressure: float
    force: float
    distance: float | None
    retraction_at_force: float | None

    @property
    def parameters(self) -> Parameters:
        """The scene with the nominal values of EML."""
        shape = Substrate("flat") if self.diameter is None else Substrate("sphere", self.diameter)
        return Parameters(shape, gas=Gas(self.pressure))


def experiments() -> list[Experiment]:
    """Return the eight tests of Table S1, each substrate at its highest pressure and then at its lowest."""
    return [
        _experiment(column.substrate, pressure, force)
        for column in TABLE_S1
        for pressure, force in (
            (column.highest_pressure, column.least_force),
            (column.lowest_pressure, column.largest_force),
        )
    ]


def _experiment(substrate: str, pressure: str, force: str) -> Experiment:
    diameter = None if substrate.startswith("Flat") else float(substrate.split()[1]) * 1e-3
    distance, at_force = (
        None if text is None else float(text) * 1e-3 for text in DISTANCES.get((substrate, pressure), (None, None))
    )
    return Experiment(substrate, diameter, float(pressure) * 1e3, float(force), distance, at_force)


@dataclass(frozen=True)
class JkrTable:
    """Table S3 or S4: (position, F_off in mN, projected area in mm^2 or ``None``), then the last rows as printed."""

    name: str
    rows: tuple[tuple[str, str, str | None], ...]
    mean_force: str
    mean_area: str
    work: str
    stress: str


TABLE_S3 = JkrTable(
    "S3",
    (
        ("Top", "66.3", None),
        ("Center", "82.1", None),
        ("Bottom", "80.6", "0.78"),
        ("Left", "82.4", "0.78"),
        ("Right", "78.8", "0.76"),
    ),
    "78.0",
    "0.77",
    "4.1",
    "100.8",
)
TABLE_S4 = JkrTable(
    "S4",
    (
        ("Top", "105.8", None),
        ("Center", "41.6", "0.84"),
        ("Bottom", "55.1", None),
        ("Left", "68.0", "0.87"),
        ("Right", "38.3", "0.86"),
    ),
    "61.8",
    "0.86",
    "3.3",
    "72.5",
)

TABLE_S5_ROWS = (
    ("SPL#1", "1.8", "12787.0", "20687.3"),
    ("SPL#2", "2.1", "13451.3", "20586.1"),
    ("SPL#3", "1.7", "12552.0", "21025.9"),
)
"""Sample, F_off in mN, real and projected contact area in um^2 of three fibres."""

TABLE_S5_DERIVED = {
    "mean F_off [mN]": "1.9",
    "mean A_rc [um2]": "12930.1",
    "mean A_pc [um2]": "20766.4",
    "F_off|sf [mN]": "0.6",
    "A_rc|sf [um2]": "4310.0",
    "sigma_ad|sf [kPa]": "145.4",
    "sigma_ad|3f [kPa]": "90.5",
}


class Verdict(StrEnum):
    """What a check found."""

    REPRODUCES = "reproduces"
    AGREES = "agrees within rounding"
    DISAGREES = "disagrees"


@dataclass(frozen=True)
class Check:
    """One derived value, recomputed.

    Attributes
    ----------
    table, column, quantity
        Where it stands.
    printed
        As printed.
    recomputed
        From the printed digits as they stand.
    possible
        All values the digits allow.
    formula
        How it was recomputed.
    """

    table: str
    column: str
    quantity: str
    printed: str
    recomputed: float
    possible: Interval
    formula: str

    @property
    def verdict(self) -> Verdict:
        """Whether the printed value can be had from the measured ones."""
        if as_printed(self.recomputed, self.printed) == self.printed:
            return Verdict.REPRODUCES
        if self.possible.overlaps(Interval.printed(self.printed)):
            return Verdict.AGREES
        return Verdict.DISAGREES


ERRATUM = "Table S1, adhesion stress"
KNOWN_ERRATA = {
    ERRATUM: (
        "The printed stresses are F divided by 2.545 cm² = π (9 mm)², the contact area of the soft system (Table S2), "
        "not by the 1.674 cm² = π (7.3 mm)² of the rigid one. Divided by the right area they are 1.79, 5.26, 3.11 "
        "and 6.69 kPa. The efficiencies in the rows below used the right area."
    )
}


def checks() -> list[Check]:
    """Recompute every derived value of the five tables."""
    return [
        *_characterization("S1", TABLE_S1, TABLE_S3),
        *_characterization("S2", TABLE_S2, TABLE_S4),
        *_jkr(TABLE_S3),
        *_jkr(TABLE_S4),
        *_fibers(),
    ]


def is_erratum(check: Check) -> bool:
    """Whether a disagreement is the known one."""
    return f"Table {check.table}, {check.quantity.split('|')[0].split(' [')[0]}" in KNOWN_ERRATA


def _check(
    where: tuple[str, str, str], printed: str, formula: str, inputs: tuple[str, ...], rule: Callable[..., Interval]
) -> Check:
    exact = rule(*(Interval.exactly(float(text)) for text in inputs))
    return Check(*where, printed, exact.low, rule(*map(Interval.printed, inputs)), formula)


def _characterization(table: str, columns: tuple[Characterization, ...], jkr: JkrTable) -> Iterator[Check]:
    for column in columns:
        place = column.substrate
        yield _check(
            (table, place, "enhancing ratio"),
            column.ratio,
            "F_off|Max / F_off|Min",
            (column.largest_force, column.least_force),
            lambda high, low: high / low,
        )
        if column.area is None:
            continue
        if table == "S1":
            radius = EFFECTIVE_RADIUS_CM
            yield _check(
                (table, place, "contact area [cm2]"), column.area, "π r_e²", (radius,), lambda r: r * r * math.pi
            )
        ends = (("Min", column.least_force, column.least_stress), ("Max", column.largest_force, column.largest_stress))
        for end, force, stress in ends:
            if stress is not None:
                yield _check(
                    (table, place, f"adhesion stress|{end} [kPa]"),
                    stress,
                    f"F_off|{end} / A_c",
                    (force, column.area),
                    lambda f, a: f / a * 10.0,
                )
        efficiencies = (
            ("Min", column.least_force, column.least_efficiency),
            ("Max", column.largest_force, column.largest_efficiency),
        )
        for end, force, efficiency in efficiencies:
            if efficiency is not None:
                yield _check(
                    (table, place, f"adhesion efficiency|{end} [%]"),
                    efficiency,
                    f"F_off|{end} / A_c / sigma_ad (Table {jkr.name})",
                    (force, column.area, jkr.stress),
                    lambda f, a, s: f / a * 1000.0 / s,
                )


def _jkr(table: JkrTable) -> Iterator[Check]:
    forces = tuple(force for _, force, _ in table.rows)
    areas = tuple(area for _, _, area in table.rows if area is not None)
    name = table.name
    yield _check((name, "AVG.", "F_off [mN]"), table.mean_force, "mean of all five positions", forces, _mean)
    yield _check((name, "AVG.", "A_pc [mm2]"), table.mean_area, "mean of the three positions given", areas, _mean)
    yield _check(
        (name, "", "work of adhesion [J/m2]"),
        table.work,
        "2 F_off / (3 π R), mean of all five",
        forces,
        lambda *f: mean(f) * (2 / (3 * math.pi * INDENTER_RADIUS_MM)),
    )
    yield _check(
        (name, "", "adhesion stress [kPa]"),
        table.stress,
        "mean F_off of all five / mean A_pc of three",
        (*forces, *areas),
        lambda *both: mean(both[: len(forces)]) / mean(both[len(forces) :]),
    )


def _mean(*values: Interval) -> Interval:
    return mean(values)


def _fibers() -> Iterator[Check]:
    forces, real, projected = (tuple(row[i] for row in TABLE_S5_ROWS) for i in (1, 2, 3))
    n = len(TABLE_S5_ROWS)
    rules: dict[str, tuple[str, tuple[str, ...], Callable[..., Interval]]] = {
        "mean F_off [mN]": ("mean of three samples", forces, _mean),
        "mean A_rc [um2]": ("mean of three samples", real, _mean),
        "mean A_pc [um2]": ("mean of three samples", projected, _mean),
        "F_off|sf [mN]": ("mean F_off / 3 fibres", forces, lambda *f: mean(f) / 3.0),
        "A_rc|sf [um2]": ("mean A_rc / 3 fibres", real, lambda *a: mean(a) / 3.0),
        "sigma_ad|sf [kPa]": (
            "mean F_off / mean A_rc",
            (*forces, *real),
            lambda *both: mean(both[:n]) / mean(both[n:]) * 1e6,
        ),
        "sigma_ad|3f [kPa]": (
            "mean F_off / mean A_pc",
            (*forces, *projected),
            lambda *both: mean(both[:n]) / mean(both[n:]) * 1e6,
        ),
    }
    for quantity, (formula, inputs, rule) in rules.items():
        yield _check(("S5", "", quantity), TABLE_S5_DERIVED[quantity], formula, inputs, rule)


def consistent_populations(table: JkrTable) -> tuple[float, float]:
    """Return work of adhesion (J/m^2) and adhesion stress (kPa) from the three positions with an area alone."""
    pairs = [(float(force), float(area)) for _, force, area in table.rows if area is not None]
    force = sum(f for f, _ in pairs) / len(pairs)
    area = sum(a for _, a in pairs) / len(pairs)
    return 2 * force / (3 * math.pi * INDENTER_RADIUS_MM), force / area


def markdown() -> str:
    """Return the check as a page of documentation."""
    found = checks()
    counts = {verdict: sum(check.verdict is verdict for check in found) for verdict in Verdict}
    errata = sum(check.verdict is Verdict.DISAGREES and is_erratum(check) for check in found)
    work, stress = consistent_populations(TABLE_S4)
    work_rigid, stress_rigid = consistent_populations(TABLE_S3)
    lines = [
        "# Check of the published tables",
        "",
        "Written by `rig analyze --published`; a test holds it up to date. Every derived value of Tables S1 to S5 of",
        "PNAS 2017 (supporting information) is recomputed from the measured values printed beside it. *Reproduces*:",
        "the printed digits give the printed result. *Agrees within rounding*: some values that round to the printed",
        "digits give it. *Disagrees*: none do.",
        "",
        f"Of {len(found)} derived values {counts[Verdict.REPRODUCES]} reproduce, {counts[Verdict.AGREES]} agree within "
        f"rounding and {counts[Verdict.DISAGREES]} disagree; {errata} of these are the known erratum.",
        "",
        "## Known errata",
        "",
        *(f"- **{name}**: {text}" for name, text in KNOWN_ERRATA.items()),
        "",
        "## Mixed populations",
        "",
        "Tables S3 and S4 divide the mean force of five positions by the mean area of three. From the three positions",
        f"with an area alone, S3 gives {work_rigid:.2f} J/m² and {stress_rigid:.1f} kPa (printed 4.1 and 100.8),",
        f"S4 gives {work:.2f} J/m² and {stress:.1f} kPa (printed 3.3 and 72.5).",
        "",
        "## All derived values",
        "",
        "| Table | Column | Quantity | Printed | From the digits | Possible | Verdict | Formula |",
        "|---|---|---|---|---|---|---|---|",
        *map(_row, found),
        "",
    ]
    return "\n".join(lines)


def _row(check: Check) -> str:
    digits = decimals(check.printed) + 1
    possible = f"{check.possible.low:.{digits}f} to {check.possible.high:.{digits}f}"
    verdict = check.verdict.value
    if check.verdict is Verdict.DISAGREES:
        verdict = f"**{verdict}**" + (" (erratum)" if is_erratum(check) else "")
    cells = (
        f"S{check.table[1:]}",
        check.column,
        check.quantity.replace("|", "\\|").replace("2]", "²]").replace("um", "µm"),
        check.printed,
        f"{check.recomputed:.{digits}f}",
        possible,
        verdict,
        check.formula.replace("|", "\\|"),
    )
    return "| " + " | ".join(cells) + " |"
