"""Start a program that records an emulated run, and kill it."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

WRITER = Path(__file__).with_name("killed_writer.py")
LIFE = 1.6
"""Seconds, from the first acknowledged sample, in which the kill may come."""


class Acknowledgement(NamedTuple):
    """What the program said: samples safe, how long the oldest had waited (s), and when (s of the monotonic clock)."""

    samples: int
    age: float
    moment: float


def record_whole(path: Path) -> None:
    """Record the same run undisturbed: one seed is one run."""
    subprocess.run([sys.executable, str(WRITER), str(path), "max"], check=True, stdout=subprocess.DEVNULL)


def record_and_kill(path: Path, seconds: float, speed: str = "max", *options: str) -> list[Acknowledgement]:
    """Kill the program so long after its first word; return all it has said."""
    command = [sys.executable, str(WRITER), str(path), speed, *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        told = [writer.stdout.readline()]
        time.sleep(seconds)
        writer.kill()
        told += writer.stdout.readlines()
    rows = [line.split() for line in told if line.endswith("\n")]
    return [Acknowledgement(int(samples), float(age), float(moment)) for samples, age, moment in rows]
