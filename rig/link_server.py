"""The run's side of the link: it shows itself to every console and takes the commands of one."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import threading
import time
from collections import deque
from multiprocessing.connection import Client, Connection, Listener
from types import TracebackType
from typing import Any, Self

from drivers.errors import DeviceError
from rig.link_address import Address, LinkError, address_file, publish
from rig.link_proof import READY, admit, hang_up, receive_text
from rig.observe import Controls, Ending, Event, Observer, RunInfo, StepEvent, StepPhase
from rig.wire import Gap, Message, encode, samples_of
from sequences.frame import Frame

HISTORY_BYTES = 64 << 20
"""Memory for what consoles have not yet taken, and for those that attach later."""
INBOX_FRAMES = 20_000
"""Frames the loop may be ahead of the link's thread before the oldest are dropped."""
BATCH_S = 1 / 60
"""The link gathers frames for so long before it sends them: consoles paint no faster."""

DRAIN_S = 5.0
"""What consoles get to attach and to take the rest when a run is over."""

NAME_VARIABLE = "RIG_LINK_NAME"
"""Environment variable with the name a console gives to the run it starts, to find it again."""

_MOST_CONNECTIONS = 64


class _Log:
    """What was sent, numbered; consoles read at their own pace. Samples and progress are forgotten oldest first."""

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


class LinkServer(Observer):
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
        self._awaited = name is None and NAME_VARIABLE in os.environ
        self._attached = threading.Event()
        self._name = name or os.environ.get(NAME_VARIABLE) or f"run-{os.getpid()}"
        self._inbox: deque[Frame | Message] = deque()
        self._arrived = threading.Event()
        self._log = _Log(memory)
        self._closing = threading.Event()
        self._packed = threading.Event()
        self._lock = threading.Lock()
        self._connections: set[Connection] = set()
        self._commander: str | None = None
        self._cursors: dict[str, int] = {}
        """How far in the log each console has got; changed under the log's condition."""
        self.dropped = 0
        """Frames dropped because the link's own thread did not keep up."""
        address_file(self._name)  # refuses before anything is open
        self._listener = Listener(("127.0.0.1", 0), backlog=_MOST_CONNECTIONS)
        host, port = self._listener.address
        self.address = Address(self._name, host, port, secrets.token_bytes(32), os.getpid())
        self._path = publish(self.address)
        self._packer = self._start(self._pack)
        self._acceptor = self._start(self._accept)

    # -- on the loop's thread

    def started(self, info: RunInfo) -> None:
        """Queue the run's description."""
        self._put(info)

    def frame(self, frame: Frame) -> None:
        """Queue a frame; drop the oldest when the queue is full."""
        if len(self._inbox) >= INBOX_FRAMES:
            with contextlib.suppress(IndexError):  # the packer may have taken all of them meanwhile
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

    def close(self, drain_s: float = DRAIN_S) -> None:
        """Give consoles up to ``drain_s`` to take the rest, then hang up. A frozen console cannot delay it longer.

        The console that has started this run is waited for as long, should the run be over before it could attach.
        """
        if self._awaited:
            self._attached.wait(drain_s)
        self._closing.set()
        self._arrived.set()
        self._packer.join()
        deadline = time.monotonic() + drain_s
        with self._log.changed:
            self._log.changed.notify_all()
            while self._somebody_is_behind() and (left := deadline - time.monotonic()) > 0:
                self._log.changed.wait(min(left, 0.05))
        with contextlib.suppress(PermissionError):  # on Windows, while a console reads it, which then forgets it
            self._path.unlink(missing_ok=True)
        self._wake_acceptor()
        self._acceptor.join()
        with self._lock:
            for connection in self._connections:
                hang_up(connection)

    def _somebody_is_behind(self) -> bool:
        return any(cursor < self._log.end for cursor in self._cursors.values())

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
            self._log.append(encode(item), forgettable=isinstance(item, StepEvent) and item.phase is StepPhase.PROGRESS)
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
            hello = json.loads(receive_text(connection))
            role, who = str(hello["role"]), str(hello["who"])
            if role == "watch":
                self._show(connection, who)
            else:
                self._listen(connection, who, last=role == "emergency")
        except (LinkError, EOFError, OSError, ValueError, KeyError, TypeError):
            pass  # a peer that left or was never one of ours: the run goes on without it
        finally:
            with self._lock:
                self._connections.discard(connection)
            connection.close()

    def _show(self, connection: Connection, who: str) -> None:
        log = self._log
        cursor = self._note(who, log.begin)
        try:
            connection.send_bytes(READY)
            while True:
                cursor, missed, data = log.next(cursor)
                if missed:
                    connection.send_bytes(encode(Gap(missed)))
                if data is not None:
                    connection.send_bytes(data)
                self._note(who, cursor)
                with log.changed:
                    if cursor >= log.end:
                        if self._closing.is_set() and not self._packer.is_alive():
                            return
                        log.changed.wait(0.5)
        finally:
            with log.changed:
                self._cursors.pop(who, None)

    def _note(self, who: str, cursor: int) -> int:
        with self._log.changed:
            self._cursors[who] = cursor
            if cursor >= self._log.end:
                self._log.changed.notify_all()
        return cursor

    def _listen(self, connection: Connection, who: str, *, last: bool) -> None:
        """Take commands; ``last`` says that this is the last of the console's connections to be made."""
        connection.send_bytes(READY)
        if last:
            self._attached.set()
        try:
            while True:
                command = receive_text(connection)
                connection.send_bytes(json.dumps(self._obey(command, who)).encode())
        finally:
            with self._lock:
                if self._commander == who:
                    self._commander = None

    def _obey(self, command: str, who: str) -> dict[str, Any]:
        if command == "emergency stop":  # anybody who watches may stop the rig
            try:
                self._controls.emergency_stop()
            except DeviceError as error:  # the run ends all the same
                return {"done": False, "text": str(error)}
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
