"""Many runs: each is analysed, drawn and made light on its own, so that runs can go to any number of processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar, cast

from analysis.errors import NoScheduler, WorkerLost
from analysis.pipeline import Analysis, analyze, lighten
from analysis.run import Run
from model.errors import ModelError
from model.prediction import Prediction

if TYPE_CHECKING:
    from concurrent.futures import Future, ProcessPoolExecutor

    from distributed import Client

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


ANSWER_SECONDS = 10
"""How long a scheduler may take to answer."""

ATTEMPTS = 2
"""How often an item is tried alone after a process was killed that may have been at work on it."""

LOST = "every process at work on it was killed. Remedy: look for what kills them; memory may run out."


@dataclass(frozen=True, slots=True)
class Source:
    """Where a run came from.

    Attributes
    ----------
    path
        The recording as it was named on the command line.
    name
        Its name in pages, without folders that are not needed to tell it from others.
    sha256
        Of the file.
    metadata
        What the recording says of its making: bench, scene, calibrations, versions.
    """

    path: str
    name: str
    sha256: str
    metadata: Mapping[str, object] = field(default_factory=dict)


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
    source
        The recording, where there is one.
    """

    analysis: Analysis
    samples: int
    rate: float
    prediction: Prediction | None = None
    no_prediction: str = ""
    overview: bytes = b""
    reasons: bytes = b""
    source: Source | None = None


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
    lost: Callable[[Item, str], Outcome] | None = None,
) -> Iterator[Outcome]:
    """Apply ``function`` to each item, in order: here, on several processes, or on a Dask cluster.

    What a process was at when it was killed from outside (memory may have run out) is computed again.

    Parameters
    ----------
    function
        Picklable.
    workers
        Number of processes; ``None``: one per core, 1: none but this one.
    scheduler
        Address of a Dask scheduler; overrides ``workers``.
    lost
        Makes an outcome of an item and the reason why it has none: every process that tried it was killed.

    Raises
    ------
    NoScheduler
        None answers there.
    WorkerLost
        An item is lost, and ``lost`` not given; or the scheduler is.
    """
    import os

    lost = lost or _refuse
    count = min(workers or os.cpu_count() or 1, len(items))
    if scheduler is not None:
        yield from _on_cluster(function, items, scheduler, lost)
    elif count > 1:
        yield from _on_processes(function, items, count, lost)
    else:
        yield from map(function, items)


def _refuse(item: object, reason: str) -> Any:
    raise WorkerLost(f"{item}: {reason}")


def _on_processes(
    function: Callable[[Item], Outcome], items: Sequence[Item], count: int, lost: Callable[[Item, str], Outcome]
) -> Iterator[Outcome]:
    """Work on processes; of a broken pool those items that may have been at work are computed again, each alone."""
    from concurrent.futures.process import BrokenProcessPool

    left = list(items)
    while left:
        with _processes(min(count, len(left))) as pool:
            futures: list[Future[Outcome]] = []
            with suppress(BrokenProcessPool):
                for item in left:
                    futures.append(pool.submit(function, item))
            suspects = count + 1  # one item waits in the pool's queue
            for future in futures:
                try:
                    outcome = future.result()
                except BrokenProcessPool:
                    if not suspects:
                        break
                    suspects -= 1
                    outcome = _alone(function, left[0], lost)
                left.pop(0)
                yield outcome


def _alone(function: Callable[[Item], Outcome], item: Item, lost: Callable[[Item, str], Outcome]) -> Outcome:
    from concurrent.futures.process import BrokenProcessPool

    for _ in range(ATTEMPTS):
        with suppress(BrokenProcessPool), _processes(1) as pool:
            return pool.submit(function, item).result()
    return lost(item, LOST)


@contextmanager
def _processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """Give processes that do not begin on what nobody waits for any more; spawned, as on Windows."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        try:
            yield pool
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _on_cluster(
    function: Callable[[Item], Outcome], items: Sequence[Item], scheduler: str, lost: Callable[[Item, str], Outcome]
) -> Iterator[Outcome]:
    """Work on a cluster. Its scheduler repeats what a lost worker was at, but may give up a killer's neighbours."""
    with connected(scheduler) as client:
        from concurrent.futures import CancelledError

        from distributed import KilledWorker

        def outcome_of(item: Item, future: Any) -> Outcome:
            with suppress(KilledWorker):
                return cast("Outcome", future.result())
            with suppress(KilledWorker):
                return cast("Outcome", client.submit(function, item, pure=False).result())
            return lost(item, LOST)

        try:
            yield from map(outcome_of, items, client.map(function, items, pure=False))
        except CancelledError as error:
            raise WorkerLost(f"scheduler {scheduler}: is gone. Remedy: start it again, and this command.") from error


@contextmanager
def connected(scheduler: str) -> Iterator[Client]:
    """Give a client of a Dask scheduler.

    Raises
    ------
    NoScheduler
        None answers there, or Dask is not installed.
    """
    try:
        from distributed import Client

        client = Client(scheduler, timeout=f"{ANSWER_SECONDS}s")
    except ImportError as error:
        raise NoScheduler(f"scheduler {scheduler}: {error}. Remedy: install the extra `cluster`.") from error
    except (OSError, ValueError) as error:
        raise NoScheduler(
            f"scheduler {scheduler}: no Dask scheduler answers ({str(error).splitlines()[0]}). "
            "Remedy: start one with `dask scheduler`, and give its address, such as tcp://host:8786."
        ) from error
    with client:
        yield client
