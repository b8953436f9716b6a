"""The link between a run and its consoles: proof of the key, order, loss, commands, frozen and killed consoles."""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import signal
import stat
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Client, Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.errors import NotConnected
from drivers.interfaces import PumpState, PumpStatus, StageStatus
from rig import link_address as addresses
from rig import link_server, wire
from rig.link import Answer, Link
from rig.link_address import Address, LinkError
from rig.link_proof import receive_text
from rig.link_server import LinkServer
from rig.live_prediction import Estimate, LivePrediction
from rig.observe import Controls, Ending, Event, RunInfo, StepEvent, StepPhase, StepPlan, Wish
from sequences.frame import Frame

SAMPLES = 20


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    directory = tmp_path / "runtime"
    monkeypatch.setenv(addresses.DIRECTORY_VARIABLE, str(directory))
    return directory


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy computer is no fault; least of all may a console kill its run for it, which here is the tests' process."""
    monkeypatch.setattr("rig.link.ACKNOWLEDGE_S", 60.0)
    monkeypatch.setattr("rig.link_proof.HANDSHAKE_S", 60.0)
    monkeypatch.setattr(Link.command, "__defaults__", (60.0,))
    monkeypatch.setattr(LinkServer.close, "__defaults__", (60.0,))


def run_info(**changes: Any) -> RunInfo:
    plan = (StepPlan("tare", "2 s of samples"), StepPlan("retract", "pull-off"))
    info = RunInfo(
        "a title", "pull_off", "run.h5", os.getpid(), 1000.0, SAMPLES, True, plan,
        {"force_compression_N": 1.5}, {"protocol": {"preload_N": 0.5}}, {"stage": "PI"}, False,
    )  # fmt: skip
    return dataclasses.replace(info, **changes)


def frame(number: int, *, pressure: bool = True) -> Frame:
    stage = StageStatus(number * 0.02, number * 0.02, 1e-3 + number * 1e-7, True, False, True, False, False)
    pump = PumpStatus(0.0, 0.0, PumpState.WITHDRAWING, -1e-9, -2e-7) if pressure else None
    force = np.arange(number * SAMPLES, (number + 1) * SAMPLES, dtype=np.float64)
    return Frame(
        number, number * SAMPLES, 1000.0, np.zeros((2, SAMPLES)), force, -force if pressure else None, stage, pump
    )


def prediction() -> LivePrediction:
    x = np.linspace(0.0, 1e-3, 5)
    one = Estimate(1.0, 0.9, float("inf"))
    curve = (x, -x, -x - 1, -x + 1, None, None, None)
    return LivePrediction(7, 160, "cone", *curve, one, one, one, one, 2e-3, True, "", 0.5, {"F": 1e-9}, 0.01)


def wait_for(condition: Any, what: str) -> None:
    """Poll without asserting how long it takes; the test's own time-out bounds it."""
    for _ in range(40_000):
        if condition():
            return
        time.sleep(0.005)
    raise AssertionError(f"never: {what}")


def take_until(link: Link, kind: type[Any]) -> list[Any]:
    got: list[Any] = []
    wait_for(lambda: (got.extend(link.take()), any(isinstance(m, kind) for m in got))[1], f"a {kind.__name__}")
    return got


MESSAGES = [
    run_info(),
    wire.samples_of([frame(3), frame(4)]),
    wire.samples_of([frame(0, pressure=False)]),
    StepEvent(StepPhase.PROGRESS, "preload", 40, "", 0.31, 0.5, "N"),
    Event(3, "fault", "stage: no reply – \u00b5m"),
    prediction(),
    Ending("done", 0, 400, {"pull_off_force_N": {"value": 0.8}}),
    wire.Gap(3),
]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_every_message_arrives_as_it_was_sent(message: Any) -> None:
    received = wire.decode(wire.encode(message))
    assert type(received) is type(message)
    for field in dataclasses.fields(message):
        sent, got = getattr(message, field.name), getattr(received, field.name)
        np.testing.assert_equal(got, sent, err_msg=field.name)
        assert type(got) is type(sent), field.name


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\x01", b"\xff\xff\xff\xff{}", pickle.dumps(os.getcwd),
        b"\x02\x00\x00\x00{}", wire.encode(Event(1, "note", "x"))[:-3],
        wire.encode(Event(1, "note", "x")).replace(b'"note"', b'1234.5'),
        wire.encode(wire.Gap(3)).replace(b'"gap"', b'"os."'),
        wire.encode(MESSAGES[1])[:-1],
        wire.encode(MESSAGES[1]).replace(b'"<f8"', b'"|O8"'),
    ],
)  # fmt: skip
def test_what_is_no_message_is_refused(data: bytes) -> None:
    with pytest.raises(wire.BadMessage, match="Remedy"):
        wire.decode(data)


def test_a_console_sees_the_run_in_order_and_complete() -> None:
    with LinkServer(Controls()) as server:
        server.started(run_info())
        link = Link(server.address)
        for number in range(200):
            server.frame(frame(number))
        server.event(Event(4000, "note", "half-way"))
        for number in range(200, 300):
            server.frame(frame(number))
        server.finished(Ending("done", 0, 6000))
        got = take_until(link, Ending)
        link.close()
    assert isinstance(got[0], RunInfo)
    force = np.concatenate([message.force for message in got if isinstance(message, wire.Samples)])
    np.testing.assert_array_equal(force, np.arange(6000.0))
    place = next(index for index, message in enumerate(got) if isinstance(message, Event))
    assert sum(message.force.size for message in got[:place] if isinstance(message, wire.Samples)) == 4000


def test_who_attaches_late_sees_the_past_and_several_may_watch() -> None:
    with LinkServer(Controls()) as server:
        server.started(run_info())
        first = Link(server.address)
        for number in range(50):
            server.frame(frame(number))
        server.step(StepEvent(StepPhase.STARTED, "retract", 1000))
        take_until(first, StepEvent)
        (address,) = addresses.running()
        second = Link(address)
        got = take_until(second, StepEvent)
        assert isinstance(got[0], RunInfo)
        assert sum(message.force.size for message in got if isinstance(message, wire.Samples)) == 1000
        first.close()
        second.close()
    assert addresses.running() == []


def test_a_second_run_of_the_same_process_replaces_the_first() -> None:
    with LinkServer(Controls()) as server:
        server.started(run_info(repeat=1))
        server.frame(frame(0))
        server.finished(Ending("done", 0, 20))
        server.started(run_info(repeat=2))
        server.frame(frame(0))
        first = Link(server.address)
        got = take_until(first, wire.Samples)
        assert [message.repeat for message in got if isinstance(message, RunInfo)][-1] == 2
        first.close()


def test_one_commands_and_the_others_may_still_stop_in_an_emergency() -> None:
    controls = Controls()
    stopped: list[str] = []
    controls.connect(lambda: stopped.append(threading.current_thread().name))
    with LinkServer(controls) as server:
        server.started(run_info())
        first, second = Link(server.address), Link(server.address)
        assert first.command("hold").done
        assert controls.take() is Wish.HOLD
        refused = second.command("resume")
        assert not refused.done
        assert "another console" in refused.text
        assert controls.take() is Wish.NONE
        assert second.emergency_stop().done
        assert stopped == ["link serve"]
        assert controls.take() is Wish.EMERGENCY
        first.close()
        wait_for(lambda: second.command("claim").done, "the second console gets the word when the first has gone")
        assert not second.command("explode").done
        second.close()


def test_nobody_without_the_key_is_listened_to(runtime: Path) -> None:
    controls = Controls()
    with LinkServer(controls) as server:
        server.started(run_info())
        wrong = Address("x", server.address.host, server.address.port, b"\0" * 32, os.getpid())
        with pytest.raises(LinkError):
            Link(wrong)
        raw = Client((server.address.host, server.address.port))  # never answers the challenge with a proof
        raw.recv_bytes()
        raw.send_bytes(pickle.dumps({"role": "emergency", "who": "x"}))
        raw.close()
        silent = Client((server.address.host, server.address.port))
        honest = Link(server.address)
        take_until(honest, RunInfo)
        assert controls.take() is Wish.NONE
        silent.close()
        honest.close()


def test_a_server_without_the_key_is_not_believed() -> None:
    from multiprocessing.connection import Listener

    with Listener(("127.0.0.1", 0)) as listener:

        def impostor() -> None:
            connection = listener.accept()
            connection.send_bytes(b"\0" * 32)
            connection.recv_bytes()
            connection.send_bytes(b"\0" * 32)
            connection.close()

        thread = threading.Thread(target=impostor)
        thread.start()
        host, port = listener.address
        with pytest.raises(LinkError, match="not the run"):
            Link(Address("x", host, port, b"k" * 32, os.getpid()))
        thread.join()


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX modes; Windows profiles are private by their access list")
def test_the_address_file_is_the_users_alone(runtime: Path) -> None:
    with LinkServer(Controls()) as server:
        (path,) = runtime.glob("*.json")
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(runtime.stat().st_mode) == 0o700
        assert json.loads(path.read_text())["port"] == server.address.port
        path.chmod(0o644)
        with pytest.raises(LinkError, match="other users"):
            addresses.running()
    runtime.chmod(0o755)
    with pytest.raises(LinkError, match="other users"):
        LinkServer(Controls())


def test_a_damaged_address_file_is_named(runtime: Path) -> None:
    runtime.mkdir(mode=0o700)
    path = runtime / "run-1.json"
    path.write_text("{")
    path.chmod(0o600)
    with pytest.raises(LinkError, match=r"run-1\.json is damaged"):
        addresses.running()


@pytest.mark.parametrize("slow", ["nothing", "the greeting", "_show", "_listen"])
def test_a_run_that_is_over_at_once_waits_for_the_console_that_started_it(
    slow: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slowly(work: Callable[..., Any]) -> Callable[..., Any]:
        def late(*arguments: Any, **more: Any) -> Any:
            time.sleep(0.3)
            return work(*arguments, **more)

        return late

    if slow == "the greeting":
        monkeypatch.setattr(link_server, "receive_text", slowly(receive_text))
    elif slow != "nothing":
        monkeypatch.setattr(LinkServer, slow, slowly(getattr(LinkServer, slow)))
    monkeypatch.setenv(link_server.NAME_VARIABLE, "console-1")
    server = LinkServer(Controls())
    server.started(run_info())
    server.finished(Ending("done", 0, 0))
    closing = threading.Thread(target=server.close)
    closing.start()
    time.sleep(0.3)
    address = addresses.find("console-1")
    assert address is not None
    link = Link(address)
    assert take_until(link, Ending)
    closing.join()
    assert addresses.running() == []
    link.close()


def test_a_console_that_has_yet_to_wake_up_gets_the_last_message(monkeypatch: pytest.MonkeyPatch) -> None:
    class Drowsy(threading.Condition):
        def wait(self, timeout: float | None = None) -> bool:
            woken = super().wait(timeout)
            if threading.current_thread().name == "link serve":
                self.release()
                time.sleep(0.05)
                self.acquire()
            return woken

    with monkeypatch.context() as patched:
        patched.setattr(threading, "Condition", Drowsy)
        server = LinkServer(Controls())
    link = Link(server.address)
    server.started(run_info())
    take_until(link, RunInfo)
    time.sleep(0.2)  # the console has everything and sleeps
    server.finished(Ending("done", 0, 0))
    server.close()
    assert take_until(link, Ending)
    link.close()


def test_a_run_has_a_plain_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(link_server.NAME_VARIABLE, "../elsewhere")
    with pytest.raises(LinkError, match="no name for a run"):
        LinkServer(Controls())


def test_an_emergency_stop_that_does_not_reach_the_stage_is_told_to_the_console() -> None:
    def unplugged() -> None:
        raise NotConnected("stage", "the stop could not be sent", "check the cable")

    controls = Controls()
    controls.connect(unplugged)
    with LinkServer(controls) as server:
        link = Link(server.address)
        answer = link.emergency_stop()
        assert not answer.done
        assert "the stop could not be sent" in answer.text
        assert not link.killed
        assert controls.take() is Wish.EMERGENCY
        link.close()


def test_memory_for_a_console_that_lags_is_bounded_and_the_loss_is_told() -> None:
    log = link_server._Log(1000)
    log.append(b"run", forgettable=False)
    for number in range(100):
        log.append(bytes([number]) * 100, forgettable=True)
    log.append(b"end", forgettable=False)
    cursor, got, missed = 0, [], 0
    while True:
        cursor, lost, data = log.next(cursor)
        missed += lost
        if data is None:
            break
        got.append(data)
    assert got[0] == b"run"
    assert got[-1] == b"end"
    assert [data[0] for data in got[1:-1]] == list(range(90, 100))
    assert missed == 90


def test_the_loops_queue_is_bounded_and_drops_the_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_server, "INBOX_FRAMES", 10)
    monkeypatch.setattr(LinkServer, "_pack", lambda self: self._closing.wait())
    with LinkServer(Controls()) as server:
        for number in range(25):
            server.frame(frame(number))
        assert server.dropped == 15
        assert [held.number for held in server._inbox] == list(range(15, 25))


CONSOLE = """
import sys, time
from rig.link import Answer, Link
from rig.link_address import running
link = Link(running()[0])
link.command("claim")
while not list(link.take()):
    time.sleep(0.01)
print("attached", flush=True)
time.sleep(600)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGSTOP to freeze a process")
@pytest.mark.parametrize("harm", [signal.SIGSTOP, signal.SIGKILL], ids=["frozen", "killed"])
def test_a_frozen_or_killed_console_takes_nothing_from_the_run(harm: signal.Signals) -> None:
    with LinkServer(Controls(), memory=200_000) as server:
        server.started(run_info())
        with subprocess.Popen([sys.executable, "-c", CONSOLE], stdout=subprocess.PIPE, text=True) as console:
            assert console.stdout is not None
            assert console.stdout.readline() == "attached\n"
            os.kill(console.pid, harm)
            for number in range(30_000):  # far more than any socket buffer holds
                server.frame(frame(number))
                if number % 5000 == 0:
                    wait_for(lambda: len(server._inbox) < 5000, "the link keeps up")
            healthy = Link(server.address)
            server.finished(Ending("done", 0, 600_000))
            assert take_until(healthy, Ending)
            assert server.dropped == 0
            assert server._log._held <= 200_000
            healthy.close()
            server.close(drain_s=0.1)
            console.kill()


def test_a_late_answer_is_not_taken_for_that_of_a_later_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    late, never = threading.Event(), threading.Event()

    class Slow(Controls):
        def hold(self) -> None:
            late.wait()

        def stop(self) -> None:
            never.wait()

    killed: list[str] = []
    monkeypatch.setattr("rig.link.ACKNOWLEDGE_S", 0.2)
    monkeypatch.setattr(Link, "_kill", lambda link, what: killed.append(what) or Answer(False, "killed", 0.2))
    with LinkServer(Slow()) as server:
        link = Link(server.address)
        assert not link.command("hold", within_s=0.01).done
        late.set()
        time.sleep(0.2)  # the answer to the hold has come by now
        assert not link.command("stop").done
        assert killed == ["stop"]
        never.set()
        link.close()


def test_two_emergency_stops_at_once_are_both_acknowledged(monkeypatch: pytest.MonkeyPatch) -> None:
    receive = Connection._recv  # type: ignore[attr-defined]

    def slowly(connection: Connection, *arguments: Any) -> Any:
        received = receive(connection, *arguments)
        time.sleep(0.02)  # between the length of a message and its text
        return received

    pressed: list[str] = []
    controls = Controls()
    controls.connect(lambda: pressed.append("now"))
    with LinkServer(controls) as server:
        link = Link(server.address)
        monkeypatch.setattr(Connection, "_recv", slowly)
        answers: list[Answer] = []
        asked = [link.send_emergency_stop(), link.send_emergency_stop()]
        waiting = [
            threading.Thread(target=lambda one=one: answers.append(link.confirm_emergency_stop(one)), daemon=True)
            for one in reversed(asked)
        ]
        for thread in waiting:
            thread.start()
        for thread in waiting:
            thread.join(200)
        assert [answer.done for answer in answers] == [True, True]
        assert pressed == ["now", "now"]
        link.close()


def test_a_frame_is_queued_although_the_packer_has_emptied_a_full_queue_meanwhile() -> None:
    class Emptied(deque[Any]):
        def __len__(self) -> int:
            return link_server.INBOX_FRAMES

    with LinkServer(Controls()) as server:
        server._inbox = Emptied()
        server.frame(frame(0))
        assert server.dropped == 0
        server._inbox = deque()


def test_a_console_that_comes_too_late_does_not_hide_the_next_run_of_that_name() -> None:
    with LinkServer(Controls(), name="console-1") as server:
        over = server.address
    with LinkServer(Controls(), name="console-1") as server:
        with pytest.raises(LinkError, match="cannot be reached"):
            Link(over)
        assert addresses.find("console-1") == server.address


def test_what_a_killed_process_of_the_same_number_has_left_is_overwritten(runtime: Path) -> None:
    runtime.mkdir(mode=0o700)
    draft = runtime / f"run-{os.getpid()}.new"
    draft.write_text("{", encoding="utf-8")
    draft.chmod(0o600)
    with LinkServer(Controls()) as server:
        assert addresses.running() == [server.address]


def test_a_console_that_is_just_reading_the_address_does_not_fail_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def held_open(path: Path, *, missing_ok: bool = False) -> None:
        raise PermissionError(13, "used by another process", str(path))

    server = LinkServer(Controls())
    link = Link(server.address)
    monkeypatch.setattr(Path, "unlink", held_open)  # as on Windows
    server.close()
    wait_for(lambda: link.over, "the run hangs up")
    link.close()


RUN = """
import sys, time
from rig.link_server import LinkServer
from rig.observe import Controls

class Hung(Controls):
    def emergency_stop(self): time.sleep(600)
    def stop(self): time.sleep(600)

server = LinkServer(Hung())
print("serving", flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("command", ["stop", "emergency stop"])
def test_a_stop_that_is_not_acknowledged_kills_the_run(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.link.ACKNOWLEDGE_S", 0.2)
    with subprocess.Popen([sys.executable, "-c", RUN], stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        assert run.stdout.readline() == "serving\n"
        link = Link(addresses.running()[0])
        answer = link.emergency_stop() if command == "emergency stop" else link.command("stop")
        assert link.killed
        assert "killed" in answer.text
        assert run.wait() != 0
        wait_for(lambda: link.over, "the link notices")
        assert not link.emergency_stop().done  # and nobody else is killed
        link.close()
    with pytest.raises(LinkError, match="cannot be reached"):
        Link(addresses.running()[0])
    assert addresses.running() == []
