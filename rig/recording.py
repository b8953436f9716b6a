"""Recordings as they lie on disk: opening, repairing, and turning them into what the analysis and the replay need."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from analysis.run import Run, Sensors, Step
from rig.bench import Bench, parse_bench
from rig.errors import BeingWritten, FileError
from rig.journal import journal_of, read_journal, sync, sync_folder
from rig.observe import StepPhase
from rig.recorder import ENDING, EVENTS, FORMAT, FRAMES, PREDICTIONS, PUMP, STAGE, STEPS, extend, lay_out
from rig.scene import Scene, parse_scene
from rig.seal import is_sealed, probe, seal

_PER_SAMPLE = ("raw/volts", "data/time", "data/force", "data/height", "data/pressure")
_TABLES = {
    "raw/frames": FRAMES,
    "raw/stage": STAGE,
    "raw/pump": PUMP,
    "steps": STEPS,
    "events": EVENTS,
    "predictions": PREDICTIONS,
    "ending": ENDING,
}
_PER_FRAME = ("raw/frames", "raw/stage")


@dataclass(frozen=True)
class Recovery:
    """What ``recover`` found: samples and frames kept, and whether anything had to be done."""

    path: Path
    samples: int
    frames: int
    repaired: bool


@contextmanager
def open_recording(path: Path) -> Iterator[h5py.Group]:
    """Open the entry of a recording for reading; one left by a crash is repaired first.

    A recording that is still being written is opened as it stands.

    Raises
    ------
    FileError
        The file is missing, damaged beyond repair, or no recording of this rig.
    """
    _insist(path)
    if not is_sealed(path):
        with suppress(BeingWritten):
            recover(path)
    with _opened(path) as file:
        yield _entry(file, path)


def read_through(path: Path) -> None:
    """Read everything a recording holds, in a process that may be killed for it; see ``rig.seal``."""
    with _opened(path) as file:
        _load(_entry(file, path), path)


def recover(path: Path, *, force: bool = False) -> Recovery:
    """Repair a recording left by a crash, so that a plain ``h5py.File(path)`` opens it.

    Where a journal lies beside it the recording is written anew from that. Else the readable content is copied into a
    new file, which then takes the old one's place; streams that one flush had reached and another not are cut to the
    last complete frame.

    Raises
    ------
    FileError
        The file cannot be read at all.
    BeingWritten
        The program that writes it is still running (``force`` overrides).
    """
    _insist(path)
    if not is_sealed(path):
        rewritten = _rewritten(path, force=force)
        if rewritten is not None:
            return rewritten
        probe(path)
    with _opened(path) as file:
        if file.swmr_mode and not force and _writer_lives(file):
            raise BeingWritten(f"recording {path}: is still being written. Remedy: wait for the run to end.")
        if not file.swmr_mode:
            with _reading(path):
                return Recovery(path, *_complete(_entry(file, path)), repaired=False)
    return _repair(path)


def _insist(path: Path) -> None:
    if not path.is_file():
        raise FileError(f"recording {path}: no such file. Remedy: check the path.")


def _repair(path: Path) -> Recovery:
    """Copy what is whole in a file with the mark of a writer into a new one."""
    with _replacing(path) as fresh, _opened(path) as file:
        samples, frames = _complete(_entry(file, path))
        _copy(file, fresh, samples, frames)
    return Recovery(path, samples, frames, repaired=True)


def _rewritten(path: Path, *, force: bool) -> Recovery | None:
    """Write a recording anew from its journal; ``None`` if it has none, or its writer lives."""
    journal = journal_of(path)
    try:
        header, records = read_journal(journal)
    except FileError:
        return None
    if not force and _author_lives(header["info"], header["metadata"]):
        return None
    with _replacing(path) as fresh, h5py.File(fresh, "w", libver="latest") as file:
        sets = lay_out(file, **header)
        for blocks in records:
            for name, block in blocks.items():
                extend(sets[name], block)
        samples, frames = _complete(file["entry"])
        _end(file["entry"], samples)
    journal.unlink()
    return Recovery(path, samples, frames, repaired=True)


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """Give the name of a new file; once written it is sealed, forced to the disk, and takes the old one's place."""
    fresh = path.with_name(f".{path.name}.recovering")
    fresh.unlink(missing_ok=True)
    try:
        yield fresh
        seal(fresh)
        sync(fresh)
        os.replace(fresh, path)
        sync_folder(path)
    except (OSError, RuntimeError, LookupError, TypeError, ValueError, AttributeError) as error:
        fresh.unlink(missing_ok=True)
        raise FileError(
            f"recording {path}: cannot be repaired ({error}). It is left as it was. Remedy: free space beside it "
            "and try again; keep a copy of the file."
        ) from error


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
    return parse_scene(text, f"{path}:scene").protocol.name


def load_run(path: Path) -> Run:
    """Read a recording as the analysis sees it."""
    recording = load_recording(path)
    return as_run(recording)


def as_run(recording: Recording) -> Run:
    """Return the recording's arrays, steps and sensors for the analysis."""
    scene, bench = recording.scene, recording.bench
    return Run(
        name=recording.path.stem,
        protocol=scene.protocol.name,
        rate=recording.rate,
        force=recording.force,
        pressure=recording.pressure,
        height=recording.height,
        steps=recording.step_table(),
        parameters=scene.parameters(),
        sensors=sensors(bench),
        settings=_settings(recording),
        complete=recording.ending is not None and recording.ending[1] == 0,
        pump_volume=_pump_volume(recording),
    )


def _settings(recording: Recording) -> dict[str, float | str]:
    """Return the scene's plain values, the gripper's kind and the place, as the analysis asks for them."""
    protocol = recording.scene.protocol
    settings: dict[str, float | str] = {
        key: value for key, value in protocol.model_dump().items() if isinstance(value, int | float | str)
    }
    settings["gripper"] = recording.scene.gripper.kind
    place = recording.configuration.get("place", "")
    if place:
        settings["sample" if protocol.name == "fiber" else "position"] = place
    return settings


def _pump_volume(recording: Recording) -> NDArray[np.float64] | None:
    """Return the volume the pump has displaced at each sample, m^3, linear between its polls."""
    if recording.pump is None or not len(recording.pump):
        return None
    samples = np.arange(recording.force.size)
    volume: NDArray[np.float64] = np.interp(samples, recording.pump["sample"], recording.pump["volume_m3"])
    return volume


def sensors(bench: Bench) -> Sensors:
    """Return the standard uncertainties of a bench's calibration chain.

    The Honeywell HSC states 0.25 % of its 1200 mbar span for accuracy and 1 % as the total error band (HSC series
    data sheet); both are read as the half-width of a rectangular distribution.
    """
    rectangular = 3**-0.5
    calibration = bench.force.calibration
    pressure = bench.pressure.calibration if bench.pressure else None
    return Sensors(
        force_gain=calibration.relative_uncertainty,
        force_linearity=calibration.residual,
        pressure_gain=pressure.relative_uncertainty if pressure else 0.0025 * rectangular,
        pressure_offset=pressure.residual if pressure else 300.0 * rectangular,
        position=1e-5,
        compliance=bench.force.compliance_um_per_N * 1e-6,
        compliance_uncertainty=bench.force.compliance_uncertainty_um_per_N * 1e-6,
        pump_volume=bench.pump.volume_uncertainty_percent * 1e-2 if bench.pump else 0.0,
        creep=bench.force.creep_percent * 1e-2,
        creep_uncertainty=bench.force.creep_uncertainty_percent * 1e-2,
        creep_time=bench.force.creep_time_s,
    )


def _load(entry: h5py.Group, path: Path) -> Recording:
    with _reading(path):
        _check_sizes(entry, path)
        _check_kinds(entry)
        return _read(entry, path)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn whatever a damaged file makes h5py and NumPy raise into a ``FileError`` that names it."""
    try:
        yield
    except (LookupError, ValueError, OSError, RuntimeError, TypeError, AttributeError, MemoryError) as error:
        raise FileError(
            f"recording {path}: incomplete or damaged ({error}). Remedy: try `rig recover`; "
            "otherwise open it with h5py and save what is there."
        ) from error


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
    for name in filter(entry.__contains__, _PER_SAMPLE):
        if entry[name].ndim != (2 if name == "raw/volts" else 1) or entry[name].dtype.kind != "f":
            raise ValueError(f"{name} holds no numbers by sample")
    for name, table in _TABLES.items():
        if name in entry and (entry[name].ndim != 1 or entry[name].dtype.names != table.names):
            raise ValueError(f"{name} is not the table it should be")
    for name, item in entry["configuration"].items():
        if item.shape != ():
            raise ValueError(f"configuration/{name} is not one text")


def _read(entry: h5py.Group, path: Path) -> Recording:
    samples, frames = _complete(entry)
    configuration = {name: item.asstr()[()] for name, item in entry["configuration"].items()}
    volts = entry["raw/volts"]
    pressure = entry["data"].get("pressure")
    pump = entry["raw"].get("pump")
    ending = entry["ending"][:]
    return Recording(
        path=path,
        scene=parse_scene(configuration["scene"], f"{path}:scene"),
        bench=parse_bench(configuration["bench"], f"{path}:bench"),
        configuration=configuration,
        info=json.loads(configuration["run"]),
        rate=float(entry["raw"].attrs["sample_rate_Hz"]),
        channels=tuple(str(name) for name in volts.attrs["channels"]),
        volts=np.ascontiguousarray(volts[:samples].T),
        frames=entry["raw/frames"][:frames],
        stage=entry["raw/stage"][:frames],
        pump=None if pump is None else _filled(pump[:]),
        force=entry["data/force"][:samples],
        pressure=None if pressure is None else pressure[:samples],
        height=entry["data/height"][:samples],
        steps=_filled(entry["steps"][:]),
        events=_filled(entry["events"][:]),
        predictions=_filled(entry["predictions"][:]),
        ending=None if not len(ending) else (ending[0]["reason"].decode(errors="ignore"), int(ending[0]["exit_code"])),
    )


def _complete(entry: h5py.Group) -> tuple[int, int]:
    """Return samples and frames up to the last frame that every stream holds whole.

    A flush writes the frames' table last. A program that dies inside a flush can leave rows that were made but not yet
    filled; they do not follow on from the row before.
    """
    limit = min(entry[name].shape[0] for name in _PER_SAMPLE if name in entry)
    frames = entry["raw/frames"][: min(entry[name].shape[0] for name in _PER_FRAME)]
    stops = frames["start"] + frames["samples"]
    follows = (frames["start"] == np.concatenate(([0], stops[:-1]))) & (frames["samples"] > 0) & (stops <= limit)
    whole = int(follows.argmin()) if not follows.all() else len(frames)
    return (int(stops[whole - 1]) if whole else 0), whole


def _filled(table: NDArray[Any]) -> NDArray[Any]:
    """Return the table without the unfilled rows at its end."""
    blank = np.zeros(1, table.dtype)[0]
    length = len(table)
    while length and table[length - 1] == blank:
        length -= 1
    return table[:length]


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    """Open a file for reading; one with the mark of a writer opens in SWMR mode only."""
    try:
        file = _marked_or_not(path)
    except (OSError, RuntimeError) as error:
        raise FileError(
            f"recording {path}: not a readable HDF5 file ({error}). Remedy: check that it is the recording and whole."
        ) from error
    with file:
        yield file


def _marked_or_not(path: Path) -> h5py.File:
    with suppress(OSError, RuntimeError):
        return h5py.File(path, "r", libver="latest")
    return h5py.File(path, "r", libver="latest", swmr=True)


def _entry(file: h5py.File, path: Path) -> h5py.Group:
    try:
        if file.attrs.get("format") == FORMAT:
            _check_inside(file, path)
            return file["entry"]
    except (OSError, RuntimeError, KeyError, UnicodeDecodeError) as error:
        raise FileError(f"recording {path}: damaged ({error}). Remedy: try `rig recover` on a copy.") from error
    raise FileError(
        f"recording {path}: is not a recording of this rig. Remedy: choose a file that `rig run` has written."
    )


def _check_inside(group: h5py.Group, path: Path) -> None:
    """Refuse a file whose data lie in other files: a recording is whole, and must not show what it does not hold."""
    for name in group:
        item = group.get(name) if isinstance(group.get(name, getlink=True), h5py.HardLink) else None
        if isinstance(item, h5py.Group):
            _check_inside(item, path)
        elif item is None or (isinstance(item, h5py.Dataset) and (item.external or item.is_virtual)):
            raise FileError(
                f"recording {path}: {group.name}/{name} lies outside of it. Remedy: use the file `rig run` has written."
            )


def _writer_lives(file: h5py.File) -> bool:
    """Whether the process that began the recording is still there."""
    try:
        info = json.loads(file["entry/configuration/run"].asstr()[()])
        started = file["entry/configuration/process_started"].asstr()[()]
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, UnicodeDecodeError):
        return False
    return _author_lives(info, {"process_started": started})


def _author_lives(info: Any, metadata: Any) -> bool:
    """Whether the process that began a recording is still there, and no other one has its number."""
    import psutil

    try:
        return abs(psutil.Process(int(info["pid"])).create_time() - float(metadata["process_started"])) < 2.0
    except (psutil.Error, LookupError, TypeError, ValueError, OverflowError):
        return False


def _copy(file: h5py.File, fresh: Path, samples: int, frames: int) -> None:
    with h5py.File(fresh, "w", libver="latest") as copy:
        copy.attrs.update(file.attrs)
        _copy_group(file, copy, samples, frames)
        _end(copy["entry"], samples)


def _end(entry: h5py.Group, samples: int) -> None:
    """Say that the program died, unless the recording says how it ended."""
    if not len(entry["ending"]):
        extend(entry["ending"], np.array([(b"the program died; recovered", -9, samples, b"")], ENDING))


def _copy_group(source: h5py.Group, target: h5py.Group, samples: int, frames: int) -> None:
    for name, item in source.items():
        if isinstance(item, h5py.Group):
            group = target.create_group(name)
            group.attrs.update(item.attrs)
            _copy_group(item, group, samples, frames)
            continue
        where = item.name.removeprefix("/entry/")
        keep = samples if where in _PER_SAMPLE else frames if where in _PER_FRAME else None
        if item.shape == ():
            copied = target.create_dataset(name, data=item[()], dtype=item.dtype)
        else:
            data = item[:keep] if keep is not None else _filled(item[:])
            copied = target.create_dataset(
                name, data=data, dtype=item.dtype, maxshape=item.maxshape, chunks=item.chunks
            )
        copied.attrs.update(item.attrs)
