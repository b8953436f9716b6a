"""What keeps the loop's turns short in real time: precedence over other programs, no full collection of garbage."""

from __future__ import annotations

import gc
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

NICENESS = -10
"""Of the loop's thread where the system has Unix priorities: before ordinary programs, behind the system's own."""


@contextmanager
def undisturbed() -> Iterator[str]:
    """Run the loop with precedence; yield whether the system has granted it, for the log.

    A full collection goes through everything that the libraries have loaded, which takes 50 ms and more: what is there
    when the loop begins is left out of it until the loop ends.
    """
    gc.collect()
    gc.freeze()
    try:
        with _precedence() as granted:
            yield "precedence over other programs: " + ("yes" if granted else "not granted by the system")
    finally:
        gc.unfreeze()


@contextmanager
def _precedence() -> Iterator[bool]:
    before = _priority()
    try:
        _set_priority(_raised(before))
    except PermissionError:
        yield False
        return
    try:
        yield True
    finally:
        _set_priority(before)


if sys.platform == "win32":  # priorities of processes

    def _raised(before: int) -> int:
        import psutil

        return int(psutil.HIGH_PRIORITY_CLASS)

    def _priority() -> int:
        import psutil

        return int(psutil.Process().nice())

    def _set_priority(value: int) -> None:
        import psutil

        psutil.Process().nice(value)

else:  # priorities of threads

    def _raised(before: int) -> int:
        return min(before, NICENESS)

    def _priority() -> int:
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    def _set_priority(value: int) -> None:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), value)
