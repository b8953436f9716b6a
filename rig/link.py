"""The authenticated loopback connection between a run and the consoles that watch it.

The run serves (``LinkServer``, an observer of the loop); consoles attach (``Link``). The address and a random key lie
in a file of the user's own runtime directory, readable by that user alone; whoever cannot prove the key gets nothing
and is never listened to. A console opens three connections: one to watch, one to command, and one for the emergency
stop alone, so that it queues behind nothing.
"""

from __future__ import annotations

import contextlib
import hmac
import json
import os
import secrets
import signal
import stat
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rig.errors import RigError
from rig.observe import Controls, Ending, Event, RunInfo, StepEvent, Watcher
from rig.wire import BadMessage, Gap, Message, Samples, decode, encode, samples_of
from sequences.frame import Frame

HISTORY_BYTES = 64 << 20
"""Memory for what consoles have not yet taken, and for those that attach later."""
INBOX_FRAMES = 20_000
"""Frames the loop may be ahead of the link's thread before the oldest are dropped."""
BATCH_S = 1 / 60
"""The link gathers frames for so long before it sends them: consoles paint no faster."""
HANDSHAKE_S = 2.0
ACKNOWLEDGE_S = 0.2
"""A stop that is not acknowledged within this time makes the console kill the run."""

NAME_VARIABLE = "RIG_LINK_NAME"
"""Environment variable with the name a console gives to the run it starts, to find it again."""
DIRECTORY_VARIABLE = "RIG_RUNTIME_DIRECTORY"

_MOST_CONNECTIONS = 64
_COMMAND_BYTES = 4096


class LinkError(RigError):
    """The link to a run cannot be made or has broken."""


@dataclass(frozen=True, slots=True)
class Address:
    """Where a run serves, and the key that proves one may listen."""

    name: str
    host: str
    port: int
    key: bytes
    pid: int


# ---------------------------------------------------------------- where runs are found


def runtime_directory() -> Path:
    """Return the directory of the address files, made if need be and open to this user only.

    Raises
    ------
    LinkError
        The directory belongs to somebody else or is open to others.
    """
    told = os.environ.get(DIRECTORY_VARIABLE)
    path = Path(told) if told else _default_directory()
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    _insist_private(path)
    return path


def _default_directory() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", tempfile.gettempdir())) / "rig" / "runs"
    base = os.environ.get("XDG_RUNTIME_DIR")
    return Path(base) / "rig" if base else Path(tempfile.gettempdir()) / f"rig-{os.getuid()}"


def _insist_private(path: Path) -> None:
    if sys.platform == "win32":  # the profile directory's access list already says so
        return
    status = path.lstat()
    if status.st_uid != os.getuid() or stat.S_ISLNK(status.st_mode) or status.st_mode & 0o077:
        raise LinkError(
            f"link: {path} can be reached by other users. Remedy: remove it, or set {DIRECTORY_VARIABLE} to a "
            "directory of your own with mode 700."
        )


def running() -> list[Address]:
    """Return the runs that can be attached to, newest first."""
    files = sorted(runtime_directory().glob("*.json"), key=_age)
    return [address for address in map(_read, files) if address is not None]


def find(name: str) -> Address | None:
    """Return the run of this name, or ``None`` while it is not there."""
    return _read(runtime_directory() / f"{name}.json")


def _age(path: Path) -> float:
    try:
        return -path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _read(path: Path) -> Address | None:
    try:
        _insist_private(path)
        held = json.loads(path.read_text(encoding="utf-8"))
        return Address(path.stem, str(held["host"]), int(held["port"]), bytes.fromhex(held["key"]), int(held["pid"]))
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise LinkError(f"link: {path} is damaged ({error}). Remedy: delete it.") from error


def _publish(address: Address) -> Path:
    path = runtime_directory() / f"{address.name}.json"
    text = json.dumps({"host": address.host, "port": address.port, "key": address.key.hex(), "pid": address.pid})
    draft = path.with_suffix(".new")
    with open(os.open(draft, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "w", encoding="utf-8") as file:
        file.write(text)
    draft.replace(path)  # whoever sees the file sees all of it
    return path


def _forget(address: Address) -> None:
    """Remove the file of a run that died without doing so itself."""
    (runtime_directory() / f"{address.name}.json").unlink(missing_ok=True)


# ---------------------------------------------------------------- proof of the key


def _proof(key: bytes, role: bytes, *nonces: bytes) -> bytes:
    return hmac.digest(key, b"".join([role, *nonces]), "sha256")


def _receive(connection: Connection, length: int) -> bytes:
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
    answer = _receive(connection, 64)
    theirs, proof = answer[:32], answer[32:]
    if not hmac.compare_digest(proof, _proof(key, b"console", ours, theirs)):
        raise LinkError("link: a peer without the key was refused.")
    connection.send_bytes(_proof(key, b"run", theirs, ours))


def prove(connection: Connection, key: bytes) -> None:
    """Run the console's side of the mutual proof; the run must prove the key as well."""
    theirs = _receive(connection, 32)
    ours = secrets.token_bytes(32)
    connection.send_bytes(ours + _proof(key, b"console", theirs, ours))
    if not hmac.compare_digest(_receive(connection, 32), _proof(key, b"run", ours, theirs)):
        raise LinkError("link: the other end does not hold the key; it is not the run. Remedy: attach again.")


# ---------------------------------------------------------------- the run's side


class _Log:
    """What was sent, numbered; consoles read at their own pace. Samples are forgotten oldest first, the rest never."""

    def __init__(self, memory: int) -> None:
        self._memory = memory
        self._messages: dict[int, bytes] = {}
        self._forgettable: deque[int] = deque()
        self._held = 0
        self.begin = 0
        self.end = 0
        self.changed = threading.Condition()

    def append(self, data: bytes, *, forgettable: bool) -> None:
        with self.changed:
            self._messages[self.end] = data
            self.end += 1
            if forgettable:
                self._held += len(data)
                self._forgettable.append(self.end - 1)
                while self._held > self._memory:
                    self._held -= len(self._messages.pop(self._forgettable.popleft()))
            self.changed.notify_all()

    def restart(self) -> None:
        """Forget a run that is over: whoever attaches sees the present one."""
        with self.changed:
            self._messages.clear()
            self._forgettable.clear()
            self._held = 0
            self.begin = self.end

    def next(self, cursor: int) -> tuple[int, int, bytes | None]:
        """Return the cursor after the next message, how many were missed before it, and the message."""
        with self.changed:
            missed = 0
            cursor = max(cursor, self.begin)
            while cursor < self.end:
                data = self._messages.get(cursor)
                cursor += 1
                if data is not None:
                    return cursor, missed, data
                missed += 1
            return cursor, missed, None


class LinkServer(Watcher):
    """An observer that shows the run to every console and takes the commands of one.

    Parameters
    ----------
    controls
        What commands act on.
    name
        Name of the address file; by default what the console that started this run asked for, else the process id.
    memory
        Bytes kept for consoles that lag behind or attach later.

    On the loop's thread each call appends to a queue and returns. One thread packs what is in the queue, one thread per
    connection sends or listens; none of them can make the loop wait.
    """

    def __init__(self, controls: Controls, *, name: str | None = None, memory: int = HISTORY_BYTES) -> None:
        self._controls = controls
        self._name = name or os.environ.get(NAME_VARIABLE) or f"run-{os.getpid()}"
        self._inbox: deque[Frame | Message] = deque()
        self._arrived = threading.Event()
        self._log = _Log(memory)
        self._closing = threading.Event()
        self._packed = threading.Event()
        self._lock = threading.Lock()
        self._connections: set[Connection] = set()
        self._commander: str | None = None
        self._behind: dict[str, bool] = {}
        self.dropped = 0
        """Frames dropped because the link's own thread did not keep up."""
        runtime_directory()  # refuses before anything is open
        self._listener = Listener(("127.0.0.1", 0), backlog=_MOST_CONNECTIONS)
        host, port = self._listener.address
        self.address = Address(self._name, host, port, secrets.token_bytes(32), os.getpid())
        self._path = _publish(self.address)
        self._packer = self._start(self._pack)
        self._acceptor = self._start(self._accept)

    # -- on the loop's thread

    def started(self, info: RunInfo) -> None:
        """Queue the run's description."""
        self._put(info)

    def frame(self, frame: Frame) -> None:
        """Queue a frame; drop the oldest when the queue is full."""
        if len(self._inbox) >= INBOX_FRAMES:
            self._inbox.popleft()
            self.dropped += 1
        self._put(frame)

    def step(self, event: StepEvent) -> None:
        """Queue a step event."""
        self._put(event)

    def event(self, event: Event) -> None:
        """Queue a line of the log."""
        self._put(event)

    def prediction(self, prediction: Any) -> None:
        """Queue a live prediction."""
        self._put(prediction)

    def finished(self, ending: Ending) -> None:
        """Queue how the run ended."""
        self._put(ending)

    def _put(self, item: Frame | Message) -> None:
        self._inbox.append(item)
        self._arrived.set()

    # -- life

    @property
    def watchers(self) -> int:
        """How many consoles have not yet hung up."""
        return len(self._behind)

    def close(self, drain_s: float = 1.0) -> None:
        """Give consoles up to ``drain_s`` to take the rest, then hang up. A frozen console cannot delay it longer."""
        self._closing.set()
        self._arrived.set()
        self._packer.join()
        deadline = time.monotonic() + drain_s
        with self._log.changed:
            self._log.changed.notify_all()
            while any(self._behind.values()) and (left := deadline - time.monotonic()) > 0:
                self._log.changed.wait(min(left, 0.05))
        self._path.unlink(missing_ok=True)
        self._wake_acceptor()
        self._acceptor.join()
        with self._lock:
            for connection in self._connections:
                _hang_up(connection)

    def _wake_acceptor(self) -> None:
        with contextlib.suppress(OSError):
            Client((self.address.host, self.address.port)).close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @staticmethod
    def _start(work: Any, *arguments: Any) -> threading.Thread:
        thread = threading.Thread(target=work, args=arguments, daemon=True, name=f"link {work.__name__.strip('_')}")
        thread.start()
        return thread

    # -- packing

    def _pack(self) -> None:
        while True:
            self._arrived.wait()
            self._arrived.clear()
            over = self._closing.is_set()
            self._pack_queue()
            if over:
                return
            self._closing.wait(BATCH_S)

    def _pack_queue(self) -> None:
        frames: list[Frame] = []
        for _ in range(len(self._inbox)):
            try:
                item = self._inbox.popleft()
            except IndexError:  # the loop dropped it meanwhile
                break
            if isinstance(item, Frame):
                if frames and item.start != frames[-1].stop:
                    self._send_frames(frames)
                frames.append(item)
                continue
            self._send_frames(frames)
            if isinstance(item, RunInfo):
                self._log.restart()
            self._log.append(encode(item), forgettable=False)
        self._send_frames(frames)

    def _send_frames(self, frames: list[Frame]) -> None:
        if frames:
            self._log.append(encode(samples_of(frames)), forgettable=True)
            frames.clear()

    # -- consoles

    def _accept(self) -> None:
        with self._listener as listener:
            while True:
                connection = listener.accept()
                with self._lock:
                    refused = self._closing.is_set() or len(self._connections) >= _MOST_CONNECTIONS
                    if not refused:
                        self._connections.add(connection)
                if refused:
                    connection.close()
                else:
                    self._start(self._serve, connection)
                if self._closing.is_set():
                    return

    def _serve(self, connection: Connection) -> None:
        try:
            admit(connection, self.address.key)
            hello = json.loads(_receive_text(connection))
            role, who = str(hello["role"]), str(hello["who"])
            if role == "watch":
                self._show(connection, who)
            else:
                self._listen(connection, who)
        except (LinkError, EOFError, OSError, ValueError, KeyError, TypeError):
            pass  # a peer that left or was never one of ours: the run goes on without it
        finally:
            with self._lock:
                self._connections.discard(connection)
            connection.close()

    def _show(self, connection: Connection, who: str) -> None:
        cursor = self._log.begin
        log = self._log
        self._behind[who] = True
        try:
            while True:
                cursor, missed, data = log.next(cursor)
                if missed:
                    connection.send_bytes(encode(Gap(missed)))
                if data is not None:
                    connection.send_bytes(data)
                    continue
                with log.changed:
                    if cursor >= log.end:
                        self._behind[who] = False
                        log.changed.notify_all()
                        if self._closing.is_set() and not self._packer.is_alive():
                            return
                        log.changed.wait(0.5)
                        self._behind[who] = True
        finally:
            self._behind.pop(who, None)

    def _listen(self, connection: Connection, who: str) -> None:
        try:
            while True:
                command = _receive_text(connection)
                connection.send_bytes(json.dumps(self._obey(command, who)).encode())
        finally:
            with self._lock:
                if self._commander == who:
                    self._commander = None

    def _obey(self, command: str, who: str) -> dict[str, Any]:
        if command == "emergency stop":  # anybody who watches may stop the rig
            self._controls.emergency_stop()
            return {"done": True, "text": ""}
        actions = {
            "claim": lambda: None,
            "hold": self._controls.hold,
            "resume": self._controls.resume,
            "stop": self._controls.stop,
        }
        if command not in actions:
            return {"done": False, "text": f"unknown command {command!r}"}
        with self._lock:
            if self._commander not in (None, who):
                return {"done": False, "text": "another console commands this run; this one may watch"}
            self._commander = who
        actions[command]()
        return {"done": True, "text": ""}


def _receive_text(connection: Connection) -> str:
    return connection.recv_bytes(_COMMAND_BYTES).decode()


def _hang_up(connection: Connection) -> None:
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


# ---------------------------------------------------------------- the console's side


@dataclass(frozen=True, slots=True)
class Answer:
    """What the run said to a command: whether it was done, why not, and how long the answer took (s)."""

    done: bool
    text: str
    delay_s: float


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
        self._command = self._open("command")
        self._emergency = self._open("emergency")
        self._one_command = threading.Lock()
        self._over = threading.Event()
        self.killed = False
        """Whether this console had to kill the run."""
        threading.Thread(target=self._read, daemon=True, name="link read").start()

    def _open(self, role: str) -> Connection:
        try:
            connection = Client((self.address.host, self.address.port))
        except OSError as error:
            _forget(self.address)
            raise LinkError(
                f"link: run {self.address.name} cannot be reached ({error}). Remedy: is it over?"
            ) from error
        try:
            prove(connection, self.address.key)
            connection.send_bytes(json.dumps({"role": role, "who": self._who}).encode())
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
        with self._one_command:
            limit = ACKNOWLEDGE_S if command == "stop" else within_s
            answer = self._exchange(self._command, command, limit)
        if answer is None and command == "stop":
            return self._kill("stop")
        return answer or Answer(False, "the run did not answer; the emergency stop still works", limit)

    def send_emergency_stop(self) -> float:
        """Put the emergency stop on the wire from the calling thread; return when that was (``time.monotonic``)."""
        try:
            self._emergency.send_bytes(b"emergency stop")
        except OSError:
            return time.monotonic()  # hung up: there is nothing left to stop
        return time.monotonic()

    def confirm_emergency_stop(self, sent: float) -> Answer:
        """Wait for the acknowledgement of ``send_emergency_stop``; kill the run when it does not come in time."""
        answer = self._answer(self._emergency, sent, ACKNOWLEDGE_S)
        return answer or self._kill("emergency stop")

    def emergency_stop(self) -> Answer:
        """Send the emergency stop and wait for its acknowledgement."""
        return self.confirm_emergency_stop(self.send_emergency_stop())

    def close(self) -> None:
        """Detach; the run goes on."""
        for connection in (self._watch, self._command, self._emergency):
            _hang_up(connection)
        self._over.wait(1.0)
        for connection in (self._watch, self._command, self._emergency):
            connection.close()

    def _exchange(self, connection: Connection, command: str, limit: float) -> Answer | None:
        sent = time.monotonic()
        try:
            connection.send_bytes(command.encode())
        except OSError:
            return Answer(False, "the run is over", 0.0)
        return self._answer(connection, sent, limit)

    def _answer(self, connection: Connection, sent: float, limit: float) -> Answer | None:
        """Wait in the kernel, so that a busy interpreter cannot make a prompt answer look late."""
        try:
            if not connection.poll(limit):
                return None
            reply = json.loads(connection.recv_bytes(_COMMAND_BYTES))
        except (EOFError, OSError):
            return Answer(False, "the run is over", time.monotonic() - sent)
        return Answer(bool(reply["done"]), str(reply["text"]), time.monotonic() - sent)

    def _kill(self, what: str) -> Answer:
        """End the run's process: it is alive (the connection stands) but silent. The dead man stops the rest."""
        self.killed = True
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.address.pid, getattr(signal, "SIGKILL", signal.SIGTERM))
        return Answer(
            False, f"{what} not acknowledged within {ACKNOWLEDGE_S * 1e3:.0f} ms: the run was killed", ACKNOWLEDGE_S
        )


__all__ = ["Address", "Answer", "Gap", "Link", "LinkError", "LinkServer", "Samples", "find", "running"]
