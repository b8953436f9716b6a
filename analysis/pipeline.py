"""One run to its features, curve and reasons."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from analysis.extraction import MODULES, Extraction, extract, meanings, ordered, unit_of
from analysis.numerics import Array, block_means
from analysis.propagation import budget
from analysis.quantity import Features, Quantity
from analysis.run import Run

if TYPE_CHECKING:
    import pandas as pd


for _module in MODULES:
    import_module(f"analysis.{_module}")


@dataclass(frozen=True)
class Curve:
    """F_r and P_a against retraction z_r, cut out of a run: start of the retraction to its end.

    Attributes
    ----------
    time, retraction, force
        (n,), s, m, N; z_r is corrected for compliance, the force for tare and drift.
    pressure
        (n,), Pa gauge, or ``None``.
    """

    time: Array
    retraction: Array
    force: Array
    pressure: Array | None

    def frame(self) -> pd.DataFrame:
        """Return the curve as a DataFrame with units in the column names."""
        import pandas as pd

        columns = {"time_s": self.time, "retraction_m": self.retraction, "force_N": self.force}
        if self.pressure is not None:
            columns["pressure_Pa"] = self.pressure
        return pd.DataFrame(columns)


@dataclass(frozen=True)
class Analysis:
    """What the analysis makes of one run.

    Attributes
    ----------
    run
        The run itself.
    features
        Every number with its uncertainty, and what is missing with the reason.
    curve
        The curve, or ``None`` where there is no retraction or no zero of z_r.
    force
        (n,), N, the whole record, tared and freed of drift.
    work
        State of the extraction: ``details`` by step say why.
    """

    run: Run
    features: Features
    curve: Curve | None
    force: Array
    work: Extraction

    @property
    def no_curve(self) -> str:
        """Why there is no curve; empty where there is one."""
        if self.curve is not None:
            return ""
        return self.work.failed.get("zero crossing", f"a test of the kind {self.run.protocol} has none")

    @property
    def decisions(self) -> Mapping[str, str]:
        """Each step's decision in words, failures included."""
        return {
            step.title: str(details["decision"])
            if (details := self.work.details.get(step.name))
            else self.work.failed[step.name]
            for step in ordered()
            if step.name in self.work.details or step.name in self.work.failed
        }


def lighten(analysis: Analysis, points: int = 10_000) -> Analysis:
    """Return the analysis with its signals averaged to about ``points`` samples: what pooled figures need, 1 MB a run.

    Features stay as they are. Sample indices and the rate follow the averaging; of the details only decisions and
    places stay.
    """
    run, work = analysis.run, analysis.work
    length = max(1, run.force.size // points)
    light_run = replace(
        run,
        rate=run.rate / length,
        force=block_means(run.force, length),
        height=block_means(run.height, length),
        pressure=None if run.pressure is None else block_means(run.pressure, length),
        pump_volume=None if run.pump_volume is None else block_means(run.pump_volume, length),
        steps=tuple(replace(step, start=step.start // length, stop=step.stop // length) for step in run.steps),
    )
    light = work.thinned(light_run, length)
    return Analysis(light_run, analysis.features, _curve(light), light.force, light)


def analyze(run: Run, *, uncertainties: bool = True) -> Analysis:
    """Analyse one run, complete or not.

    Parameters
    ----------
    run
        The run; aborted ones are analysed as far as their data go.
    uncertainties
        Whether to carry the uncertainties (takes about 25 times as long as the values).

    Raises
    ------
    AnalysisError
        The record is too short to hold even a tare.
    """
    work = extract(run)
    parts = budget(work) if uncertainties else {}
    text = meanings()
    found = {
        name: Quantity(
            work.values[name],
            float(np.sqrt(sum(part**2 for part in parts[name].values()))) if uncertainties else np.nan,
            unit_of(name),
            text[name],
            parts.get(name, {}),
        )
        for name in text
        if name in work.values
    }
    missing = {name: reason for name, reason in work.missing.items() if name not in work.values}
    return Analysis(run, Features(found, missing), _curve(work), work.force, work)


def _curve(work: Extraction) -> Curve | None:
    if work.windows.retraction is None or "zero crossing" in work.failed:
        return None
    part = slice(*work.windows.retraction)
    return Curve(
        work.run.time[part],
        work.separation[part] - work.zero_separation,
        work.force[part],
        None if work.run.pressure is None else work.run.pressure[part],
    )
