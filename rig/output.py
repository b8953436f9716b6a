"""Files a command writes: their names are checked before the work begins, and what cannot be written is said."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rig.errors import FileError

PICTURES = (".png", ".svg", ".pdf")
"""Endings of pictures."""


def prepare(option: str, path: Path | None, *endings: str) -> None:
    """Make the folders above an output file.

    Raises
    ------
    FileError
        Its name does not end in one of ``endings``, it is a folder, or it cannot be there.
    """
    if path is None:
        return
    if endings and path.suffix.lower() not in endings:
        raise FileError(f"{option} {path}: must end in {' or '.join(endings)}. Remedy: e.g. {path}{endings[0]}.")
    if path.is_dir():
        raise FileError(f"{option} {path}: is a folder. Remedy: name a file in it.")
    with writing(option, path):
        path.parent.mkdir(parents=True, exist_ok=True)


def prepare_folder(option: str, path: Path | None) -> None:
    """Make an output folder and those above it.

    Raises
    ------
    FileError
        It cannot be there.
    """
    if path is not None:
        with writing(option, path):
            path.mkdir(parents=True, exist_ok=True)


@contextmanager
def writing(option: str, path: Path) -> Iterator[None]:
    """Say which output could not be written."""
    try:
        yield
    except OSError as error:
        raise FileError(
            f"{option} {path}: cannot be written ({error.strerror or error}). Remedy: choose another place."
        ) from error
