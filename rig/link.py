"""The authenticated loopback connection between a run and the consoles that watch it.

The run serves (``rig.link_server``, an observer of the loop); consoles attach (``Link``). The address and a random
key lie in a file that only the user can read (``rig.link_address``); whoever cannot prove the key (``rig.link_proof``)
gets nothing and is never listened to. A console opens three connections: one to watch, one to command, and one for the
emergency stop alone, so that it queues behind nothing.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import signal
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Client, Connection
from typing import Any

from rig.link_address import Address, LinkError, forget
from rig.link_proof import READY, TEXT_BYTES, hang_up, prove, receive
from rig.observe import Event
from rig.wire import BadMessage, Message, decode

ACKNOWLEDGE_S = 0.2
"""A stop that is not acknowledged within this time makes the console kill the run."""

OVER = "the run is over"
"""The answer where the run has hung up: its next test, if it has one, did not hear the command."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What the run said to a command: whether it was done, why not, and how long the answer took (s)."""

    done: bool
    text: str
    delay_s: float


@dataclass(frozen=True, slots=True)
class Asked:
    """Which command on its connection, and when it was sent (``time.monotonic``)."""

    number: int
    sent: float


class _Asking:
    """A connection for commands; safe from any thread.

    Answers come in the order of the commands, those that nobody waits for any more included, so they are counted.
    """

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self._sending, self._receiving = threading.Lock(), threading.Lock()
        self._asked = self._answered = 0
        self._answers: dict[int, Any] = {}

    def ask(self, command: str) -> Asked:
        """Put a command on the wire; it never waits for an answer to another."""
        with self._sending:
            self._asked += 1
            with contextlib.suppress(OSError):  # hung up: ``answer`` says so
                self.connection.send_bytes(command.encode())
            return Asked(self._asked, time.monotonic())

    def answer(self, asked: Asked, limit: float) -> Answer | None:
        """Wait for the answer to a command in the kernel: a busy interpreter cannot make a prompt one look late."""
        try:
            with self._receiving:
                deadline = time.monotonic() + limit
                while self._answered < asked.number:
                    if not self.connection.poll(max(0.0, deadline - time.monotonic())):
                        return None
                    self._answered += 1
                    self._answers[self._answered] = json.loads(self.connection.recv_bytes(TEXT_BYTES))
                reply = self._answers.pop(asked.number)
        except (EOFError, OSError):
            return Answer(False, OVER, time.monotonic() - asked.sent)
        return Answer(bool(reply["done"]), str(reply["text"]), time.monotonic() - asked.sent)


class Link:
    """A console's attachment to one run.

    Messages are received by a thread of its own; ``take`` returns what has come. Attaching to a run that has already
    begun yields its past first.

    Raises
    ------
    LinkError
        The run is not there or does not hold the key.
    """

    def __init__(self, address: Address) -> None:
        self.address = address
        self._who = secrets.token_hex(8)
        self._inbox: deque[Message] = deque()
        self._watch = self._open("watch")
        self._command = _Asking(self._open("command"))
        self._emergency = _Asking(self._open("emergency"))
        self._over = threading.Event()
        self.killed = False
        """Whether this console had to kill the run."""
        threading.Thread(target=self._read, daemon=True, name="link read").start()

    def _open(self, role: str) -> Connection:
        try:
            connection = Client((self.address.host, self.address.port))
        except OSError as error:
            forget(self.address)
            raise LinkError(
                f"link: run {self.address.name} cannot be reached ({error}). Remedy: is it over?"
            ) from error
        try:
            prove(connection, self.address.key)
            connection.send_bytes(json.dumps({"role": role, "who": self._who}).encode())
            receive(connection, len(READY))
        except (EOFError, OSError) as error:
            connection.close()
            raise LinkError(f"link: run {self.address.name} hung up ({error}). Remedy: attach again.") from error
        return connection

    def _read(self) -> None:
        try:
            while True:
                self._inbox.append(decode(self._watch.recv_bytes()))
        except (EOFError, OSError):
            pass  # the run has hung up; ``over`` says so
        except BadMessage as error:
            self._inbox.append(Event(0, "fault", str(error)))
        finally:
            self._over.set()

    @property
    def over(self) -> bool:
        """Whether the run has hung up and everything it sent has been taken."""
        return self._over.is_set() and not self._inbox

    def take(self, most: int = 1000) -> Iterator[Message]:
        """Yield up to ``most`` messages that have come, oldest first."""
        for _ in range(min(most, len(self._inbox))):
            yield self._inbox.popleft()

    def command(self, command: str, within_s: float = 1.0) -> Answer:
        """Send ``claim``, ``hold``, ``resume`` or ``stop`` and wait for the answer. Not for the window's own thread.

        A ``stop`` without an answer within ``ACKNOWLEDGE_S`` kills the run.
        """
        limit = ACKNOWLEDGE_S if command == "stop" else within_s
        answer = self._command.answer(self._command.ask(command), limit)
        if answer is None and command == "stop":
            return self._kill("stop")
        return answer or Answer(False, "the run did not answer; the emergency stop still works", limit)

    def send_emergency_stop(self) -> Asked:
        """Put the emergency stop on the wire from the calling thread."""
        return self._emergency.ask("emergency stop")

    def confirm_emergency_stop(self, asked: Asked) -> Answer:
        """Wait for the acknowledgement of ``send_emergency_stop``; kill the run when it does not come in time."""
        return self._emergency.answer(asked, ACKNOWLEDGE_S) or self._kill("emergency stop")

    def emergency_stop(self) -> Answer:
        """Send the emergency stop and wait for its acknowledgement."""
        return self.confirm_emergency_stop(self.send_emergency_stop())

    def close(self) -> None:
        """Detach; the run goes on."""
        connections = (self._watch, self._command.connection, self._emergency.connection)
        for connection in connections:
            hang_up(connection)
        self._over.wait(1.0)
        for connection in connections:
            connection.close()

    def _kill(self, what: str) -> Answer:
        """End the run's process: it is alive (the connection stands) but silent. The dead man stops the rest."""
        self.killed = True
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.address.pid, getattr(signal, "SIGKILL", signal.SIGTERM))
        return Answer(
            False, f"{what} not acknowledged within {ACKNOWLEDGE_S * 1e3:.0f} ms: the run was killed", ACKNOWLEDGE_S
        )
