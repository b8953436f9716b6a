"""Opening the file of a recording, whoever has written it: what is no recording, or damaged, is named."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

import h5py

from rig.errors import FileError
from rig.journal import journal_of
from rig.layout import FORMAT


def insist(path: Path) -> None:
    """Refuse a path where there is no file, nor the journal to write one anew from."""
    if not path.is_file() and not journal_of(Path(os.path.realpath(path))).is_file():
        raise FileError(f"recording {path}: no such file. Remedy: check the path.")


def free_names(path: Path) -> Iterator[Path]:
    """Yield a name and, where it is taken, ``-2``, ``-3`` and so on behind it; create with ``x``, or look first."""
    for number in count(1):
        yield path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
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


def entry_of(file: h5py.File, path: Path) -> h5py.Group:
    """Return the entry of a recording.

    Raises
    ------
    FileError
        It is damaged, none of ours, or its data lie in other files.
    """
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


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn whatever a damaged file makes h5py and NumPy raise into a ``FileError`` that names it."""
    try:
        yield
    except (LookupError, ValueError, OSError, RuntimeError, TypeError, AttributeError, MemoryError) as error:
        raise FileError(
            f"recording {path}: incomplete or damaged ({error}). Remedy: try `rig recover`; "
            "otherwise open it with h5py and save what is there."
        ) from error
