"""Our gateway beneath pipython's GCS message layer: TCP, serial devices and pseudo-terminals.

pipython's own gateways take a late reply for the answer of the next question, miss a closed connection, spin while
they wait and offer no way past their lock. ``GCSMessages`` needs only the methods below, so it is used unmodified.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from typing import Protocol
from urllib.parse import urlsplit

CODE_PAGE = "cp1252"
CONNECT_TIMEOUT = 2.0
URGENT_PATIENCE = 0.02
DRAIN_READS = 1000
"""A device that babbles without end must not be listened to without end."""


class Port(Protocol):
    """A stream of bytes that tells at once when its far end is gone."""

    def write(self, data: bytes) -> None:
        """Send everything, or raise ``OSError``."""
        ...

    def read(self, timeout: float) -> bytes:
        """Wait at most ``timeout`` seconds for bytes; empty if none came. ``OSError`` if the far end is gone."""
        ...

    def drain(self) -> None:
        """Throw away what has been received."""
        ...

    def close(self) -> None:
        """Release the port."""
        ...


class _TcpPort:
    """A TCP connection."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), timeout=CONNECT_TIMEOUT)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def write(self, data: bytes) -> None:
        self._socket.sendall(data)

    def read(self, timeout: float) -> bytes:
        self._socket.settimeout(timeout)
        try:
            data = self._socket.recv(4096)
        except (TimeoutError, BlockingIOError):
            return b""
        if not data:
            raise ConnectionResetError("the far end has closed the connection")
        return data

    def drain(self) -> None:
        self._socket.setblocking(False)
        try:
            for _ in range(DRAIN_READS):
                if not self._socket.recv(4096):
                    raise ConnectionResetError("the far end has closed the connection")
        except BlockingIOError:
            pass
        finally:
            self._socket.settimeout(CONNECT_TIMEOUT)

    def close(self) -> None:
        self._socket.close()


class _SerialPort:
    """A serial device or pseudo-terminal, opened for this program alone."""

    SLICE = 0.05

    def __init__(self, name: str, baud: int) -> None:
        import serial

        self._port = serial.Serial(name, baud, timeout=self.SLICE, write_timeout=CONNECT_TIMEOUT, exclusive=True)

    def write(self, data: bytes) -> None:
        self._port.write(data)

    def read(self, timeout: float) -> bytes:
        deadline = time.monotonic() + timeout
        while True:
            data: bytes = self._port.read(max(1, self._port.in_waiting))
            if data or time.monotonic() >= deadline:
                return data

    def drain(self) -> None:
        # Not reset_input_buffer: on a lost terminal that raises termios.error, which is no OSError.
        for _ in range(DRAIN_READS):
            if not (waiting := self._port.in_waiting):
                return
            self._port.read(waiting)

    def close(self) -> None:
        self._port.close()


def open_port(connection: str, baud: int) -> Port:
    """Open ``socket://host:port`` or a serial device.

    Raises
    ------
    OSError
        It cannot be opened (``serial.SerialException`` is one).
    ValueError
        The name is malformed.
    """
    if "://" not in connection:
        return _SerialPort(connection, baud)
    address = urlsplit(connection)
    if address.scheme != "socket" or not address.hostname or address.port is None:
        raise ValueError(f"{connection!r} is neither socket://host:port nor a serial device")
    return _TcpPort(address.hostname, address.port)


class Gateway:
    """What ``GCSMessages`` talks through.

    The time to answer runs from the last ``send``, so that a reply dribbling in cannot stretch it.

    Parameters
    ----------
    connection
        ``socket://host:port`` or the name of a serial device.
    baud
        Baud rate of a serial device.
    timeout
        Longest wait for an answer, s.
    """

    connectionid = 0

    def __init__(self, connection: str, baud: int, timeout: float) -> None:
        self.connection = connection
        self._timeout = timeout
        self._deadline = 0.0
        self._writing = threading.Lock()
        self._port = open_port(connection, baud)
        self.connected = True

    def __str__(self) -> str:
        return f"Gateway({self.connection})"

    @property
    def timeout(self) -> int:
        """Longest wait for an answer, ms."""
        return round(self._timeout * 1e3)

    def settimeout(self, value: int) -> None:
        """Set the longest wait for an answer, ms."""
        self._timeout = value / 1e3

    def send(self, message: str) -> None:
        """Throw away what nobody asked for, then send."""
        self._port.drain()
        data = message.encode(CODE_PAGE)
        with self._writing:
            self._port.write(data)
        self._deadline = time.monotonic() + self._timeout

    def send_urgent(self, data: bytes) -> None:
        """Send past every lock and queue; from any thread.

        The write lock only keeps two writes from mixing; it is held for microseconds, and not waited for in vain.
        """
        locked = self._writing.acquire(timeout=URGENT_PATIENCE)
        try:
            self._port.write(data)
        finally:
            if locked:
                self._writing.release()

    def read(self) -> str:
        """Return what has come, waiting for it until the answer is overdue.

        Raises
        ------
        TimeoutError
            The answer is overdue.
        OSError
            The far end is gone.
        """
        data = self._port.read(max(0.0, self._deadline - time.monotonic()))
        if not data:
            raise TimeoutError(f"no complete reply within {self._timeout:g} s")
        if time.monotonic() > self._deadline + self._timeout:
            raise TimeoutError(f"reply still incomplete {2 * self._timeout:g} s after the question")
        return data.decode(CODE_PAGE, errors="replace")

    def flush(self) -> None:
        """Throw away what has been received."""
        self._port.drain()

    def close(self) -> None:
        """Release the port; closing twice does no harm."""
        if self.connected:
            self.connected = False
            with contextlib.suppress(OSError):
                self._port.close()
