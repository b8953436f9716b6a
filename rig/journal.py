"""A journal beside a recording, forced to the disk at every flush, to write it anew from after a power cut.

HDF5 overwrites parts of its file in place, and a power cut may keep any part of that. The journal is only ever appended
to, each record with its checksum, so that its beginning stays good whatever happens to its end.
"""

from __future__ import annotations

import io
import json
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from rig.errors import FileError

_MAGIC = b"RIGJOURNAL1\n"
_PREFIX = struct.Struct("<QI")
"""Length and CRC-32 of what follows."""

KEYS = {"info", "channels", "metadata", "units", "started"}
"""What a journal begins with: what ``rig.layout.lay_out`` asks for."""

Blocks = dict[str, NDArray[Any]]


def journal_of(recording: Path) -> Path:
    """Return where the journal of a recording lies."""
    return recording.with_name(f"{recording.name}.journal")


class Journal:
    """Written beside a recording while it grows.

    Parameters
    ----------
    recording
        Whose journal; both are on the disk when this returns.
    header
        What is needed to lay the recording out again.

    Raises
    ------
    OSError
        It exists already, or the disk refuses it.
    """

    def __init__(self, recording: Path, header: Mapping[str, Any]) -> None:
        self._path = journal_of(recording)
        self._file = self._path.open("xb", buffering=0)
        try:
            self._append(json.dumps(header).encode(), _MAGIC)
            sync_folder(self._path)
        except OSError:
            self.close(keep=False)
            raise

    def write(self, blocks: Mapping[str, NDArray[Any]]) -> None:
        """Append the rows that each dataset grows by; they survive a power cut from now on."""
        packed = io.BytesIO()
        np.savez(packed, **blocks)  # type: ignore[arg-type]
        self._append(packed.getvalue())

    def close(self, *, keep: bool) -> None:
        """Close it; ``keep`` it where the recording itself is not safe on the disk."""
        self._file.close()
        if not keep:
            self._path.unlink()

    def _append(self, content: bytes, before: bytes = b"") -> None:
        left = memoryview(before + _PREFIX.pack(len(content), zlib.crc32(content)) + content)
        while left:
            left = left[self._file.write(left) :]
        os.fsync(self._file.fileno())


def read_journal(path: Path) -> tuple[dict[str, Any], Iterator[Blocks]]:
    """Return the header and every whole record after it.

    Raises
    ------
    FileError
        Not even the header is whole: the recording had not begun.
    """
    try:
        records = _records(path.read_bytes())
        header: dict[str, Any] = json.loads(next(records))
        if header.keys() != KEYS:
            raise ValueError(f"it begins with {', '.join(header)}")
    except (OSError, ValueError, AttributeError, StopIteration) as error:
        raise FileError(f"journal {path}: holds nothing ({error}). Remedy: remove it.") from error
    return header, map(_unpacked, records)


def _records(content: bytes) -> Iterator[bytes]:
    place = len(_MAGIC) if content.startswith(_MAGIC) else len(content)
    while place + _PREFIX.size <= len(content):
        length, checksum = _PREFIX.unpack_from(content, place)
        place += _PREFIX.size + length
        record = content[place - length : place]
        if len(record) < length or zlib.crc32(record) != checksum:
            return
        yield record


def _unpacked(record: bytes) -> Blocks:
    try:
        with np.load(io.BytesIO(record), allow_pickle=False) as blocks:
            return dict(blocks)
    except (OSError, EOFError, BadZipFile) as error:
        raise ValueError(f"a record of the journal is none ({error})") from error


def sync(path: Path) -> None:
    """Force a file and its name in the folder to the disk."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())
    sync_folder(path)


def sync_folder(path: Path) -> None:
    """Force the folder that names this file to the disk; Windows does so by itself."""
    if os.name == "posix":
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
