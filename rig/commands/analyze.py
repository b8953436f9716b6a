"""``rig analyze``: recordings to features, tables and reports."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.commands import count

if TYPE_CHECKING:
    from analysis.batch import Analyzed
    from analysis.repeats import Group
    from rig.collection import Collection

FOR_FEATURES = ("csv", "tables", "report", "pdf", "curves", "afm")
"""Options that ask for what a calibration recording does not hold."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from model import MODELS

    parser.add_argument(
        "recordings", nargs="*", type=Path, metavar="FILE", help="recordings (.h5), or folders of recordings"
    )
    output = parser.add_mutually_exclusive_group()
    output.add_argument("--json", action="store_true", help="print one JSON object")
    output.add_argument("--csv", action="store_true", help="print the features as CSV, one row each")
    output.add_argument(
        "--tables", action="store_true", help="print Tables S1 to S5 as far as the recordings fill them"
    )
    parser.add_argument("--published", action="store_true", help="check the published tables; needs no recording")
    parser.add_argument("--report", type=Path, metavar="HTML", help="write one self-contained page")
    parser.add_argument("--pdf", type=Path, metavar="PDF", help="write the report as PDF")
    parser.add_argument("--curves", type=Path, metavar="DIR", help="write each curve, and each mean of repeats, as CSV")
    parser.add_argument("--afm", type=Path, metavar="DIR", help="write each run as .tab for afmformats, nanite, PyJibe")
    parser.add_argument("--areas", type=Path, metavar="CSV", help="contact areas by recording (rig contact-area)")
    parser.add_argument("--model", choices=MODELS, default="cone", help="model drawn over the data")
    parser.add_argument("--title", default="Pull-off tests", help="title of the report")
    parser.add_argument("--jobs", type=count, metavar="N", help="processes (default: one per core)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler to work on instead")


def run(arguments: argparse.Namespace) -> int:
    """Analyse and print or write what was asked for; 1 where something had to be left out, 2 where everything had."""
    from rig.areas import read_areas, strangers, useless
    from rig.collection import collect, own_names
    from rig.errors import FileError
    from rig.output import prepare, prepare_folder

    if arguments.published:
        return _published(as_json=arguments.json)
    if not arguments.recordings:
        raise FileError("no recording given. Remedy: name .h5 files or their folder, or use --published")
    prepare("--report", arguments.report, ".html", ".htm")
    prepare("--pdf", arguments.pdf, ".pdf")
    prepare_folder("--curves", arguments.curves)
    prepare_folder("--afm", arguments.afm)
    areas = {} if arguments.areas is None else read_areas(arguments.areas)
    found = collect(
        arguments.recordings,
        model=arguments.model,
        pictures=arguments.report is not None or arguments.pdf is not None,
        jobs=arguments.jobs,
        scheduler=arguments.scheduler,
        areas=areas,
    )
    for name in strangers(areas, own_names(found.files)):
        print(f"rig analyze: {arguments.areas}: {name} is not among the recordings", file=sys.stderr)
    for words in useless(areas, (analyzed.analysis.run for analyzed in found.runs)):
        print(f"rig analyze: {arguments.areas}: {words}", file=sys.stderr)
    if any(getattr(arguments, name) for name in FOR_FEATURES):
        found.leave_calibrations()
    unwritten = _write(arguments, found) if found.runs else []
    _print(arguments, found)
    found.tell()
    for line in unwritten:
        print(line, file=sys.stderr)
    return found.exit_code or int(bool(unwritten))


def _published(*, as_json: bool) -> int:
    from analysis.published import checks, markdown

    if not as_json:
        print(markdown())
        return 0
    rows = [
        {
            "table": check.table,
            "column": check.column,
            "quantity": check.quantity,
            "printed": check.printed,
            "recomputed": check.recomputed,
            "possible": [check.possible.low, check.possible.high],
            "verdict": check.verdict.value,
        }
        for check in checks()
    ]
    print(json.dumps({"checks": rows}))
    return 0


def _write(arguments: argparse.Namespace, found: Collection) -> list[str]:
    """Write the files asked for; return what could not be written, a line each."""
    from rig.output import writing

    if arguments.report is not None or arguments.pdf is not None:
        from analysis.report import Report, write_html, write_pdf

        report = Report(found.runs, arguments.model, arguments.title, found.left)
        for option, path, write in (
            ("--report", arguments.report, write_html),
            ("--pdf", arguments.pdf, write_pdf),
        ):
            if path is not None:
                with writing(option, path):
                    write(report, path)
                print(f"report     {path}", file=sys.stderr)
    unwritten = []
    if arguments.curves is not None:
        with writing("--curves", arguments.curves):
            unwritten += _write_curves(arguments.curves, found.runs)
    if arguments.afm is not None:
        with writing("--afm", arguments.afm):
            unwritten += _write_afm(arguments.afm, found.runs)
    return unwritten


def _write_curves(directory: Path, runs: list[Analyzed]) -> list[str]:
    from analysis.repeats import band, group

    unwritten = []
    for analyzed in runs:
        curve, name = analyzed.analysis.curve, analyzed.analysis.run.name
        if curve is None:
            unwritten.append(f"no curve: {name}: {analyzed.analysis.no_curve}")
        else:
            _csv(curve.frame(), directory / f"{name}.csv")
    for number, members in enumerate(group(analyzed.analysis for analyzed in runs), start=1):
        mean = band(members)
        if mean is not None and mean.count > 1:
            frame = mean.frame()
            frame.insert(0, "condition", str(members.condition))
            _csv(frame, directory / f"mean-{number}.csv")
    return unwritten


def _csv(frame: object, path: Path) -> None:
    import pandas as pd

    assert isinstance(frame, pd.DataFrame)
    path.write_text(frame.to_csv(index=False, float_format="%.9g", lineterminator="\n"), encoding="utf-8", newline="\n")


def _write_afm(directory: Path, runs: list[Analyzed]) -> list[str]:
    """Write every run in its full resolution, which the analysis of many has let go."""
    from dataclasses import replace

    from analysis import AnalysisError, analyze
    from analysis.export import write_afm
    from rig.measured import load_run

    unwritten = []
    for analyzed in runs:
        name, source = analyzed.analysis.run.name, analyzed.source
        assert source is not None
        try:
            whole = analyze(replace(load_run(Path(source.path)), name=name), uncertainties=False)
            write_afm(whole, directory / f"{name}.tab")
        except AnalysisError as error:
            unwritten.append(f"no .tab: {error}")
    return unwritten


def _print(arguments: argparse.Namespace, found: Collection) -> None:
    from analysis.export import features_csv
    from analysis.repeats import group

    analyses = [analyzed.analysis for analyzed in found.runs]
    emulated = [a.analysis.run.name for a in found.runs if a.source is not None and a.source.metadata.get("emulated")]
    if emulated and (arguments.csv or arguments.tables or arguments.curves):  # these have no room for it
        print(f"rig analyze: EMULATED, no experiment: {', '.join(emulated)}", file=sys.stderr)
    if arguments.json:
        print(json.dumps(as_json(found), ensure_ascii=False))
    elif arguments.csv and analyses:
        print(features_csv(analyses), end="")
    elif arguments.tables and analyses:
        _print_tables(group(analyses))
    elif not any(getattr(arguments, name) for name in FOR_FEATURES):
        for calibrated in found.calibrations:
            print(f"{calibrated.source.path}\n{calibrated.calibration}")
        for analyzed in found.runs:
            _print_words(analyzed)


def _print_tables(groups: list[Group]) -> None:
    """Print the papers' tables and what was left out of them; say so where no table knows these tests."""
    from analysis.report import outlier_table
    from analysis.tables import all_tables

    tables = all_tables(groups)
    if tables:
        print("\n".join(table.markdown() for table in [*tables, *outlier_table(groups)]))
        return
    protocols = ", ".join(dict.fromkeys(members.condition.protocol for members in groups))
    print(
        f"rig analyze: Tables S1 to S5 know no such tests ({protocols}). Remedy: leave out --tables.", file=sys.stderr
    )


def as_json(found: Collection) -> dict[str, Any]:
    """Return the object of ``--json``: of one recording its features, of several ``runs`` and what they have in common.

    A calibration has ``calibration`` in place of the features.
    """
    from analysis.export import features_json, source_json

    calibrations = [
        {
            "run": Path(calibrated.source.name).stem,
            "protocol": calibrated.protocol,
            **source_json(calibrated.source),
            "calibration": dict(calibrated.calibration.numbers),
            "bench_file": calibrated.calibration.toml,
        }
        for calibrated in found.calibrations
    ]
    left = [{"file": name, "reason": reason} for name, reason in found.left.items()]
    several = features_json(found.runs)
    runs = several["runs"]
    assert isinstance(runs, list)
    if len(found.files) == 1 and len(runs) + len(calibrations) == 1:
        return {**[*runs, *calibrations][0], "analysed_with": several["analysed_with"], "not_analysed": left}
    return {**several, "calibrations": calibrations, "not_analysed": left}


def _print_words(analyzed: Analyzed) -> None:
    analysis, source = analyzed.analysis, analyzed.source
    emulated = source is not None and source.metadata.get("emulated")
    words = [analysis.run.protocol, *["EMULATED"] * bool(emulated), *["aborted"] * (not analysis.run.complete)]
    print(f"{analysis.run.name}  ({', '.join(words)})")
    for name, quantity in analysis.features.items():
        print(f"  {name:32s} {quantity!s:>26s}   {quantity.explanation}")
    for name, reason in analysis.features.missing.items():
        print(f"  {name:32s} {'–':>26s}   missing: {reason}")
