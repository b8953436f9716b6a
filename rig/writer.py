"""Who writes a recording: a process told from every other one, of this computer or another, whatever the clock does."""

from __future__ import annotations

import json
import os
import socket
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any


def this_process() -> str:
    """Return what a recording keeps of its writer, as JSON."""
    return json.dumps(_identity(os.getpid()))


def lives(writer: object) -> bool | None:
    """Whether the process that ``this_process`` was asked in is still there; ``None`` if nobody here can know."""
    try:
        told = json.loads(str(writer))
        if told["computer"] != _computer():
            return None
        return bool(told == _identity(told["process"]))
    except (ValueError, LookupError, TypeError, OSError):
        return None


def _identity(process: int) -> dict[str, Any]:
    return {"computer": _computer(), "process": process, "started": _started(process)}


def _computer() -> list[str]:
    """Return what gives processes their numbers: the computer, since it was switched on, and on Linux the namespace."""
    names = [socket.gethostname()]
    with suppress(OSError):
        names += [Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip(), os.readlink("/proc/self/ns/pid")]
    return names


if sys.platform == "linux":

    def _started(process: int) -> float | None:
        """Return when a process began, in ticks of a clock that nobody can set; ``None`` without such a process."""
        try:
            fields = Path(f"/proc/{process:d}/stat").read_bytes().rpartition(b")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            return None
        return None if fields[0] in b"ZX" else int(fields[19])
else:

    def _started(process: int) -> float | None:
        """Return when a process began, s; ``None`` without such a process."""
        import psutil

        try:
            return psutil.Process(process).create_time()
        except psutil.NoSuchProcess:
            return None
        except psutil.AccessDenied as error:
            raise PermissionError(str(error)) from error
