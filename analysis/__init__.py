"""From the arrays of a recording to curves, features, tables, figures and reports. Opens no instrument.

``analyze(run)`` is the entry point.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from analysis.errors import AnalysisError, FeatureMissing
from analysis.run import Run, Sensors, Step

if TYPE_CHECKING:
    from analysis.pipeline import Analysis

__all__ = ["AnalysisError", "FeatureMissing", "Run", "Sensors", "Step", "analyze"]


def analyze(run: Run, *, uncertainties: bool = True) -> Analysis:
    """Analyse one run; see ``analysis.pipeline.analyze``."""
    from analysis import pipeline

    return pipeline.analyze(run, uncertainties=uncertainties)
