"""``rig doctor``: check the bench; moves nothing."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rig.commands import BENCH

if TYPE_CHECKING:
    from rig.bench import Bench
    from rig.doctor import Finding


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--bench", type=Path, help=f"{BENCH}; without one the emulated bench is checked")
    parser.add_argument("--json", action="store_true", help="one JSON list on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Print what is found; return 1 if anything is not well."""
    import json
    from dataclasses import asdict

    from rig.bench import load_bench
    from rig.doctor import examine

    bench, text = load_bench(arguments.bench)
    findings = _emulated(bench, text) if bench.is_emulated else examine(bench)
    well, rows = True, []
    for finding in findings:
        well = well and finding.well
        rows.append(asdict(finding))
        if not arguments.json:
            remedy = f"\n{'':33}-> {finding.remedy}" if finding.remedy and not finding.well else ""
            print(f"{'ok' if finding.well else 'NOT OK':<8}{finding.what:<24} {finding.seen}{remedy}", flush=True)
    if arguments.json:
        print(json.dumps(rows, indent=2))
    return 0 if well else 1


def _emulated(bench: Bench, text: str) -> Iterator[Finding]:
    from rig.doctor import examine_emulated
    from rig.instruments import open_instruments
    from rig.library import load_scene
    from rig.safe_state import release
    from rig.session import Request

    scene, scene_text = load_scene("sphere-60mm-vented" if None in (bench.pump, bench.pressure) else "sphere-60mm-low")
    request = Request(scene, scene_text, bench, text, Path())
    opened = open_instruments(request)
    try:
        yield from examine_emulated(opened, request.bench)
    finally:
        release(opened.stage, opened.pump, opened.daq)
        opened.shut_down()
