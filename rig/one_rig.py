"""One rig, one program: whoever holds an instrument's lock file may open it; the lock ends with its process."""

from __future__ import annotations

import hashlib
import os
import socket
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import IO
from urllib.parse import urlsplit

from rig.bench import Bench
from rig.errors import RigError
from rig.link_address import runtime_directory


class InUse(RigError):
    """Another program has this instrument; nothing has been opened."""

    exit_code = 5


class Claim:
    """The instruments of a bench, held for this program until ``release``.

    Parameters
    ----------
    bench
        Its real connections; what the program emulates itself needs no lock.
    pressure
        Whether the pump is needed too.

    Raises
    ------
    InUse
        Names the instrument, its connection and the process that has it.
    """

    def __init__(self, bench: Bench, *, pressure: bool) -> None:
        self._held = ExitStack()
        connections = {"stage": bench.stage.connection, "daq": f"{bench.daq.connection} {_device(bench.force.channel)}"}
        if pressure and bench.pump is not None:
            connections["pump"] = bench.pump.connection
        try:
            for device, connection in sorted(connections.items()):
                self._held.enter_context(_locked(device, connection))
        except BaseException:
            self.release()
            raise

    def release(self) -> None:
        """Let other programs have the instruments; a second call does nothing."""
        self._held.close()


def same(connection: str) -> str:
    """Return one name for all the names of a connection: links, host names and letter case aside.

    Examples
    --------
    >>> same("socket://localhost:50000")
    'socket://127.0.0.1:50000'
    """
    scheme, _, rest = connection.partition("://")
    if rest:
        parts = urlsplit(f"//{rest.partition(' ')[0]}")
        try:
            host = socket.gethostbyname(parts.hostname or "")
        except OSError:
            host = parts.hostname or ""
        tail = rest.partition(" ")[2]
        return f"{scheme}://{host}:{parts.port}{' ' + tail if tail else ''}"
    return os.path.realpath(connection) if connection.startswith("/") else connection.casefold()


def _device(channel: str) -> str:
    return channel.partition("/")[0]


def _locked(device: str, connection: str) -> IO[str]:
    path = _lock_file(connection)
    file = open(os.open(path, os.O_RDWR | os.O_CREAT, 0o600), "r+", encoding="utf-8")  # noqa: SIM115 - held, not used up
    if _lock(file):
        file.seek(0)
        file.truncate()
        file.write(f"{os.getpid()}")
        file.flush()
        return file
    owner = file.read().strip() or "?"
    file.close()
    raise InUse(
        f"{device}: another program (process {owner}) is using {connection}. Remedy: end it first; "
        "two programs on one rig would move it against each other."
    )


def _lock_file(connection: str) -> Path:
    return runtime_directory() / f"{hashlib.sha256(same(connection).encode()).hexdigest()[:16]}.lock"


if sys.platform == "win32":
    import msvcrt

    _BEYOND = 1 << 20
    """The lock lies beyond the text, which stays readable to others."""

    def _lock(file: IO[str]) -> bool:
        file.seek(_BEYOND)
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        finally:
            file.seek(0)
        return True
else:
    import fcntl

    def _lock(file: IO[str]) -> bool:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True
