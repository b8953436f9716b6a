"""Kill a run while instruments in another process go on, and see where they come to rest."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from conftest import scene_text

from rig.bench import load_bench
from rig.recording import load_recording

EMULATOR = Path(__file__).with_name("emulator_process.py")
PROTOCOL = {"tare_s": 0.5, "preload_dwell_s": 0.5, "preload_N": 0.3, "retract_speed_um_s": 100.0}
SETTLING = 8.0
"""Seconds watched after the kill: longer than any run of the pump lasts."""


@dataclass(frozen=True)
class Halt:
    """Where stage and pump came to rest after the program had died."""

    step: str
    delay: float
    overrun: float
    """m, furthest from where the stage stood at the kill."""
    rate: float
    """Speed at the kill, m/s."""
    pumped: float
    """m^3 displaced after the kill."""
    largest_force: float
    force_rise: float
    """N beyond the largest force before the kill."""
    at_rest: bool
    recording: Path


class Overtaken(Exception):
    """This computer was too busy for real time: the run has stopped itself, or gone on, before it could be killed."""


@contextlib.contextmanager
def emulators(*options: str) -> Iterator[tuple[dict[str, str], Any, Any]]:
    """Serve the emulated bench from another process; yield its endpoints, what commands it, what ends and reads it."""
    process = subprocess.Popen(
        [sys.executable, str(EMULATOR), *options], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with process:
        assert process.stdout is not None

        def command(line: str) -> None:
            assert process.stdin is not None
            process.stdin.write(f"{line}\n")
            process.stdin.flush()

        def finish() -> dict[str, Any]:
            told, _ = process.communicate("end\n", timeout=60)
            answer: dict[str, Any] = json.loads(told.splitlines()[-1])
            return answer

        try:
            yield json.loads(process.stdout.readline()), command, finish
        finally:
            process.kill()


def bench_file(folder: Path, ends: dict[str, str], **daq: float) -> Path:
    """Write a bench file whose instruments are these endpoints."""
    text = load_bench(None)[1]
    for device in ("stage", "pump", "daq"):
        patient = "" if device == "daq" else "\nreply_timeout_ms = 5000.0"
        text = text.replace('connection = "emulated"', f'connection = "{ends[device]}"{patient}', 1)
    for key, value in daq.items():
        lines = (f"{key} = {value}" if line.startswith(f"{key} ") else line for line in text.splitlines())
        text = "\n".join(lines) + "\n"
    path = folder / "bench.toml"
    path.write_text(text, encoding="utf-8")
    return path


def start_run(
    folder: Path, ends: dict[str, str], scene: str = "sphere-60mm-low", **daq: float
) -> subprocess.Popen[str]:
    """Start ``rig run`` on these endpoints."""
    scene_file = folder / "scene.toml"
    scene_file.write_text(scene_text(scene, **PROTOCOL), encoding="utf-8")
    command = [sys.executable, "-m", "rig", "run", str(scene_file), "--bench", str(bench_file(folder, ends, **daq))]
    command += ["--out", str(folder / "run.h5"), "--no-live", "--no-picture"]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def wait_for_step(stream: IO[str], step: str) -> None:
    """Read what the run says until a step begins."""
    said = []
    for line in stream:
        said.append(line)
        if f" s  {step} " in line and "until" in line:
            return
    text = "".join(said)
    if "s late" in text or "samples came within" in text:
        raise Overtaken(text)
    raise AssertionError(f"the run never came to {step}: {text}")


def kill_in(step: str, delay: float, folder: Path, seed: int = 0) -> Halt:
    """Kill a run so many seconds into a step; try again where this computer was too busy for a run in real time."""
    for _ in range(10):
        with contextlib.suppress(Overtaken):
            return _kill_in(step, delay, folder, seed)
        (folder / "run.h5").unlink()
    raise AssertionError("this computer is too busy for a run in real time")


def _kill_in(step: str, delay: float, folder: Path, seed: int) -> Halt:
    with emulators("--seed", str(seed)) as (ends, _, finish):
        with start_run(folder, ends) as run:
            assert run.stderr is not None
            try:
                wait_for_step(run.stderr, step)
                time.sleep(delay)
            finally:
                run.kill()
                killed = time.monotonic()
        time.sleep(SETTLING)
        log = np.array(finish()["log"])
    if load_recording(folder / "run.h5").step_table()[-1].name != step:
        raise Overtaken(step)
    return _halt(log, killed, step, delay, folder / "run.h5")


def _halt(log: np.ndarray, killed: float, step: str, delay: float, recording: Path) -> Halt:
    when, sample, height, volume, low, high = log.T
    before = when <= killed
    present = sample[before][-1] + (killed - when[before][-1]) * 1e3  # a busy emulator writes its log late
    after = sample >= present
    at = np.interp(present, sample, height)
    recent = slice(-max(3, int((sample[before] > present - 100).sum())), None)
    rate = np.polyfit(sample[before][recent] * 1e-3, height[before][recent], 1)[0]
    last = when > when[-1] - 1.0
    largest = max(-low.min(), high.max())
    return Halt(
        step,
        delay,
        overrun=float(np.abs(height[after] - at).max()),
        rate=float(rate),
        pumped=float(abs(volume[-1] - volume[before][-1])),
        largest_force=float(largest),
        force_rise=float(max(0.0, largest - max(-low[before].min(), high[before].max()))),
        at_rest=bool(np.ptp(height[last]) < 2e-7 and np.ptp(volume[last]) < 1e-12),
        recording=recording,
    )
