"""The recorder: one HDF5 file per run, NeXus-shaped, in SWMR mode, flushed while the run goes on.

Every dataset exists before SWMR starts. What ``flush`` has written is acknowledged: it survives the death of the
program. Layout: ``docs/recording.md``.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from io import BufferedWriter
from itertools import chain
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import PumpStatus
from rig.errors import FileError
from rig.journal import Journal, journal_of, sync
from rig.layout import (
    ENDING,
    EVENTS,
    FRAMES,
    PREDICTIONS,
    PUMP,
    PUMP_STATES,
    STAGE,
    STEPS,
    extend,
    lay_out,
    pack_stage,
    pieces,
)
from rig.observe import Ending, Event, RunInfo, StepEvent, StepPhase
from rig.recording_file import free_names
from rig.seal import seal
from sequences.frame import Frame

FLUSH_SECONDS = 0.05
LEAST_ROOM = 16 << 20
"""Free bytes on the disk at which a run ends: enough to finish and close the recording."""

_NONE = np.empty(0)


def insist_on_new(path: Path) -> None:
    """Refuse a name under which no recording can be written; to be asked before anything is opened.

    Raises
    ------
    FileError
        It does not end in .h5, is taken, too long or no text, its folder is none, or its disk is full.
    """
    try:
        reason, remedy = _objection(path)
    except (OSError, UnicodeEncodeError) as error:
        reason, remedy = str(error), "choose another name with --out"
    if reason:
        name = str(path).encode(errors="backslashreplace").decode()
        raise FileError(f"recording {name}: {reason}. Remedy: {remedy}.")


def _objection(path: Path) -> tuple[str, str]:
    """Return why no recording can have this name, and the remedy; nothing for a good one."""
    str(path).encode()
    if path.suffix.casefold() != ".h5":
        return "its name does not end in .h5", "choose another name with --out"
    if _is_there(path):
        return "exists already", "choose another name with --out"
    journal = journal_of(path)
    if _is_there(journal):
        return (
            f"{journal} of an earlier recording with this name lies there",
            "choose another name with --out; remove the journal only if that recording is not missed",
        )
    folder = next(folder for folder in path.absolute().parents if folder.exists())
    room = _room(folder)
    if room < LEAST_ROOM:
        return f"only {room >> 20} MiB are left on the disk", "free space, or choose another disk with --out"
    return "", ""


def _room(folder: Path, written: int = 0) -> int:
    """Return how many bytes a file in this folder, which holds so many already, can still take."""
    free = shutil.disk_usage(folder).free
    if sys.platform != "win32":
        import resource

        largest, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
        if largest != resource.RLIM_INFINITY:
            return min(free, largest - written)
    return free


def _is_there(path: Path) -> bool:
    try:
        path.lstat()
    except FileNotFoundError:
        return False
    return True


class Recorder:
    """Writes one recording.

    ``acknowledged`` counts the samples that have been flushed; ``failed`` is set when the disk has refused a write.

    Parameters
    ----------
    path
        Must not exist: a recording is never overwritten. After ``close`` where the recording lies.
    channels, units
        Names and units of the raw channels, in order.
    metadata
        Texts kept whole beside the data: scene, bench, versions, seed, place, writer.
    journalled
        Whether what is acknowledged survives a power cut too, by a journal beside the recording (``rig.journal``).

    Raises
    ------
    FileError
        The file exists or cannot be created.
    """

    def __init__(
        self,
        path: Path,
        info: RunInfo,
        channels: tuple[str, ...],
        units: tuple[str, ...],
        metadata: Mapping[str, str],
        *,
        journalled: bool = False,
    ) -> None:
        self.path = path
        self.acknowledged = 0
        self.failed = False
        self._pending: dict[str, list[NDArray[Any]]] = {}
        self._frames: list[tuple[Frame, NDArray[np.float64], float]] = []
        self._last_flush = time.perf_counter()
        self._last_pump: PumpStatus | None = None
        self._journal: Journal | None = None
        header: dict[str, Any] = {
            "info": asdict(info),
            "channels": list(channels),
            "metadata": dict(metadata),
            "units": list(units),
            "started": datetime.now(UTC).isoformat(),
        }
        image, places = _laid_out(header)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            _write_new(path, image)
        except (OSError, ValueError) as error:
            raise _not_created(path, error) from error
        try:
            self._journal = Journal(path, header) if journalled else None
        except OSError as error:
            path.unlink()
            raise _not_created(path, error) from error
        try:
            self._held = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
            try:
                self._file = h5py.File(path, "r+", libver="latest")
            except OSError:  # a file system without locks, say
                os.close(self._held)
                raise
        except OSError as error:
            if self._journal is not None:
                self._journal.close(keep=False)
            path.unlink()
            raise _not_created(path, error) from error
        self._sets = {name: self._file[place] for name, place in places.items()}
        self._file.swmr_mode = True

    def append(self, frame: Frame, height: NDArray[np.float64], arrived: float) -> None:
        """Take one frame; it is acknowledged with the next flush."""
        self._frames.append((frame, height, arrived))
        if time.perf_counter() - self._last_flush >= FLUSH_SECONDS:
            self._commit()

    def step(self, event: StepEvent) -> None:
        """Take the beginning or the end of a step; what a step has done is on the disk before the next begins."""
        if event.phase is not StepPhase.PROGRESS:
            self._put("steps", _row(STEPS, event.sample, event.phase.value, event.name, event.outcome))
        if event.phase is StepPhase.ENDED and event.outcome == "done":
            self._commit()

    def event(self, event: Event) -> None:
        """Take one line of the log."""
        for piece in pieces(event.text):
            self._put("events", _row(EVENTS, event.sample, event.kind, piece))

    def prediction(self, sample: int, text: str) -> None:
        """Take one live prediction as JSON."""
        encoded = text.encode()
        if len(encoded) > PREDICTIONS["json"].itemsize:
            raise ValueError(f"a live prediction of {len(encoded)} bytes does not fit the recording")
        self._put("predictions", np.array([(sample, encoded)], PREDICTIONS))

    def end(self, ending: Ending) -> None:
        """Take how the run ended."""
        now = datetime.now(UTC).isoformat()
        self._put("ending", _row(ENDING, ending.reason, ending.exit_code, ending.samples, now))

    def flush(self) -> None:
        """Write what is pending, hand it to the operating system, and acknowledge it.

        Raises
        ------
        FileError
            The disk is full or gone; what was acknowledged before stays readable.
        """
        blocks = self._blocks()
        with self._detached_on_failure():
            if self._journal is not None and blocks:
                self._journal.write(blocks)
            for name, block in blocks.items():
                extend(self._sets[name], block)
        if self._frames:
            self.acknowledged = self._frames[-1][0].stop
        self._pending.clear()
        self._frames.clear()
        self._last_flush = time.perf_counter()

    def _blocks(self) -> dict[str, NDArray[Any]]:
        """Return the rows pending for each dataset; the frames' table goes last: it commits the rest."""
        blocks = {name: np.concatenate(rows) for name, rows in self._pending.items()}
        if not self._frames:
            return blocks
        frames = [frame for frame, _, _ in self._frames]
        blocks |= {
            "volts": np.concatenate([frame.volts for frame in frames], axis=1).T,
            "time": np.arange(frames[0].start, frames[-1].stop) / frames[0].rate,
            "force": np.concatenate([frame.force for frame in frames]),
            "height": np.concatenate([height for _, height, _ in self._frames]),
            "stage": np.array([pack_stage(frame.stage) for frame in frames], STAGE),
            "pump": np.array(list(self._pump_polls(frames)), PUMP),
            "pressure": np.concatenate([frame.pressure for frame in frames if frame.pressure is not None] or [_NONE]),
            "frames": np.array([(frame.start, frame.force.size, at) for frame, _, at in self._frames], FRAMES),
        }
        return {name: block for name, block in blocks.items() if len(block)}

    def _pump_polls(self, frames: list[Frame]) -> Iterator[tuple[Any, ...]]:
        """Yield each poll of the pump once, with the frame it came with."""
        for frame in frames:
            if frame.pump is not None and frame.pump is not self._last_pump:
                self._last_pump, pump = frame.pump, frame.pump
                state = PUMP_STATES.index(pump.state)
                yield frame.stop, pump.sent, pump.received, state, pump.rate, pump.volume

    def close(self) -> None:
        """Flush, close and seal; a closed recorder, or one whose disk has failed, closes without effect."""
        if not self._file:
            return
        self.flush()
        with self._detached_on_failure():
            self._file.flush()
        try:
            self._file.close()
            asked, self.path = self.path, self._rescued()
            seal(self.path)
            if self._journal is not None:
                sync(self.path)
                self._journal.close(keep=False)
        finally:
            os.close(self._held)
        if self.path != asked:
            raise FileError(f"recording {asked}: its place was taken, it now lies in {self.path}")

    def _commit(self) -> None:
        self.flush()
        self._insist_on_disk()

    def _insist_on_disk(self) -> None:
        """End the run in good order before the disk is full, or when the file has gone from its place."""
        if not self._in_place():
            raise FileError(
                f"recording {self.path}: the file has been removed or moved while it was written. Remedy: leave it in "
                "its place; it is written again now that the run has ended."
            )
        room = _room(self.path.parent, os.fstat(self._held).st_size)
        if room < LEAST_ROOM:
            raise FileError(
                f"recording {self.path}: only {room >> 20} MiB are left on the disk. "
                "Remedy: free space, or choose another disk with --out; the recording is complete so far."
            )

    def _in_place(self) -> bool:
        with contextlib.suppress(OSError):
            return os.path.samestat(os.fstat(self._held), self.path.stat())
        return False

    def _rescued(self) -> Path:
        """Return where the closed file lies; one that was removed is written again from the handle we kept."""
        if self._in_place():
            return self.path
        written = self._new_place()
        with open(self._held, "rb", closefd=False) as held, written:
            held.seek(0)
            shutil.copyfileobj(held, written)
        return Path(written.name)

    def _new_place(self) -> BufferedWriter:
        """Open the first free name: where the file was or, if its folder is gone for good, further up."""
        rescued = self.path.with_name(f"{self.path.stem}-rescued{self.path.suffix}")
        for folder in self.path.parents:
            with contextlib.suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                for name in chain([self.path], free_names(rescued)):
                    with contextlib.suppress(FileExistsError):
                        return (folder / name.name).open("xb")
        raise FileError(f"recording {self.path}: was removed and can be written nowhere again")

    @contextlib.contextmanager
    def _detached_on_failure(self) -> Iterator[None]:
        """After a failed write let HDF5 write the rest into a scratch file and close that.

        It could not close the file itself: the attempt ends in a crash of the interpreter, at its exit. What an earlier
        flush has put on the disk stays as it is.
        """
        try:
            yield
        except (OSError, RuntimeError) as error:
            self.failed = True
            with tempfile.TemporaryFile(dir=_scratch()) as scratch:
                os.dup2(scratch.fileno(), self._file.id.get_vfd_handle())
            self._file.close()
            os.close(self._held)
            if self._journal is not None:
                self._journal.close(keep=True)
            cause = re.search(r"error message = '([^']*)'", str(error))
            raise FileError(
                f"recording {self.path}: writing failed after {self.acknowledged} samples "
                f"({cause[1] if cause else error}). Remedy: free space on the disk or choose another with --out; "
                "`rig recover` repairs what was written."
            ) from error

    def _put(self, name: str, block: NDArray[Any]) -> None:
        if self._file:
            self._pending.setdefault(name, []).append(block)


def _laid_out(header: Mapping[str, Any]) -> tuple[bytes, dict[str, str]]:
    """Return an empty recording as bytes, and where each of its datasets lies.

    It is made in memory: a disk that refuses it then gives an ordinary error, where HDF5 would crash the interpreter.
    """
    with h5py.File("empty", "w", driver="core", backing_store=False, libver="latest") as file:
        places = {name: dataset.name for name, dataset in lay_out(file, **header).items()}
        file.flush()
        return file.id.get_file_image(), places


def _write_new(path: Path, content: bytes) -> None:
    """Write a file that must not exist; where the disk refuses it, nothing is left behind."""
    file = path.open("xb")
    try:
        with file:
            file.write(content)
    except OSError:
        path.unlink()
        raise


def _not_created(path: Path, error: Exception) -> FileError:
    return FileError(
        f"recording {path}: cannot be created ({error}). Remedy: check the folder, its rights and its space, "
        "or choose another name with --out."
    )


def _scratch() -> str | None:
    """Return a directory in memory where there is one: the disk may be full."""
    return "/dev/shm" if os.path.isdir("/dev/shm") else None


def _row(table: np.dtype[Any], *values: Any) -> NDArray[Any]:
    cells = tuple(value.encode(errors="backslashreplace") if isinstance(value, str) else value for value in values)
    return np.array([cells], table)
