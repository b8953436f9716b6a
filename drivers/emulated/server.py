"""Serves emulated instruments as what they are to a host: a stream of bytes, over TCP or a pseudo-terminal."""

from __future__ import annotations

import contextlib
import os
import queue
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Protocol, Self

from drivers.emulated.faults import Fault, Faults

Write = Callable[[bytes], None]
"""Puts bytes on the wire now; raises ``OSError`` if nobody is there."""

LEAVING_PATIENCE = 0.25

WIRE_FAULTS: Mapping[str, str] = MappingProxyType(
    {
        "silent": "no reply reaches the host; commands are still obeyed",
        "slow": "every reply comes so many seconds late (default 1)",
        "unplugged": "the connection breaks and no other is accepted",
        "garbage": "replies are mixed with random bytes",
        "late": "every reply comes only when the next question is asked",
    }
)


class Unplugged(Exception):
    """The cable is out: the connection ends and no other is accepted."""


class Session(Protocol):
    """One host's connection to an instrument."""

    @property
    def watch_interval(self) -> float | None:
        """How often ``watch`` wants to be called while the host is quiet, s; ``None`` is never."""
        ...

    def receive(self, data: bytes) -> None:
        """Act on bytes from the host. Raises ``Unplugged``."""
        ...

    def watch(self) -> None:
        """Send what the instrument says unasked."""
        ...


class Instrument(Protocol):
    """Anything that can be served."""

    def connect(self, line: Line) -> Session:
        """Begin a session that answers on ``line``. Raises ``Unplugged``."""
        ...


class Line:
    """The wire back to the host: bytes leave in order, each no earlier than its delay.

    Parameters
    ----------
    write
        Puts bytes on the wire.
    fragment
        Send at most so many bytes at a time, as slow adapters do; ``None`` sends whole replies.
    """

    def __init__(self, write: Write, fragment: int | None = None) -> None:
        self._write = write
        self._fragment = fragment
        self._waiting: queue.SimpleQueue[tuple[float, bytes] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._closed = threading.Event()

    def send(self, data: bytes, delay: float = 0.0) -> None:
        """Send now, or ``delay`` seconds from now; never before what was sent earlier."""
        if delay <= 0.0 and self._thread is None:
            self._put(data)
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._send_waiting, name="delayed replies", daemon=True)
            self._thread.start()
        self._waiting.put((time.monotonic() + delay, data))

    def close(self) -> None:
        """Drop what is waiting; nothing is written afterwards, for another file may get the wire's number."""
        self._closed.set()
        self._waiting.put(None)
        if self._thread is not None:
            self._thread.join(LEAVING_PATIENCE)

    def _put(self, data: bytes) -> None:
        step = self._fragment or len(data)
        for start in range(0, len(data), step):
            self._write(data[start : start + step])
            if self._fragment:
                time.sleep(1e-4)

    def _send_waiting(self) -> None:
        while (item := self._waiting.get()) is not None:
            due, data = item
            if self._closed.wait(max(0.0, due - time.monotonic())):
                return
            # A host that has left misses its reply; the instrument does not care.
            with contextlib.suppress(OSError):
                self._put(data)


class FaultyWire:
    """What the fault script does to an instrument's wire, and which faults have just begun.

    Parameters
    ----------
    faults
        The script.
    device
        The instrument's name in it.
    latency
        Delay of every reply, s of real time.
    seed
        Chooses the random bytes.
    """

    def __init__(self, faults: Faults, device: str, latency: float, seed: int) -> None:
        self._faults = faults
        self._device = device
        self._latency = latency
        self._seed = seed
        self._held = b""
        self._spoiled = 0
        self._begun: set[str] = set()

    def fault(self, kind: str) -> Fault | None:
        """Return the active fault of this kind."""
        return self._faults.active(self._device, kind)

    def fault_begins(self, kind: str) -> Fault | None:
        """Return the fault of this kind when it has just become active."""
        fault = self.fault(kind)
        if fault is None:
            self._begun.discard(kind)
            return None
        if kind in self._begun:
            return None
        self._begun.add(kind)
        return fault

    def check_plugged(self) -> None:
        """Raise ``Unplugged`` while the cable is out."""
        if self.fault("unplugged"):
            raise Unplugged

    def deliver(self, data: bytes, line: Line) -> None:
        """Put a reply on the line as the present faults let it through. Not to be called under the plant's lock."""
        if self.fault("silent"):
            return
        if self.fault("garbage"):
            data = self._spoil(data)
        if self.fault("late"):
            self._held, data = data, self._held
        elif self._held:
            self._held, data = b"", self._held + data
        slow = self.fault("slow")
        if data:
            line.send(data, self._latency + ((slow.value or 1.0) if slow else 0.0))

    def _spoil(self, data: bytes) -> bytes:
        """Mix a reply with noise, differently every time and the same in every run."""
        self._spoiled += 1
        noise = scrambled(self._spoiled, self._seed).to_bytes(8, "little")
        mixtures = (b"\n" + noise + b"\n", noise + data, data[: len(data) // 2] + noise, noise + b"\n" + data)
        return mixtures[self._spoiled % len(mixtures)]


def scrambled(number: int, seed: int) -> int:
    """Return 64 bits that look random and depend on nothing but the arguments (splitmix64)."""
    mask = (1 << 64) - 1
    bits = (number + 0x9E3779B97F4A7C15 * (seed + 1)) & mask
    bits = ((bits ^ (bits >> 30)) * 0xBF58476D1CE4E5B9) & mask
    bits = ((bits ^ (bits >> 27)) * 0x94D049BB133111EB) & mask
    return bits ^ (bits >> 31)


class Server:
    """A running server; a context manager.

    Attributes
    ----------
    url
        What a driver connects to: ``socket://host:port`` or the path of the terminal.
    """

    def __init__(self, url: str, serve: Callable[[], None], close: Callable[[], None]) -> None:
        self.url = url
        self._close = close
        self._thread = threading.Thread(target=serve, name=f"server of {url}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving and end every session; a second call does nothing."""
        self._close()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def serve_tcp(
    instrument: Instrument,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    hosts_at_once: int = 1,
    fragment: int | None = None,
) -> Server:
    """Serve on a TCP port, to one host at a time unless told otherwise; a further one is turned away."""
    listener = socket.create_server((host, port))
    tcp = _TcpServer(instrument, listener, hosts_at_once, fragment)
    return Server(f"socket://{host}:{listener.getsockname()[1]}", tcp.serve, tcp.close)


class _TcpServer:
    def __init__(self, instrument: Instrument, listener: socket.socket, hosts: int, fragment: int | None) -> None:
        self._instrument = instrument
        self._listener = listener
        self._hosts = hosts
        self._fragment = fragment
        self._sessions: dict[threading.Thread, socket.socket] = {}
        self._closing = False

    def serve(self) -> None:
        try:
            self._accept_hosts()
        finally:
            self._listener.close()
            for thread, connection in self._sessions.items():
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
                thread.join()

    def _accept_hosts(self) -> None:
        while True:
            connection, _ = self._listener.accept()
            if self._closing:
                connection.close()
                return
            if not self._has_room():
                connection.close()
                continue
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            thread = threading.Thread(target=self._converse, args=(connection,), name="session", daemon=True)
            self._sessions[thread] = connection
            thread.start()

    def close(self) -> None:
        """Wake the serving thread with a last connection; it ends the sessions."""
        if not self._closing:
            self._closing = True
            socket.create_connection(self._listener.getsockname()).close()

    def _has_room(self) -> bool:
        """A host that reconnects at once finds its old session just ending."""
        deadline = time.monotonic() + LEAVING_PATIENCE
        while True:
            self._sessions = {thread: end for thread, end in self._sessions.items() if thread.is_alive()}
            if len(self._sessions) < self._hosts:
                return True
            if time.monotonic() >= deadline and not any(map(_has_left, self._sessions.values())):
                return False
            next(iter(self._sessions)).join(LEAVING_PATIENCE / 10)

    def _converse(self, connection: socket.socket) -> None:
        line = Line(connection.sendall, self._fragment)
        try:
            session = self._instrument.connect(line)
            while True:
                connection.settimeout(session.watch_interval)
                try:
                    data = connection.recv(4096)
                except TimeoutError:
                    session.watch()
                    continue
                if not data:
                    return
                connection.settimeout(None)
                session.receive(data)
        except (OSError, Unplugged):
            return  # The host has left, or the cable is out.
        finally:
            line.close()
            connection.close()


def _has_left(connection: socket.socket) -> bool:
    """Whether the host has hung up, though its session has yet to notice; Windows does not tell."""
    if sys.platform == "win32":
        return False
    try:
        return not connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except (BlockingIOError, TimeoutError):
        return False
    except OSError:
        return True


def serve_pty(instrument: Instrument, *, fragment: int | None = None) -> Server:
    """Serve on a pseudo-terminal (POSIX only).

    Raises
    ------
    OSError
        The system has no pseudo-terminals.
    """
    if sys.platform == "win32":
        raise OSError("pseudo-terminals need Linux or macOS; serve over TCP instead")
    import tty

    near, far = os.openpty()
    tty.setraw(far)
    pty = _PtyServer(instrument, near, far, fragment)
    return Server(os.ttyname(far), pty.serve, pty.close)


class _PtyServer:
    """Holds the far end open too, so that a host may come and go as on a serial cable."""

    def __init__(self, instrument: Instrument, near: int, far: int, fragment: int | None) -> None:
        self._instrument = instrument
        self._near = near
        self._far = far
        self._fragment = fragment
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(near, False)

    def serve(self) -> None:
        import select

        line = Line(self._write, self._fragment)
        try:
            session = self._instrument.connect(line)
            while True:
                ready, _, _ = select.select([self._near, self._wake_read], [], [], session.watch_interval)
                if self._wake_read in ready:
                    return
                if ready:
                    session.receive(os.read(self._near, 4096))
                else:
                    session.watch()
        except Unplugged:
            return
        finally:
            line.close()
            for end in (self._near, self._far, self._wake_read):
                os.close(end)

    def close(self) -> None:
        if self._wake_write >= 0:
            with contextlib.suppress(OSError):
                os.write(self._wake_write, b"\0")
            os.close(self._wake_write)
            self._wake_write = -1

    def _write(self, data: bytes) -> None:
        """What nobody reads is lost, as on a serial line."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._near, data)
