"""What a crash has left of a recording, made whole: from its journal, or from what can be read."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile

import h5py
import numpy as np

from rig.errors import BeingWritten, FileError
from rig.journal import journal_of, read_journal, sync, sync_folder
from rig.layout import ENDING, PER_FRAME, PER_SAMPLE, complete, extend, filled, lay_out
from rig.recording_file import entry_of, insist, opened, reading
from rig.seal import is_sealed, probe, seal
from rig.writer import lives

QUIET_S = 60.0
"""A recording that has not changed for so long is not being written: frames come all the time, in a hold too."""


@dataclass(frozen=True)
class Recovery:
    """What ``recover`` found: samples and frames kept, and whether anything had to be done."""

    path: Path
    samples: int
    frames: int
    repaired: bool


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
        The program that writes it is still running, or may be (``force`` overrides).
    """
    insist(path)
    path = Path(os.path.realpath(path))  # its journal lies beside the file, not beside a link to it
    if not is_sealed(path):
        rewritten = _rewritten(path, force=force)
        if rewritten is not None:
            return rewritten
        if not path.is_file():
            raise FileError(
                f"recording {path}: only its journal is there, and holds nothing or is still being written. "
                "Remedy: wait for the run to end; where its program has died elsewhere, wait a minute."
            )
        try:
            probe(path)
        except FileError as error:
            if not journal_of(path).exists():
                raise
            raise FileError(
                f"{error} Its journal, {journal_of(path)}, lies beside it: if the program that wrote it is dead, "
                "`rig recover --force` writes the recording anew from that, or try again in a minute."
            ) from error
    with opened(path) as file:
        if file.swmr_mode and not force and _may_be_written(path, _writer_of(file)):
            raise BeingWritten(
                f"recording {path}: is still being written. Remedy: wait for the run to end; where its program has "
                "died on another computer or in a container, wait a minute."
            )
        if not file.swmr_mode:
            with reading(path):
                return Recovery(path, *complete(entry_of(file, path)), repaired=False)
    return _repair(path)


def _repair(path: Path) -> Recovery:
    """Copy what is whole in a file with the mark of a writer into a new one."""
    with _replacing(path) as fresh, opened(path) as file:
        samples, frames = complete(entry_of(file, path))
        _copy(file, fresh, samples, frames)
    return Recovery(path, samples, frames, repaired=True)


def _rewritten(path: Path, *, force: bool) -> Recovery | None:
    """Write a recording anew from its journal; ``None`` if it has none, or its writer lives."""
    journal = journal_of(path)
    try:
        header, records = read_journal(journal)
    except FileError:
        return None
    told = header["metadata"]
    if not force and _may_be_written(path, told.get("writer") if isinstance(told, dict) else None):
        return None
    with _replacing(path) as fresh, h5py.File(fresh, "w", libver="latest") as file:
        sets = lay_out(file, **header)
        for blocks in records:
            for name, block in blocks.items():
                extend(sets[name], block)
        samples, frames = complete(file["entry"])
        _end(file["entry"], samples)
    journal.unlink(missing_ok=True)
    return Recovery(path, samples, frames, repaired=True)


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """Give the name of a new file; once written it is sealed, forced to the disk, and takes the old one's place.

    Two programs may repair one recording at the same time: each writes a file of its own.
    """
    fresh = path.with_name(f".{path.name}.{os.getpid()}.recovering")
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


def _may_be_written(path: Path, writer: object) -> bool:
    """Whether the writer lives or, where nobody here can know, files of the recording have changed of late.

    A recording may be looked at from another computer or container, or have been copied from there.
    """
    alive = lives(writer)
    return _changed_lately(path) if alive is None else alive


def _changed_lately(path: Path) -> bool:
    """Whether it is a minute yet, by the clock of the disk: a server's may differ from ours."""
    with suppress(OSError), TemporaryFile(dir=path.parent) as fresh:
        now = os.fstat(fresh.fileno()).st_mtime
        return any(abs(now - file.stat().st_mtime) < QUIET_S for file in (path, journal_of(path)) if file.exists())
    return False  # nothing can be written there, and so nothing replaced


def _writer_of(file: h5py.File) -> object:
    with suppress(OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError):
        return file["entry/configuration/writer"].asstr()[()]
    return None


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
        keep = samples if where in PER_SAMPLE else frames if where in PER_FRAME else None
        if item.shape == ():
            copied = target.create_dataset(name, data=item[()], dtype=item.dtype)
        else:
            data = item[:keep] if keep is not None else filled(item[:])
            copied = target.create_dataset(
                name, data=data, dtype=item.dtype, maxshape=item.maxshape, chunks=item.chunks
            )
        copied.attrs.update(item.attrs)
