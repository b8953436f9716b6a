"""One self-contained report of any number of runs: HTML with the pictures inside, or PDF. Same input, same bytes."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING

from analysis.batch import Analyzed
from analysis.export import versions
from analysis.figures.registry import Material, picture
from analysis.pipeline import Analysis
from analysis.quantity import DISPLAY, Quantity, with_uncertainty
from analysis.repeats import OUTLIER_RULE, Group, group
from analysis.tables import Table, all_tables
from model.prediction import Prediction

if TYPE_CHECKING:
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure

PDF_COLUMNS, PDF_LINES = 205, 70
"""Characters in a line of the PDF's tables, and lines on a page."""

NO_BREAK = "\u00a0"
"""Holds a number and its uncertainty on one line; between a mean and its deviation a cell may break."""

EMULATED = "EMULATED: {which} from an emulated bench, not from an experiment: samples and instruments are computed."


@dataclass
class Report:
    """What a report is made of.

    Attributes
    ----------
    runs
        In any order; the report shows them by condition. Their names differ.
    model
        Names the prediction drawn over the curves.
    not_analysed
        Files that are left out, and why.
    """

    runs: Sequence[Analyzed]
    model: str = "cone"
    title: str = "Pull-off tests"
    not_analysed: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.groups: list[Group] = group(analyzed.analysis for analyzed in self.runs)
        self.material = Material(self.groups, self.model)

    def by_condition(self) -> Iterator[tuple[Group, list[Analyzed]]]:
        """Return each group with its runs."""
        runs = {analyzed.analysis.run.name: analyzed for analyzed in self.runs}
        for members in self.groups:
            yield members, [runs[member.run.name] for member in members.members]

    def warning(self) -> str:
        """Say what of the data is emulated; empty where nothing is."""
        count = sum(bool(a.source and a.source.metadata.get("emulated")) for a in self.runs)
        if not count:
            return ""
        return EMULATED.format(
            which="all data are" if count == len(self.runs) else f"{count} of {len(self.runs)} recordings are"
        )

    def tables(self) -> list[Table]:
        """Return the papers' tables, the pooled numbers, the outliers and what could not be analysed."""
        tables = [*all_tables(self.groups), pooled_table(self.groups), *outlier_table(self.groups)]
        rows = tuple((_file_name(path), reason) for path, reason in self.not_analysed.items())
        return [*tables, Table("Not analysed", ("File", "Why"), rows)] if rows else tables

    def figures(self) -> list[str]:
        """Return the numbers of the papers' figures that these recordings can fill."""
        chosen = []
        spheres = {m.condition.diameter for m in self.material.pull_offs() if not m.condition.flat}
        chosen += [number for number, d in (("3a", 15e-3), ("3b", 30e-3), ("3c", 60e-3)) if d in spheres]
        if len(self.material.pull_offs()) > 1:
            chosen += ["5a", "5b", "5c"] if spheres else ["5c"]
        if any(m.condition.protocol == "punch" for m in self.groups):
            chosen.append("3e")
        if any(m.condition.protocol == "indentation" for m in self.groups):
            chosen.append("S9")
        return chosen


def pooled_table(groups: Sequence[Group]) -> Table:
    """Return the main features of every condition: mean, its uncertainty, standard deviation and number of repeats."""
    features = {
        "pull_off_force_N": "F_p [N]",
        "pull_off_distance_m": "D_p [mm]",
        "retraction_at_pull_off_m": "z_r at F_p [mm]",
        "initial_pressure_Pa": "P_0 [kPa]",
        "preload_N": "Preload [N]",
        "adhesion_energy_J": "Energy [mJ]",
        "work_of_adhesion_J_m2": "ω_ad [J/m²]",
        "chamber_volume_m3": "V_0 [mL]",
        "leak_rate_Pa_s": "Leak [Pa/s]",
    }
    used = {name: label for name, label in features.items() if any(m.pooled(name) for m in groups)}
    rows = tuple((str(m.condition), str(len(m.kept)), *(_pooled_cell(m, name) for name in used)) for m in groups)
    notes = (
        "Mean ± standard uncertainty of the mean, the sensors' calibration included, as in Tables S1 to S5.",
        "s: standard deviation of the n repeats; a single one has its own uncertainty.",
    )
    return Table("Repeats by condition", ("Condition", "n", *used.values()), rows, notes)


def _pooled_cell(members: Group, name: str) -> str:
    pooled = members.pooled(name)
    if pooled is None:
        return "–"
    factor = DISPLAY.get(pooled.unit, ("", 1.0))[1]
    mean = with_uncertainty(pooled.mean * factor, pooled.uncertainty * factor)
    remarks = [f"s = {pooled.deviation * factor:.2g}"] if pooled.count > 1 else []
    remarks += [f"n = {pooled.count}"] if pooled.count < len(members.kept) else []
    parts = [mean, f"({', '.join(remarks)})"] if remarks else [mean]
    return " ".join(part.replace(" ", NO_BREAK) for part in parts)


def outlier_table(groups: Sequence[Group]) -> list[Table]:
    """Return a table of the runs left out, or the sentence that there are none."""
    rows = tuple((name, str(m.condition), reason) for m in groups for name, reason in m.outliers.items())
    shown = rows or (("none", "", ""),)
    return [Table("Outliers", ("Run", "Condition", "Why"), shown, (f"Rule: {OUTLIER_RULE}",))]


def feature_table(analysis: Analysis) -> Table:
    """Return every feature of one run with its uncertainty, the largest source of it, and what it is."""
    rows = [
        (name, str(quantity), _largest_source(quantity), quantity.explanation)
        for name, quantity in analysis.features.items()
    ]
    rows += [(name, "–", "", f"missing: {reason}") for name, reason in analysis.features.missing.items()]
    return Table("Features", ("Feature", "Value", "Largest source of uncertainty", "What it is"), tuple(rows))


def _largest_source(quantity: Quantity) -> str:
    if not quantity.budget or quantity.uncertainty == 0:
        return ""
    source, part = max(quantity.budget.items(), key=lambda item: item[1])
    return f"{source} ({(part / quantity.uncertainty) ** 2:.0%})"


STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#1b1b1b;background:#fff;max-width:88rem;margin:2rem auto;padding:0
1.2rem} h1{font-size:1.6rem;margin-bottom:.2rem}h2{font-size:1.2rem;margin-top:2.4rem;border-bottom:1px solid #ccc}
h3{font-size:1.08rem;margin:2rem 0 .4rem}h4{font-size:1rem;margin:1.4rem 0 .4rem}
.warning{border-left:4px solid #D55E00;padding:.3rem .8rem;background:#fdf1ea;font-weight:600}
table{border-collapse:collapse;margin:.8rem 0;font-size:.84rem;display:block;overflow-x:auto}
caption{text-align:left;font-weight:600;padding:.3rem 0}
th,td{padding:.22rem .6rem;border-bottom:1px solid #e2e2e2;text-align:left;vertical-align:top}
td{font-variant-numeric:tabular-nums;white-space:nowrap}details td:last-child{white-space:normal}
thead th{border-bottom:2px solid #999;white-space:nowrap}
tbody th{font-weight:500;white-space:nowrap}.results th,.results td{white-space:normal}
.note{font-size:.8rem;color:#555;margin:.1rem 0}
img{max-width:100%;height:auto}.pair{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(34rem,100%),1fr));gap:1rem}
code{font-size:.8rem;word-break:break-all}details{margin:.5rem 0}summary{cursor:pointer;color:#0072B2}
@media print{details{display:block}table{display:table;font-size:.7rem}}
"""


def write_html(report: Report, path: Path) -> None:
    """Write the report as one HTML page that needs no other file and no network."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(_page(report)), encoding="utf-8", newline="\n")


def _page(report: Report) -> Iterator[str]:
    count = len(report.runs)
    title = html.escape(report.title)
    yield f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield f"<style>{STYLE}</style></head><body>"
    complete = sum(analyzed.analysis.run.complete for analyzed in report.runs)
    yield f"<h1>{title}</h1><p>{count} {_plural('recording', count)}, {complete} complete, "
    conditions = len(report.groups)
    yield f"{conditions} {_plural('condition', conditions)}. Uncertainties are one standard deviation.</p>"
    if report.warning():
        yield f'<p class="warning">{html.escape(report.warning())}</p>'
    if report.not_analysed:
        left = len(report.not_analysed)
        yield f'<p class="warning">{left} {_plural("file", left)} could not be analysed, see below.</p>'
    yield '<h2>Results</h2><div class="results">'
    for table in report.tables():
        yield table.html()
    yield "</div>"
    figures = report.figures()
    if figures:
        yield '<h2>Figures</h2><div class="pair">'
        for number in figures:
            yield f"<figure>{_image(picture(number, report.material), f'Figure {number}')}"
            yield f"<figcaption>Figure {number}</figcaption></figure>"
        yield "</div>"
    yield "<h2>Runs</h2>"
    for members, runs in report.by_condition():
        yield f"<h3>{html.escape(str(members.condition))}</h3>"
        for analyzed in runs:
            yield from _run(analyzed)
    yield "<h2>Sources and versions</h2>"
    for table in _sources(report):
        yield table.html()
    yield Table("Versions", ("Package", "Version"), tuple(versions().items())).html()
    yield "</body></html>\n"


def _plural(word: str, count: int) -> str:
    return word if count == 1 else word + "s"


def _image(data: bytes, words: str) -> str:
    encoded = base64.b64encode(data).decode("ascii")
    return f'<img alt="{html.escape(words)}" src="data:image/png;base64,{encoded}">'


def _run(analyzed: Analyzed) -> Iterator[str]:
    analysis, prediction = analyzed.analysis, analyzed.prediction
    run = analysis.run
    yield f"<h4>{html.escape(run.name)}</h4>"
    ended = "" if run.complete else " This run was aborted; what it holds is analysed."
    yield f'<p class="note">{html.escape(run.protocol)}, {analyzed.samples} samples at {analyzed.rate:g} Hz.{ended}</p>'
    yield _image(analyzed.overview, f"{run.name}: force and pressure")
    if prediction is None:
        yield f'<p class="note">No prediction: {html.escape(analyzed.no_prediction)}.</p>'
    else:
        yield _comparison(analysis, prediction).html()
    yield f"<details><summary>All features</summary>{feature_table(analysis).html()}</details>"
    yield "<details><summary>Why: the decisions of each step</summary>"
    yield Table("Decisions", ("Step", "Decision"), tuple(analysis.decisions.items())).html()
    yield _image(analyzed.reasons, f"{run.name}: decisions") + "</details>"


def _comparison(analysis: Analysis, prediction: Prediction) -> Table:
    """Measured against predicted; the prediction's own numerical error beside it."""
    pairs = (
        ("F_p", "pull_off_force_N", prediction.pull_off_force, "pull_off_force"),
        ("D_p", "pull_off_distance_m", prediction.pull_off_distance, "pull_off_distance"),
        ("z_r at F_p", "retraction_at_pull_off_m", prediction.retraction_at_pull_off, "retraction_at_pull_off"),
        ("Adhesion energy", "adhesion_energy_J", prediction.adhesion_energy, "adhesion_energy"),
    )
    rows = []
    for label, name, predicted, key in pairs:
        if name not in analysis.features:
            continue
        measured = analysis.features[name]
        unit, factor = DISPLAY.get(measured.unit, (measured.unit, 1.0))
        error = prediction.numerical_error.get(key, prediction.numerical_error.get(name, float("nan")))
        ratio = f"{(predicted / measured.value - 1):+.1%}" if measured.value else ""
        rows.append((label, str(measured), f"{predicted * factor:.5g} {unit}", f"{error * factor:.1g} {unit}", ratio))
    header = ("Quantity", "Measured", f"Model ({prediction.model})", "Numerical error", "Model against measured")
    return Table("Measured and predicted", header, tuple(rows))


def _sources(report: Report) -> list[Table]:
    """Return where the runs came from: what all recordings say alike, then what differs, by recording."""
    sources = [a.source for _, runs in report.by_condition() for a in runs if a.source is not None]
    told = [{key: _words(value) for key, value in source.metadata.items()} for source in sources]
    keys = list(dict.fromkeys(key for one in told for key in one))
    differ = [key for key in keys if len({one.get(key) for one in told}) > 1]
    same = tuple((_label(key), told[0][key]) for key in keys if key not in differ and told[0][key])
    rows = tuple(
        (source.name, *(one.get(key, "") for key in differ), source.sha256)
        for source, one in zip(sources, told, strict=True)
    )
    each = Table("Recordings", ("File", *map(_label, differ), "SHA-256"), rows)
    return [Table("Of every recording", ("", ""), same), each] if same else [each]


def _label(key: str) -> str:
    words = key.removesuffix("_Pa").replace("_", " ")
    return f"{words} [Pa]" if key.endswith("_Pa") else words


def _words(value: object) -> str:
    """Write what a recording says of its making as a cell."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {text}" for name, text in value.items())
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    return "" if value is None else str(value)


def _file_name(path: str) -> str:
    return Path(path).name


def write_pdf(report: Report, path: Path) -> None:
    """Write the report as PDF: tables first, then the figures, then one page per run and one for its decisions."""
    from matplotlib.backends.backend_pdf import PdfPages

    path.parent.mkdir(parents=True, exist_ok=True)
    fixed = {"Creator": None, "Producer": None, "CreationDate": None}
    with PdfPages(path, metadata=fixed) as pages:
        _pdf_pages(report, pages)


def _pdf_pages(report: Report, pages: PdfPages) -> None:
    from analysis.figures.registry import find
    from analysis.figures.style import canvas, plain

    tables = [*report.tables(), *_sources(report)]
    lines = [report.title, report.warning(), "", *(line for table in tables for line in _text_lines(table))]
    lines += ["", *(f"{name} {number}" for name, number in versions().items())]
    for first in range(0, len(lines), PDF_LINES):
        with canvas(11.7, 8.3) as figure:
            figure.set_layout_engine("none")
            text = plain("\n".join(lines[first : first + PDF_LINES]))
            figure.text(0.03, 0.97, text, va="top", family="DejaVu Sans Mono", fontsize=6)
            pages.savefig(figure)  # type: ignore[no-untyped-call]
    for number in report.figures():
        chosen = find(number)
        with canvas(*chosen.size) as figure:
            chosen.draw_marked(figure, report.material)
            pages.savefig(figure)  # type: ignore[no-untyped-call]
    for analyzed in (analyzed for _, runs in report.by_condition() for analyzed in runs):
        for data in (analyzed.overview, analyzed.reasons):
            with canvas(8.3, 8.3) as figure:
                _place(figure, data)
                pages.savefig(figure)  # type: ignore[no-untyped-call]


def _place(figure: Figure, data: bytes) -> None:
    """Put a finished picture on a page."""
    import io

    from matplotlib.image import imread

    axes = figure.subplots()
    axes.set_axis_off()
    axes.imshow(imread(io.BytesIO(data), format="png"), interpolation="none")


def _text_lines(table: Table) -> list[str]:
    rows = [table.header, *table.rows]
    widths = [max(len(row[i]) for row in rows) for i in range(len(table.header))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return [table.title, *(part for line in [*lines, *table.notes] for part in _folded(line)), ""]


def _folded(line: str) -> list[str]:
    """Cut a line into what a page is wide."""
    return [line[:PDF_COLUMNS], *(f"    {part}" for part in wrap(line[PDF_COLUMNS:], PDF_COLUMNS - 4))]
