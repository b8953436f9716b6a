"""A scripted instrument: it expects certain bytes and gives certain replies, like the tables of a manual."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator, Sequence

Exchange = tuple[bytes, bytes]


@contextlib.contextmanager
def dialogue(exchanges: Sequence[Exchange]) -> Iterator[str]:
    """Serve one dialogue on TCP and yield its address; fail unless exactly these bytes came, and in this order."""
    listener = socket.create_server(("127.0.0.1", 0))
    listener.settimeout(60)
    heard: list[bytes] = []

    def converse() -> None:
        connection, _ = listener.accept()
        with connection:
            connection.settimeout(60)
            for expected, reply in exchanges:
                heard.append(receive(connection, len(expected)))
                if heard[-1] != expected:
                    return
                connection.sendall(reply)
            heard.append(receive(connection, 1))

    thread = threading.Thread(target=converse)
    thread.start()
    try:
        yield f"socket://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        thread.join()
        listener.close()
        expected = [*(sent for sent, _ in exchanges), b""]
        assert heard == expected, f"heard {heard}, expected {expected}"


def receive(connection: socket.socket, size: int) -> bytes:
    """Read so many bytes, or what there is before the host falls silent or leaves."""
    data = b""
    with contextlib.suppress(TimeoutError, ConnectionError):
        while len(data) < size and (more := connection.recv(size - len(data))):
            data += more
    return data


@contextlib.contextmanager
def flood(data: bytes) -> Iterator[str]:
    """Serve a device that sends the same bytes for ever and listens to nothing; yield its address."""
    listener = socket.create_server(("127.0.0.1", 0))

    def babble() -> None:
        connection, _ = listener.accept()
        with connection, contextlib.suppress(OSError):
            while True:
                connection.sendall(data)

    thread = threading.Thread(target=babble)
    thread.start()
    try:
        yield f"socket://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        thread.join()
        listener.close()
