"""Many runs: each is analysed, drawn and made light on its own, so that runs can go to any number of processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from analysis.pipeline import Analysis, analyze, lighten
from analysis.run import Run
from model.errors import ModelError
from model.prediction import Prediction

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


@dataclass(frozen=True)
class Analyzed:
    """One analysed run, light enough to keep hundreds.

    Attributes
    ----------
    analysis
        With thinned signals (``analysis.pipeline.lighten``).
    samples, rate
        Of the recording itself.
    prediction, no_prediction
        Of the run's scene, or why there is none.
    overview, reasons
        The pictures as PNG; empty where none were wanted.
    """

    analysis: Analysis
    samples: int
    rate: float
    prediction: Prediction | None = None
    no_prediction: str = ""
    overview: bytes = b""
    reasons: bytes = b""


def analyze_run(run: Run, *, model: str = "cone", pictures: bool = False, uncertainties: bool = True) -> Analyzed:
    """Analyse one run, with its prediction and pictures where wanted."""
    analysis = analyze(run, uncertainties=uncertainties)
    if not pictures:
        return Analyzed(lighten(analysis), run.force.size, run.rate)
    from analysis.figures.reasons import reasons
    from analysis.figures.run_overview import overview_bytes

    prediction, reason = predict_run(run, model)
    return Analyzed(
        lighten(analysis),
        run.force.size,
        run.rate,
        prediction,
        reason,
        overview_bytes(run, analysis, prediction),
        reasons(analysis),
    )


def predict_run(run: Run, model: str = "cone") -> tuple[Prediction | None, str]:
    """Return the prediction of a run's scene, or ``None`` and why there is none."""
    from model import predict

    if run.protocol != "pull_off" or run.parameters is None:
        return None, f"the models do not describe the protocol {run.protocol}"
    gripper = run.settings.get("gripper", "rigid")
    if gripper != "rigid":
        return None, f"the papers hold no model of the {gripper} gripper"
    try:
        return predict(run.parameters, model), ""
    except ModelError as error:
        return None, str(error)


def on_all_cores(
    function: Callable[[Item], Outcome],
    items: Sequence[Item],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
) -> Iterator[Outcome]:
    """Apply ``function`` to each item, in order: here, on several processes, or on a Dask cluster.

    Parameters
    ----------
    function
        Picklable.
    workers
        Number of processes; ``None``: one per core, 1: none but this one.
    scheduler
        Address of a Dask scheduler; overrides ``workers``.
    """
    import os

    if scheduler is not None:
        from distributed import Client

        with Client(scheduler) as client:
            yield from (future.result() for future in client.map(function, items, pure=False))
        return
    count = min(workers or os.cpu_count() or 1, len(items))
    if count <= 1:
        yield from map(function, items)
        return
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        yield from pool.map(function, items)
