"""Files other programs read: tables for spreadsheets, and force-distance curves for afmformats, nanite and AtomicJ."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from analysis.batch import Analyzed, Source
from analysis.errors import AnalysisError
from analysis.numerics import Array, block_means
from analysis.pipeline import Analysis
from analysis.repeats import group, pooled_frame

PACKAGES = ("numpy", "scipy", "matplotlib", "pandas")

AFM_POINTS = 20_000
"""A curve is averaged into at most so many points for export."""


def features_csv(analyses: Sequence[Analysis]) -> str:
    """Return one row per run and feature: run, feature, value, uncertainty, unit, explanation, missing.

    A feature that the run does not hold has no value; ``missing`` says why.

    Of several runs also one row per condition and feature: the condition in place of the run, mean, uncertainty of the
    mean, unit, and two columns of their own: standard_deviation and count (empty for single runs).
    """
    import pandas as pd

    frames = []
    for analysis in analyses:
        frame = analysis.features.frame().reset_index()
        frame.insert(0, "run", analysis.run.name)
        frame["missing"] = ""
        frames.append(frame)
        rows = [(analysis.run.name, *row) for row in analysis.features.missing.items()]
        if rows:
            frames.append(pd.DataFrame(rows, columns=["run", "feature", "missing"]))
    if len(analyses) > 1:
        names = {"condition": "run", "mean": "value", "uncertainty_of_mean": "uncertainty"}
        frames.append(pooled_frame(group(analyses)).rename(columns=names))
    table = pd.concat(frames, ignore_index=True)
    return str(table.to_csv(index=False, float_format="%.9g", lineterminator="\n"))


def features_json(runs: Sequence[Analyzed]) -> dict[str, object]:
    """Return ``runs``, each with its features, source and condition, and ``pooled`` by condition."""
    groups = group(analyzed.analysis for analyzed in runs)
    pooled = pooled_frame(groups).replace({np.nan: None}).to_dict(orient="records")
    conditions = {member.run.name: str(members.condition) for members in groups for member in members.members}
    outliers = {name: reason for members in groups for name, reason in members.outliers.items()}
    rule = groups[0].rule if groups else ""
    return {
        "runs": [_one(analyzed, conditions[analyzed.analysis.run.name]) for analyzed in runs],
        "pooled": pooled,
        "outliers": outliers,
        "outlier_rule": rule,
        "analysed_with": versions(),
    }


def versions() -> dict[str, str]:
    """Return the versions the numbers depend on."""
    found = {"membrane-adhesion-rig": version("membrane-adhesion-rig"), "python": platform.python_version()}
    return found | {package: version(package) for package in PACKAGES}


def _one(analyzed: Analyzed, condition: str) -> dict[str, object]:
    analysis, source = analyzed.analysis, analyzed.source
    return {
        "run": analysis.run.name,
        "condition": condition,
        **({} if source is None else source_json(source)),
        "protocol": analysis.run.protocol,
        "complete": analysis.run.complete,
        **analysis.features.as_json(),
        "methods": analysis.work.methods,
        "decisions": dict(analysis.decisions),
    }


def source_json(source: Source) -> dict[str, object]:
    """Return file, SHA-256 and all that a recording says of its making."""
    return {"path": source.path, "sha256": source.sha256, **source.metadata}


def write_afm(analysis: Analysis, path: Path) -> None:
    """Write approach and retraction in the tab-separated format of afmformats (``.tab``), which nanite and PyJibe open.

    Force is positive in compression, as there; ``height (measured)`` is the stage's height, ``tip position`` the
    separation (height + F C, as their height + F / k). A spring constant is stated only where the compliance is known.

    Raises
    ------
    AnalysisError
        The run holds no approach or no retraction.
    """
    windows = analysis.work.windows
    if windows.approach is None or windows.retraction is None:
        raise AnalysisError(f"{analysis.run.name}: no approach or no retraction; a force-distance curve needs both")
    segments = (windows.approach, windows.retraction)
    length = max(1, sum(stop - start for start, stop in segments) // AFM_POINTS)
    run, separation = analysis.run, analysis.work.separation
    signals = {
        "force": analysis.force,
        "height (measured)": run.height,
        "time": run.time,
        "tip position": separation,
    }
    columns = {
        name: np.concatenate([block_means(signal[start:stop], length) for start, stop in segments])
        for name, signal in signals.items()
    }
    counts = [(stop - start) // length for start, stop in segments]
    columns["segment"] = np.repeat([0.0, 1.0], counts)
    metadata = {
        "curve id": run.name,
        "format": "tab-separated values",
        "imaging mode": "force-distance",
        "point count": sum(counts),
        "rate approach": run.rate / length,
        "rate retract": run.rate / length,
        "segment count": 2,
        "software": "membrane-adhesion-rig",
    }
    if run.sensors.compliance > 0:
        metadata["spring constant"] = 1 / run.sensors.compliance
    path.write_text(_tab(metadata, columns), encoding="utf-8", newline="\n")


def _tab(metadata: Mapping[str, object], columns: Mapping[str, Array]) -> str:
    names = sorted(columns)
    head = json.dumps(metadata, sort_keys=True, indent=2).splitlines()
    lines = ["# BEGIN METADATA", *(f"# {line}" for line in head), "# END METADATA", "# " + "\t".join(names)]
    rows = zip(*(columns[name] for name in names), strict=True)
    return "\n".join([*lines, *("\t".join(f"{value:.8g}" for value in row) for row in rows), ""])
