"""``kill -9`` of a recording program: what was acknowledged is in the file, and nothing else."""

from __future__ import annotations

import random
from pathlib import Path

import h5py
import numpy as np
import pytest
from killed_run import LIFE, record_and_kill, record_whole

from rig.recording import load_recording


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "whole.h5"
    record_whole(path)
    return load_recording(path)


def check(path: Path, acknowledged: int, whole) -> None:
    found = load_recording(path)
    with h5py.File(path) as file:  # a plain open works after the repair
        assert file["entry/data/force"].shape[0] == found.force.size
    assert found.force.size >= acknowledged
    for name in ("volts", "force", "height", "pressure", "frames", "stage"):
        ours, theirs = getattr(found, name), getattr(whole, name)
        length = ours.shape[-1]
        if name == "frames":  # but for the wall clock, of which virtual time has none
            assert np.array_equal(ours["start"], theirs["start"][:length])
        else:
            assert np.array_equal(ours, theirs[..., :length])
    steps = [row["name"] for row in found.steps]
    assert steps == [row["name"] for row in whole.steps][: len(steps)]


@pytest.mark.parametrize("options", [("plain",), ("journalled",)])
def test_a_killed_run_keeps_what_it_acknowledged(options, tmp_path, whole):
    path = tmp_path / "killed.h5"
    told = record_and_kill(path, random.Random(1).uniform(0, 0.6), "max", *options)
    check(path, told[-1].samples, whole)


@pytest.mark.soak
@pytest.mark.timeout(120)
@pytest.mark.parametrize("trial", range(200))
def test_two_hundred_kills_lose_nothing(trial, tmp_path, whole):
    path = tmp_path / "killed.h5"
    told = record_and_kill(path, random.Random(trial).uniform(0, LIFE))
    check(path, told[-1].samples, whole)
