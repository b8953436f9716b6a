"""Files the user names: scenes, benches and campaigns, each a file or the name of one that ships."""

from __future__ import annotations

import stat
from importlib.resources import files
from pathlib import Path
from typing import Literal

from rig.errors import FileError
from rig.scene import Scene, parse_scene

Kind = Literal["scene", "bench", "campaign"]

FOLDERS: dict[Kind, str] = {"scene": "scenes", "bench": "benches", "campaign": "campaigns"}
"""Packages that hold what ships."""

LARGEST_BYTES = 1 << 20
"""Of a text file: a thousand times what the longest scene needs."""


def shipped(kind: Kind) -> list[str]:
    """Return the names of what ships, in order."""
    found = (Path(item.name) for item in files(FOLDERS[kind]).iterdir())
    return sorted(path.stem for path in found if path.suffix == ".toml")


def find(kind: Kind, name: str | Path) -> tuple[str, str]:
    """Return text and source of a file, or of one that ships; its bare name always means the one that ships.

    Raises
    ------
    FileError
        There is neither; the message names all that ship.
    """
    names = shipped(kind)
    if str(name) not in names:
        return read_text(kind, Path(name), f", or name one that ships: {', '.join(names)}"), str(name)
    folder = FOLDERS[kind]
    return files(folder).joinpath(f"{name}.toml").read_text("utf-8"), f"{folder}/{name}.toml"


def load_scene(name: str | Path) -> tuple[Scene, str]:
    """Return a scene and its text: a file, or one that ships by its name.

    Raises
    ------
    FileError
        Names the file, the key, the value and the allowed range.
    """
    text, source = find("scene", name)
    return parse_scene(text, source), text


def read_text(kind: str, path: Path, otherwise: str = "") -> str:
    """Read a small UTF-8 text file, with or without a byte order mark; ``otherwise`` ends the remedy if it is missing.

    Raises
    ------
    FileError
        It does not exist, cannot be read, is no ordinary file, or far too long.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise FileError(f"{kind} {path}: is no ordinary file. Remedy: it must be a UTF-8 text file.")
        if status.st_size > LARGEST_BYTES:
            raise FileError(f"{kind} {path}: has {status.st_size} bytes. Remedy: at most {LARGEST_BYTES} are read.")
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise FileError(f"{kind} {path}: no such file. Remedy: check the path{otherwise}.") from error
    except (OSError, ValueError) as error:  # a path may hold what no path can
        raise FileError(f"{kind} {path}: cannot be read ({error}). Remedy: it must be a UTF-8 text file.") from error
