"""Tables of predictions: serial, on several processes, or on a Dask cluster, with the same bits whichever is used.

The scenes are cut into blocks of a fixed size and every block is solved by one call, so the arithmetic does not
depend on who does it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from analysis.batch import on_all_cores
from model import MODELS, InvalidParameter, ModelError, Parameters

if TYPE_CHECKING:
    import pandas as pd

VECTORISED = {"cone": True, "cone-2017": False}
"""Models with a batch solver, and whether their contact stores energy."""

BLOCK = {True: 4096, False: 1}
"""Scenes per block of a vectorised model, and of one that solves scene by scene."""

FEW = 3
"""So many blocks are done sooner than processes are started."""

Row = dict[str, Any]


def sweep(
    scenes: Sequence[Parameters],
    model: str = "cone",
    *,
    processes: int | None = 1,
    scheduler: str | None = None,
    progress: Callable[[Iterable[list[Row]], int], Iterable[list[Row]]] | None = None,
) -> pd.DataFrame:
    """Predict many scenes.

    Parameters
    ----------
    scenes
        Complete scenes, SI units.
    model
        One of ``model.MODELS``.
    processes
        Number of worker processes; 1 computes here; ``None``: one per core, where there are more blocks than a few.
    scheduler
        Address of a Dask scheduler (``tcp://host:8786``) to use instead.
    progress
        Wraps the iterator over finished blocks; receives it and the number of blocks.

    Returns
    -------
    pandas.DataFrame
        One row per scene in the order given: outcome, features with units in the column names, their numerical
        errors. A scene that cannot be solved has its reason as outcome and no values; it does not end the sweep.

    Raises
    ------
    InvalidParameter
        The model is unknown.
    NoScheduler
        None answers at the address.
    """
    import pandas as pd

    if model not in MODELS:
        raise InvalidParameter(f"unknown model {model!r}; choose one of {', '.join(MODELS)}")
    size = BLOCK[model in VECTORISED]
    blocks = [list(scenes[first : first + size]) for first in range(0, len(scenes), size)]
    if processes is None and len(blocks) <= FEW:
        processes = 1
    finished: Iterable[list[Row]] = on_all_cores(
        partial(solve_block, model), blocks, workers=processes, scheduler=scheduler, lost=_lost_block
    )
    if progress is not None:
        finished = progress(finished, len(blocks))
    return pd.DataFrame([row for block in finished for row in block])


def solve_block(model: str, scenes: list[Parameters]) -> list[Row]:
    """Return one row per scene of a block."""
    if model not in VECTORISED:
        return [_solve_alone(model, scene) for scene in scenes]
    from model.batch import solve_many

    try:
        frame = solve_many(scenes, contact_stretch=VECTORISED[model]).frame()
    except ModelError:
        return [_solve_alone(model, scene) for scene in scenes]
    return [{str(name): value for name, value in row.items()} for row in frame.to_dict("records")]


def _solve_alone(model: str, scene: Parameters) -> Row:
    from model import predict
    from model.batch import FEATURES

    try:
        prediction = predict(scene, model, points=64)
    except ModelError as error:
        return _row(f"{type(error).__name__}: {error}", {}, {})
    values = {name: getattr(prediction, name) for name in FEATURES}
    return _row(prediction.outcome.value, values, prediction.numerical_error)


def _lost_block(scenes: list[Parameters], reason: str) -> list[Row]:
    return [_row(reason, {}, {}) for _ in scenes]


def _row(outcome: str, values: Mapping[str, float], errors: Mapping[str, float]) -> Row:
    from model.batch import ERRORS, FEATURES

    units = {name: "N" if name.endswith("force") else "m" for name in FEATURES}
    row: Row = {"outcome": outcome}
    row |= {f"{name}_{unit}": values.get(name, math.nan) for name, unit in units.items()}
    return row | {f"{name}_error_{units[name]}": errors.get(name, math.nan) for name in ERRORS}
