"""What a run says at its end: the measurement beside the model, in one table and one picture."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

from model import ModelError, predict
from rig.calibrate import calibrate
from rig.measured import as_run
from rig.recording import load_recording
from rig.recording_file import free_names

if TYPE_CHECKING:
    from analysis.pipeline import Analysis
    from model.prediction import Prediction

_ROWS = (
    ("pull-off force F_p", "N", 1.0, "pull_off_force_N", "pull_off_force"),
    ("pull-off distance D_p", "mm", 1e3, "pull_off_distance_m", "pull_off_distance"),
    ("retraction at F_p", "mm", 1e3, "retraction_at_pull_off_m", "retraction_at_pull_off"),
    ("adhesion energy", "mJ", 1e3, "adhesion_energy_J", "adhesion_energy"),
    ("initial pressure P_0", "kPa", 1e-3, "initial_pressure_Pa", None),
    ("preload", "N", 1.0, "preload_N", None),
)

_STATEMENTS = ("Work of adhesion (S13)",)
"""Steps of the analysis whose decision belongs to the result."""


def summarise(path: Path, model: str = "cone") -> str:
    """Analyse a recording, draw its picture beside it, and return the table of measurement and model.

    A calibration gives the lines of the bench file instead, and writes them beside the recording too. No file that
    is there already is touched: a taken name gets a number.
    """
    from analysis import analyze
    from analysis.figures import overview
    from analysis.figures.fit_picture import save_fit

    recording = load_recording(path)
    picture = _beside(path, ".png")
    calibration = calibrate(recording)
    if calibration is not None:
        lines = _beside(path, ".toml")
        with lines.open("x", encoding="utf-8", newline="\n") as file:
            file.write(calibration.toml)
        save_fit(calibration.picture, picture)
        return f"{calibration}\nrecording  {path}\nlines      {lines}\npicture    {picture}"
    run = as_run(recording)
    analysis = analyze(run)
    prediction: Prediction | None = None
    note = ""
    modelled = run.protocol == "pull_off" and run.settings.get("gripper") == "rigid"
    if run.parameters is not None and modelled:
        try:
            prediction = predict(run.parameters, model)
        except ModelError as error:
            note = f"\nno prediction: {error}"
    overview(run, analysis, prediction, picture)
    table = _table(analysis, prediction) if run.protocol == "pull_off" else _list(analysis)
    return f"{table}{note}\nrecording  {path}\npicture    {picture}"


def _beside(path: Path, suffix: str) -> Path:
    """Return a name beside the recording that nothing has yet."""
    return next(name for name in free_names(path.with_suffix(suffix)) if not os.path.lexists(name))


def _table(analysis: Analysis, prediction: Prediction | None) -> str:
    model = "" if prediction is None else prediction.model
    lines = [f"{'':<24}{'measured':>22}{model:>12}{'difference':>12}"]
    for title, unit, scale, feature, name in _ROWS:
        if feature not in analysis.features:
            continue
        quantity = analysis.features[feature]
        measured = f"{quantity.value * scale:.4g} ± {quantity.uncertainty * scale:.2g}"
        predicted = math.nan if prediction is None or name is None else getattr(prediction, name)
        beside = "" if math.isnan(predicted) else f"{predicted * scale:.4g}"
        off = "" if math.isnan(predicted) else f"{(predicted / quantity.value - 1) * 100:+.1f} %"
        lines.append(f"{f'{title} ({unit})':<24}{measured:>22}{beside:>12}{off:>12}")
    if prediction is not None:
        error = prediction.numerical_error.get("pull_off_force", math.nan)
        lines.append(f"{model}: numerical error of F_p {error:.1e} N, solved in {prediction.runtime_s * 1e3:.2f} ms")
    return "\n".join(lines)


def _list(analysis: Analysis) -> str:
    """Return every feature found, a line each, and how far the result can be trusted."""
    lines = [f"{name:<40}{quantity}" for name, quantity in analysis.features.items()]
    lines += [f"{title}: {why}" for title, why in analysis.decisions.items() if title in _STATEMENTS]
    return "\n".join(lines)
