"""Where runs serve their consoles: address files in the user's own runtime directory, readable by that user alone."""

from __future__ import annotations

import json
import os
import re
import stat
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from rig.errors import RigError

DIRECTORY_VARIABLE = "RIG_RUNTIME_DIRECTORY"


class LinkError(RigError):
    """The link to a run cannot be made or has broken."""


@dataclass(frozen=True, slots=True)
class Address:
    """Where a run serves, and the key that proves one may listen."""

    name: str
    host: str
    port: int
    key: bytes
    pid: int


def runtime_directory() -> Path:
    """Return the directory of the address files, made if need be and open to this user only.

    Raises
    ------
    LinkError
        The directory belongs to somebody else or is open to others.
    """
    told = os.environ.get(DIRECTORY_VARIABLE)
    path = Path(told) if told else _default_directory()
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise LinkError(f"link: {path} cannot be made ({error}). Remedy: set {DIRECTORY_VARIABLE}.") from error
    _insist_private(path)
    return path


def _default_directory() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", tempfile.gettempdir())) / "rig" / "runs"
    return Path("/tmp") / f"rig-{os.getuid()}"


def _insist_private(path: Path) -> None:
    if sys.platform == "win32":  # the profile directory's access list already says so
        return
    status = path.lstat()
    if status.st_uid != os.getuid() or stat.S_ISLNK(status.st_mode) or status.st_mode & 0o077:
        raise LinkError(
            f"link: {path} can be reached by other users. Remedy: remove it, or set {DIRECTORY_VARIABLE} to a "
            "directory of your own with mode 700."
        )


def running() -> list[Address]:
    """Return the runs that can be attached to, newest first."""
    files = sorted(runtime_directory().glob("*.json"), key=_age)
    return [address for address in map(_read, files) if address is not None]


def find(name: str) -> Address | None:
    """Return the run of this name, or ``None`` while it is not there."""
    return _read(address_file(name))


def _age(path: Path) -> float:
    try:
        return -path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _read(path: Path) -> Address | None:
    try:
        _insist_private(path)
        held = json.loads(path.read_text(encoding="utf-8"))
        return Address(path.stem, str(held["host"]), int(held["port"]), bytes.fromhex(held["key"]), int(held["pid"]))
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise LinkError(f"link: {path} is damaged ({error}). Remedy: delete it.") from error


def address_file(name: str) -> Path:
    """Return where a run of this name says that it serves.

    Raises
    ------
    LinkError
        The name is no plain word, or the directory is not this user's own.
    """
    if not re.fullmatch(r"[A-Za-z0-9-]{1,64}", name):
        raise LinkError(f"link: {name!r} is no name for a run. Remedy: letters, digits and hyphens.")
    return runtime_directory() / f"{name}.json"


def publish(address: Address) -> Path:
    """Write the file of a run that serves from now on; whoever sees it sees all of it."""
    path = address_file(address.name)
    text = json.dumps({"host": address.host, "port": address.port, "key": address.key.hex(), "pid": address.pid})
    draft = path.with_suffix(".new")
    with open(os.open(draft, os.O_CREAT | os.O_TRUNC | os.O_WRONLY, 0o600), "w", encoding="utf-8") as file:
        file.write(text)
    draft.replace(path)
    return path


def forget(address: Address) -> None:
    """Remove the file of a run that died without doing so itself; a run that has taken its name keeps its own."""
    if find(address.name) == address:
        address_file(address.name).unlink(missing_ok=True)
