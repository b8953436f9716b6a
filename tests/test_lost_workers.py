"""Worker processes that are killed from outside: what they were at is computed again, or named."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from dying_worker import square

from analysis.batch import on_all_cores
from analysis.errors import WorkerLost
from analysis.sweep import sweep
from model import Parameters, Substrate
from rig.cli import main
from rig.collection import collect

NUMBERS = range(20)
SQUARES = [number**2 for number in NUMBERS]


def name_it(number: int, reason: str) -> int:
    assert "killed" in reason
    return -number


def test_what_a_killed_process_was_at_is_computed_again(tmp_path: Path) -> None:
    work = partial(square, tmp_path, {3: 1, 11: 1, 12: 1})
    assert list(on_all_cores(work, NUMBERS, workers=2)) == SQUARES


def test_an_item_that_kills_every_process_is_named_and_the_others_are_computed(tmp_path: Path) -> None:
    work = partial(square, tmp_path, {5: 99, 19: 99})
    outcomes = list(on_all_cores(work, NUMBERS, workers=2, lost=name_it))
    assert outcomes == [-number if number in {5, 19} else number**2 for number in NUMBERS]
    with pytest.raises(WorkerLost, match=r"^5: .*killed.*Remedy"):
        list(on_all_cores(work, NUMBERS, workers=2))


def test_who_stops_asking_does_not_wait_for_the_rest(tmp_path: Path) -> None:
    outcomes = on_all_cores(partial(square, tmp_path, {19: 1}, seconds=0.5), NUMBERS, workers=2)
    assert next(outcomes) == 0
    outcomes.close()
    assert not list(tmp_path.iterdir())


def test_a_cluster_computes_again_what_a_killed_worker_was_at(tmp_path: Path) -> None:
    distributed, dask = pytest.importorskip("distributed"), pytest.importorskip("dask")
    work = partial(square, tmp_path, {3: 1, 5: 99})
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as cluster,
    ):
        outcomes = list(on_all_cores(work, NUMBERS, scheduler=cluster.scheduler_address, lost=name_it))
    assert outcomes == [-number if number == 5 else number**2 for number in NUMBERS]


def test_lost_recordings_and_scenes_are_listed_and_the_others_are_not_held_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def losing_the_first(
        function: Callable[[Any], Any], items: Sequence[Any], *, lost: Callable[[Any, str], Any], **_: Any
    ) -> Iterator[Any]:
        yield lost(items[0], "killed")
        yield from map(function, items[1:])

    monkeypatch.setattr("analysis.batch.on_all_cores", losing_the_first)
    monkeypatch.setattr("analysis.sweep.on_all_cores", losing_the_first)
    files = [tmp_path / "a.h5", tmp_path / "b.h5"]
    assert collect(files).left == {str(files[0]): "killed", str(files[1]): "no such file. Remedy: check the path."}
    table = sweep([Parameters(Substrate("sphere", d)) for d in (30e-3, 60e-3)], "membrane")
    assert table["outcome"].tolist() == ["killed", "pull-off"]
    assert math.isnan(table["pull_off_force_N"][0])
    assert table["pull_off_force_N"][1] > 0


class Dead:
    """A pool whose processes are all killed."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __enter__(self) -> Dead:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def shutdown(self, **_: Any) -> None:
        pass

    def submit(self, *_: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_exception(BrokenProcessPool("killed"))
        return future


def test_a_campaign_whose_process_is_killed_says_so_and_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("concurrent.futures.ProcessPoolExecutor", Dead)
    assert main(["campaign", "table-s1", "--direct", "--jobs", "2", "--out", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert "a process was killed" in said
    assert "Remedy: the same command goes on where it stopped" in said
    assert "Traceback" not in said
