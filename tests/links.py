"""What the tests of both serial drivers share: ports, other threads, instruments that send nonsense."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import pytest
from dialogue import Exchange

from drivers.emulated.faults import Faults
from drivers.emulated.server import Instrument, Line, Unplugged, serve_pty
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


class VirtualWire:
    """An emulated instrument on a wire in virtual time: waiting takes none, so that no computer is too busy for it.

    It is the instrument's line, the driver's port and the driver's ``time``. How it is read is the driver's matter.
    """

    def __init__(self, instrument: Instrument) -> None:
        self._now = 0.0
        self._coming: deque[tuple[float, bytes]] = deque()
        self._received = b""
        self._unplugged = False
        self._session = instrument.connect(self)  # type: ignore[arg-type]

    def monotonic(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        self._now += seconds

    def send(self, data: bytes, delay: float = 0.0) -> None:
        """Take a reply that comes so many seconds from now, and not before an earlier one."""
        earliest = self._coming[-1][0] if self._coming else 0.0
        self._coming.append((max(earliest, self._now + delay), data))

    def write(self, data: bytes) -> None:
        self._insist()
        try:
            self._session.receive(data)
        except Unplugged:
            self._unplugged = True

    def close(self) -> None:
        pass

    def _insist(self) -> None:
        if self._unplugged:
            raise ConnectionResetError("the cable is out")

    def _wait(self, seconds: float) -> bool:
        """Let time pass until more has been received; return whether any has."""
        self._insist()
        if not self._coming or self._coming[0][0] > self._now + seconds:
            self._now += seconds
            return False
        due, data = self._coming.popleft()
        self._now = max(self._now, due)
        self._received += data
        return True

    def _take(self, size: int) -> bytes:
        data, self._received = self._received[:size], self._received[size:]
        return data


class GatewayWire(VirtualWire):
    """Read as the gateway reads."""

    def read(self, timeout: float) -> bytes:
        self._wait(timeout)
        return self._take(len(self._received))

    def drain(self) -> None:
        while self._wait(0.0):
            pass
        self._received = b""


class SerialWire(VirtualWire):
    """Read as pyserial reads."""

    def __init__(self, instrument: Instrument, timeout: float) -> None:
        super().__init__(instrument)
        self._timeout = timeout

    def read_until(self, expected: bytes, size: int) -> bytes:
        deadline = self._now + self._timeout
        while expected not in self._received[:size]:
            if not self._wait(deadline - self._now):
                return self._take(size)
        return self._take(self._received.index(expected) + len(expected))

    @property
    def in_waiting(self) -> int:
        while self._wait(0.0):
            pass
        return len(self._received)

    def read(self, size: int) -> bytes:
        return self._take(size)


class Script:
    """A scripted instrument, for a wire in virtual time; ``dialogue`` serves one on TCP."""

    watch_interval = None

    def __init__(self, exchanges: Iterable[Exchange]) -> None:
        self._left = deque(exchanges)
        self._heard = b""

    def connect(self, line: Line) -> Script:
        self._line = line
        return self

    def receive(self, data: bytes) -> None:
        self._heard += data
        while self._left and self._heard.startswith(self._left[0][0]):
            expected, reply = self._left.popleft()
            self._heard = self._heard.removeprefix(expected)
            self._line.send(reply)

    def watch(self) -> None:
        pass

    def check(self) -> None:
        """Fail unless exactly the expected bytes came."""
        assert (self._heard, list(self._left)) == (b"", [])


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
    """Wait for another thread's doing, as long as the test may last."""
    for _ in range(200_000):
        if condition():
            return
        time.sleep(1e-3)
    raise AssertionError("the condition never came true")
