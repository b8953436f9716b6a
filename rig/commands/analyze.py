"""``rig analyze``: recordings to features, tables and reports."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analysis.batch import Analyzed
    from analysis.report import Source
    from rig.areas import Areas


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from model import MODELS

    parser.add_argument("recordings", nargs="*", type=Path, metavar="FILE", help="recordings (.h5)")
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
    parser.add_argument("--jobs", type=int, metavar="N", help="processes (default: one per core)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler to work on instead")


def run(arguments: argparse.Namespace) -> int:
    """Analyse and print or write what was asked for."""
    if arguments.published:
        return _published(as_json=arguments.json)
    if not arguments.recordings:
        from rig.errors import FileError

        raise FileError("no recording given. Remedy: name one or more .h5 files, or use --published")
    if _calibrations(arguments):
        return 0
    wants_pictures = arguments.report is not None or arguments.pdf is not None
    runs = analyze_files(
        arguments.recordings,
        model=arguments.model,
        pictures=wants_pictures,
        jobs=arguments.jobs,
        scheduler=arguments.scheduler,
        areas=_areas(arguments),
    )
    _write(arguments, runs)
    _print(arguments, runs)
    return 0


def _areas(arguments: argparse.Namespace) -> Areas:
    """Read the areas file; say which of its recordings are not analysed."""
    from rig.areas import read_areas, strangers

    if arguments.areas is None:
        return {}
    areas = read_areas(arguments.areas)
    for name in strangers(areas, (path.stem for path in arguments.recordings)):
        print(f"rig analyze: {arguments.areas}: {name} is not among the recordings", file=sys.stderr)
    return areas


def _calibrations(arguments: argparse.Namespace) -> bool:
    """Print what calibration recordings give; return whether there was nothing else to analyse."""
    from rig.calibrate import PROTOCOLS, calibrate
    from rig.errors import FileError
    from rig.recording import load_recording, protocol_of

    found = [path for path in arguments.recordings if protocol_of(path) in PROTOCOLS]
    if not found:
        return False
    options = ("json", "csv", "tables", "report", "pdf", "curves", "afm")
    if any(getattr(arguments, name) for name in options):
        raise FileError(f"{found[0]}: is a calibration, it has no features. Remedy: analyse it alone, without options.")
    for path in found:
        print(f"{path}\n{calibrate(load_recording(path))}")
    arguments.recordings = [path for path in arguments.recordings if path not in found]
    return not arguments.recordings


def analyze_files(
    paths: list[Path],
    *,
    model: str = "cone",
    pictures: bool = False,
    jobs: int | None = None,
    scheduler: str | None = None,
    areas: Areas | None = None,
) -> list[Analyzed]:
    """Analyse recordings, with progress on standard error; on several processes where there are more than three."""
    from tqdm import tqdm

    from analysis.batch import on_all_cores

    workers = 1 if jobs is None and len(paths) <= 3 else jobs
    function = partial(analyze_file, model=model, pictures=pictures, areas=areas)
    outcomes = on_all_cores(function, paths, workers=workers, scheduler=scheduler)
    quiet = len(paths) < 2 or not sys.stderr.isatty()
    return list(tqdm(outcomes, total=len(paths), unit="run", disable=quiet))


def analyze_file(path: Path, *, model: str = "cone", pictures: bool = False, areas: Areas | None = None) -> Analyzed:
    """Analyse one recording, with the contact areas measured for it since."""
    from analysis.batch import analyze_run
    from rig.areas import with_area
    from rig.measured import load_run

    return analyze_run(with_area(load_run(path), areas or {}), model=model, pictures=pictures)


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


def _write(arguments: argparse.Namespace, runs: list[Analyzed]) -> None:
    if arguments.report is not None or arguments.pdf is not None:
        from analysis.report import Report, write_html, write_pdf

        report = Report(runs, [source(path) for path in arguments.recordings], arguments.model, arguments.title)
        for path, write in ((arguments.report, write_html), (arguments.pdf, write_pdf)):
            if path is not None:
                write(report, path)
                print(f"report     {path}", file=sys.stderr)
    if arguments.curves is not None:
        _write_curves(arguments.curves, runs)
    if arguments.afm is not None:
        _write_afm(arguments.afm, arguments.recordings)


def source(path: Path) -> Source:
    """Return name and SHA-256 of a recording."""
    from analysis.report import Source

    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return Source(path.name, digest.hexdigest())


def _write_curves(directory: Path, runs: list[Analyzed]) -> None:
    from analysis.repeats import band, group

    directory.mkdir(parents=True, exist_ok=True)
    for analyzed in runs:
        curve = analyzed.analysis.curve
        if curve is not None:
            _csv(curve.frame(), directory / f"{analyzed.analysis.run.name}.csv")
    for number, members in enumerate(group(analyzed.analysis for analyzed in runs), start=1):
        mean = band(members)
        if mean is not None and mean.count > 1:
            frame = mean.frame()
            frame.insert(0, "condition", str(members.condition))
            _csv(frame, directory / f"mean-{number}.csv")


def _csv(frame: object, path: Path) -> None:
    import pandas as pd

    assert isinstance(frame, pd.DataFrame)
    path.write_text(frame.to_csv(index=False, float_format="%.9g", lineterminator="\n"), encoding="utf-8", newline="\n")


def _write_afm(directory: Path, paths: list[Path]) -> None:
    from analysis import analyze
    from analysis.export import write_afm
    from rig.measured import load_run

    directory.mkdir(parents=True, exist_ok=True)
    for path in paths:
        write_afm(analyze(load_run(path), uncertainties=False), directory / f"{path.stem}.tab")


def _print(arguments: argparse.Namespace, runs: list[Analyzed]) -> None:
    from analysis.export import features_csv, features_json

    analyses = [analyzed.analysis for analyzed in runs]
    if arguments.json:
        print(json.dumps(features_json(analyses), ensure_ascii=False))
    elif arguments.csv:
        print(features_csv(analyses), end="")
    elif arguments.tables:
        from analysis.repeats import group
        from analysis.tables import all_tables

        print("\n".join(table.markdown() for table in all_tables(group(analyses))))
    elif arguments.report is None and arguments.pdf is None and arguments.curves is None and arguments.afm is None:
        for analysis in analyses:
            print(f"{analysis.run.name}  ({analysis.run.protocol}{'' if analysis.run.complete else ', aborted'})")
            for name, quantity in analysis.features.items():
                print(f"  {name:32s} {quantity!s:>26s}   {quantity.explanation}")
            for name, reason in analysis.features.missing.items():
                print(f"  {name:32s} {'–':>26s}   missing: {reason}")
