"""``kill -9`` of a recording program: what was acknowledged is in the file, and nothing else."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from rig.recording import load_recording

WRITER = Path(__file__).with_name("killed_writer.py")
LIFE = 1.6
"""Seconds, from the first acknowledged sample, in which the kill may come."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The same run, undisturbed: one seed is one run."""
    path = tmp_path_factory.mktemp("whole") / "whole.h5"
    subprocess.run([sys.executable, str(WRITER), str(path), "max"], check=True, stdout=subprocess.DEVNULL)
    return load_recording(path)


def killed(path: Path, seconds: float, speed: str = "max", *options: str) -> tuple[int, float]:
    """Kill a writer so long after its first word; return the samples acknowledged and the longest any had waited, s."""
    command = [sys.executable, str(WRITER), str(path), speed, *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        told = [writer.stdout.readline()]
        time.sleep(seconds)
        writer.kill()
        told += writer.stdout.readlines()
    rows = [line.split() for line in told if line.endswith("\n")]
    return int(rows[-1][0]), max(float(age) for _, age, _ in rows)


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
    acknowledged, _ = killed(path, random.Random(1).uniform(0, 0.6), "max", *options)
    check(path, acknowledged, whole)


@pytest.mark.soak
@pytest.mark.timeout(120)
@pytest.mark.parametrize("trial", range(200))
def test_two_hundred_kills_lose_nothing(trial, tmp_path, whole):
    path = tmp_path / "killed.h5"
    acknowledged, _ = killed(path, random.Random(trial).uniform(0, LIFE))
    check(path, acknowledged, whole)
