"""What both ends of the link share: the mutual proof of the key, short texts, and hanging up."""

from __future__ import annotations

import contextlib
import hmac
import os
import secrets
import sys
from multiprocessing.connection import Connection

from rig.link_address import LinkError

HANDSHAKE_S = 2.0
TEXT_BYTES = 4096
READY = b"ready"
"""The run's word that a connection is known: a console that has heard it thrice will be told all."""


def _proof(key: bytes, role: bytes, *nonces: bytes) -> bytes:
    return hmac.digest(key, b"".join([role, *nonces]), "sha256")


def receive(connection: Connection, length: int) -> bytes:
    """Return so many bytes of the handshake.

    Raises
    ------
    LinkError
        They do not come in time, or others come.
    """
    if not connection.poll(HANDSHAKE_S):
        raise LinkError("link: the other end is silent. Remedy: check that it is a run of this program.")
    data = connection.recv_bytes(length)
    if len(data) != length:
        raise LinkError("link: the other end does not speak this protocol. Remedy: check the address.")
    return data


def admit(connection: Connection, key: bytes) -> None:
    """Run the server's side of the mutual proof.

    Raises
    ------
    LinkError
        The peer does not hold the key.
    """
    ours = secrets.token_bytes(32)
    connection.send_bytes(ours)
    answer = receive(connection, 64)
    theirs, proof = answer[:32], answer[32:]
    if not hmac.compare_digest(proof, _proof(key, b"console", ours, theirs)):
        raise LinkError("link: a peer without the key was refused.")
    connection.send_bytes(_proof(key, b"run", theirs, ours))


def prove(connection: Connection, key: bytes) -> None:
    """Run the console's side of the mutual proof; the run must prove the key as well."""
    theirs = receive(connection, 32)
    ours = secrets.token_bytes(32)
    connection.send_bytes(ours + _proof(key, b"console", theirs, ours))
    if not hmac.compare_digest(receive(connection, 32), _proof(key, b"run", ours, theirs)):
        raise LinkError("link: the other end does not hold the key; it is not the run. Remedy: attach again.")


def receive_text(connection: Connection) -> str:
    """Return a command, an answer or a greeting."""
    return connection.recv_bytes(TEXT_BYTES).decode()


def hang_up(connection: Connection) -> None:
    """Shut a connection that another thread may be blocked on."""
    import socket

    if connection.closed:
        return
    with contextlib.suppress(OSError):
        if sys.platform == "win32":
            connection.close()
        else:
            with socket.socket(fileno=os.dup(connection.fileno())) as twin:
                twin.shutdown(socket.SHUT_RDWR)
