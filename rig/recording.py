"""Recordings as they lie on disk, read into what the analysis and the replay need."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from analysis.run import Step
from rig.bench import Bench, parse_bench
from rig.errors import BeingWritten, FileError
from rig.layout import PER_SAMPLE, TABLES, complete, filled
from rig.observe import StepPhase
from rig.recording_file import entry_of, insist, opened, reading
from rig.recovery import recover
from rig.scene import Scene, parse_scene
from rig.seal import is_sealed


@dataclass(frozen=True)
class Recording:
    """A recording in memory: raw streams and configuration, as the replay needs them."""

    path: Path
    scene: Scene
    bench: Bench
    configuration: dict[str, str]
    info: dict[str, Any]
    rate: float
    channels: tuple[str, ...]
    units: tuple[str, ...]
    volts: NDArray[np.float64]
    frames: NDArray[Any]
    stage: NDArray[Any]
    pump: NDArray[Any] | None
    force: NDArray[np.float64]
    pressure: NDArray[np.float64] | None
    height: NDArray[np.float64]
    steps: NDArray[Any]
    events: NDArray[Any]
    predictions: NDArray[Any]
    ending: tuple[str, int] | None

    def step_table(self) -> tuple[Step, ...]:
        """Return the steps as sample ranges; a step the recording does not see the end of lasts to its last sample."""
        steps: list[Step] = []
        begun: tuple[str, int] | None = None
        for row in self.steps:
            name, sample = row["name"].decode(), int(row["sample"])
            if row["phase"].decode() == StepPhase.STARTED:
                begun = (name, sample)
            elif begun is not None:
                steps.append(Step(name, begun[1], sample, row["outcome"].decode(errors="ignore")))
                begun = None
        if begun is not None:
            steps.append(Step(begun[0], begun[1], self.force.size, "stopped"))
        return tuple(steps)


@contextmanager
def open_recording(path: Path) -> Iterator[h5py.Group]:
    """Open the entry of a recording for reading; one left by a crash is repaired first.

    A recording that is still being written is opened as it stands.

    Raises
    ------
    FileError
        The file is missing, damaged beyond repair, or no recording of this rig.
    """
    insist(path)
    if not is_sealed(path):
        with suppress(BeingWritten):
            recover(path)
    with opened(path) as file:
        yield entry_of(file, path)


def load_recording(path: Path) -> Recording:
    """Read a whole recording.

    Raises
    ------
    FileError
        As ``open_recording``; or a part is missing or does not fit the others.
    """
    with open_recording(path) as entry:
        return _load(entry, path)


def protocol_of(path: Path) -> str:
    """Return the name of a recording's protocol without reading its data."""
    with open_recording(path) as entry:
        try:
            text = entry["configuration/scene"].asstr()[()]
        except (KeyError, OSError, RuntimeError, UnicodeDecodeError) as error:
            raise FileError(f"recording {path}: damaged ({error}). Remedy: try `rig recover` on a copy.") from error
    return parse_scene(text, f"{path}:scene", recorded=True).protocol.name


def read_through(path: Path) -> None:
    """Read everything a recording holds, in a process that may be killed for it; see ``rig.seal``."""
    with opened(path) as file:
        _load(entry_of(file, path), path)


def _load(entry: h5py.Group, path: Path) -> Recording:
    with reading(path):
        _check_sizes(entry, path)
        _check_kinds(entry)
        return _read(entry, path)


def _check_sizes(entry: h5py.Group, path: Path) -> None:
    """Refuse a file that claims more data than it can hold before memory is asked for them."""
    claimed = 0

    def count(name: str, item: Any) -> None:
        nonlocal claimed
        if isinstance(item, h5py.Dataset):
            claimed = max(claimed, item.size * item.dtype.itemsize)

    entry.visititems(count)
    if claimed > 2 * path.stat().st_size:
        raise FileError(f"recording {path}: damaged: it claims {claimed} bytes of data. Remedy: restore a copy.")


def _check_kinds(entry: h5py.Group) -> None:
    """Raise ``ValueError`` where a dataset is not of the kind the recorder makes."""
    for name in filter(entry.__contains__, PER_SAMPLE):
        if entry[name].ndim != (2 if name == "raw/volts" else 1) or entry[name].dtype.kind != "f":
            raise ValueError(f"{name} holds no numbers by sample")
    for name, table in TABLES.items():
        if name in entry and (entry[name].ndim != 1 or entry[name].dtype.names != table.names):
            raise ValueError(f"{name} is not the table it should be")
    for name, item in entry["configuration"].items():
        if item.shape != ():
            raise ValueError(f"configuration/{name} is not one text")


def _read(entry: h5py.Group, path: Path) -> Recording:
    samples, frames = complete(entry)
    configuration = {name: item.asstr()[()] for name, item in entry["configuration"].items()}
    volts = entry["raw/volts"]
    pressure = entry["data"].get("pressure")
    pump = entry["raw"].get("pump")
    ending = entry["ending"][:]
    return Recording(
        path=path,
        scene=parse_scene(configuration["scene"], f"{path}:scene", recorded=True),
        bench=parse_bench(configuration["bench"], f"{path}:bench", recorded=True),
        configuration=configuration,
        info=json.loads(configuration["run"]),
        rate=float(entry["raw"].attrs["sample_rate_Hz"]),
        channels=tuple(str(name) for name in volts.attrs["channels"]),
        units=tuple(str(unit) for unit in volts.attrs.get("channel_units", ["V"] * volts.shape[1])),
        volts=np.ascontiguousarray(volts[:samples].T),
        frames=entry["raw/frames"][:frames],
        stage=entry["raw/stage"][:frames],
        pump=None if pump is None else filled(pump[:]),
        force=entry["data/force"][:samples],
        pressure=None if pressure is None else pressure[:samples],
        height=entry["data/height"][:samples],
        steps=filled(entry["steps"][:]),
        events=filled(entry["events"][:]),
        predictions=filled(entry["predictions"][:]),
        ending=None if not len(ending) else (ending[0]["reason"].decode(errors="ignore"), int(ending[0]["exit_code"])),
    )
