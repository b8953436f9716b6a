"""The pictures: the overview of one run and the figures of the papers. Drawn with Agg; same bytes every time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analysis.pipeline import Analysis
    from analysis.run import Run
    from model.prediction import Prediction


def overview(run: Run, analysis: Analysis, prediction: Prediction | None, path: Path) -> None:
    """Draw one run with the prediction over it; see ``analysis.figures.run_overview.overview``."""
    from analysis.figures import run_overview

    run_overview.overview(run, analysis, prediction, path)
