"""What the tests of both serial drivers share: ports, other threads, instruments that send nonsense."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import pytest

from drivers.emulated.faults import Faults
from drivers.emulated.server import serve_pty
from drivers.errors import BadReply, DeviceError, NoReply

TERMINALS = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals are POSIX")
PTY = pytest.param(serve_pty, marks=TERMINALS)


class BabblingPort:
    """Answers every write with the next of the given replies, at once; how it is read is the driver's matter."""

    def __init__(self, replies: Iterable[bytes]) -> None:
        self._replies = iter(replies)
        self._pending = b""

    def write(self, data: bytes) -> None:
        self._pending += next(self._replies, b"")

    def close(self) -> None:
        pass


def outcomes(instrument: Any, device: str, calls: Sequence[Callable[[Any], Any]]) -> Iterator[tuple[Any, Any]]:
    """Make the calls; yield each that succeeds with what it returns. The others must fail with a full error."""
    for call in calls:
        try:
            result = call(instrument)
        except DeviceError as error:
            assert error.device == device
            assert error.remedy
        else:
            yield call, result


def believed(poll: Callable[[], Any], begin: Callable[[], None], faults: Faults, *, last: int) -> Iterator[Any]:
    """Poll twelve times; a fault begins with the second and lasts until ``last``. Yield the replies believed."""
    for attempt in range(12):
        if attempt == 1:
            begin()
        if attempt == last:
            faults.clear()
        with contextlib.suppress(NoReply, BadReply):
            yield poll()


@contextlib.contextmanager
def stopping(stop: Callable[[], None]) -> Iterator[threading.Event]:
    """Stop a hundred times from another thread; the event says when that is done."""
    done = threading.Event()

    def stop_often() -> None:
        for _ in range(100):
            stop()
        done.set()

    thread = threading.Thread(target=stop_often)
    thread.start()
    yield done
    thread.join()


def wait_until(condition: Callable[[], Any]) -> None:
    """Wait for another thread's doing."""
    for _ in range(10_000):
        if condition():
            return
        time.sleep(1e-3)
    raise AssertionError("the condition never came true")
