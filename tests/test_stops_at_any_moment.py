"""A stop that comes between any two lines, from a signal handler or another thread: it is neither lost nor late."""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from conftest import SHORT, scene_text
from motion_world import MotionWorld

from drivers.emulated.direct import DirectStage
from drivers.emulated.server import serve_tcp
from drivers.emulated.stage import EmulatedController
from drivers.errors import MotionFault
from drivers.stage import PIStage
from rig.campaign import JOURNAL
from rig.cli import main
from rig.commands import campaign as campaign_command
from rig.observe import Controls, Observer, StepPhase, Wish
from rig.recorder import Recorder
from rig.recording import load_recording
from rig.session import run_scene

PATIENCE_S = 200.0


def interrupted(action: Callable[[], Any], handler: Callable[[], Any], line: int, *files: str) -> bool:
    """Run an action and, before its line number so-and-so in these files, a handler on the same thread, as signals do.

    Return whether there was such a line. Whoever waits for itself is found out: the action has a thread of its own.
    """
    passed = 0
    failures: list[BaseException] = []

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal passed
        if not frame.f_code.co_filename.endswith(files):
            return trace if event == "call" else None
        if event == "line":
            passed += 1
            if passed == line:
                handler()
        return trace

    def act() -> None:
        before = sys.gettrace()  # a measurement of coverage
        sys.settrace(trace)
        try:
            action()
        except BaseException as error:  # noqa: BLE001 - handed on to the test
            failures.append(error)
        finally:
            sys.settrace(before)

    thread = threading.Thread(target=act, daemon=True)
    thread.start()
    thread.join(PATIENCE_S)
    assert not thread.is_alive(), f"waits for itself when interrupted before line {line}"
    if failures:
        raise failures[0]
    return passed >= line


@pytest.mark.parametrize("asked", ["hold", "resume", "stop", "emergency_stop", "take"])
def test_a_stop_between_any_two_lines_of_the_controls_is_kept(asked: str) -> None:
    def kept(line: int) -> bool:
        """Return whether there is such a line; assert that the stop was taken, or still can be."""
        controls = Controls()
        controls.hold()
        taken: list[Wish | None] = []

        def act() -> None:
            taken.append(getattr(controls, asked)())

        within = interrupted(act, controls.emergency_stop, line, "rig/observe.py")
        assert not within or Wish.EMERGENCY in (*taken, controls.take())
        return within

    assert kept(1)
    assert not all(kept(line) for line in range(2, 100))


@pytest.mark.parametrize("asked", ["stop", "emergency_stop", "move_to", "status"])
def test_an_emergency_stop_between_any_two_lines_of_the_driver_is_sent(asked: str) -> None:
    controller = EmulatedController(MotionWorld(), referenced=True)
    with serve_tcp(controller) as server:
        stage = PIStage(server.url, reply_timeout=60.0)
        arguments = (stage.status().position,) if asked == "move_to" else ()
        line = 0
        within = True
        while within:
            line += 1
            before = controller.received["#24"]
            try:
                within = interrupted(
                    lambda: getattr(stage, asked)(*arguments), stage.emergency_stop, line,
                    "drivers/stage.py", "drivers/gateway.py", "threading.py",
                )  # fmt: skip
            except MotionFault as error:
                assert "the emergency stop was pressed" in str(error)
            stage.stop()
            assert not within or controller.received["#24"] > before
        assert line > 3
        stage.close()


@pytest.mark.parametrize(
    ("command", "step"),
    [
        ("stop", "preload"),
        ("stop", "pull-off"),
        ("set_speed", "preload"),
        ("move_to", "approach"),
        ("move_to", "return"),
    ],
)
def test_nothing_moves_after_an_emergency_stop(
    request_for: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, command: str, step: str
) -> None:
    """The stop with which a step ends acknowledges an emergency stop to the driver: the next step must not go on."""
    controls = Controls()
    begun: list[str] = []
    after: list[str] = []

    class Steps(Observer):
        def step(self, event: Any) -> None:
            if event.phase is StepPhase.STARTED:
                begun.append(event.name)

    def pressing(name: str) -> Callable[..., None]:
        real = getattr(DirectStage, name)

        def call(stage: DirectStage, *arguments: float) -> None:
            if controls.emergency:
                after.append(name)
            elif name == command and begun[-1:] == [step]:
                controls.emergency_stop()
            real(stage, *arguments)

        return call

    for name in ("stop", "move_to", "set_speed"):
        monkeypatch.setattr(DirectStage, name, pressing(name))
    request = request_for(controls=controls, observers=[Steps()])
    ending = run_scene(request)
    assert controls.emergency
    assert set(after) == {"stop"}
    assert (ending.exit_code, ending.reason[:14]) == (130, "emergency stop")
    recorded = load_recording(request.out).ending
    assert recorded is not None
    assert recorded[1] == ending.exit_code


def test_signals_that_come_while_the_stop_is_being_sent_do_not_pile_up(
    request_for: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A terminal that hangs, and its user, send many; each would wait for the port that the one before it holds."""
    sent: list[int] = []
    within = 0

    def send(stage: DirectStage) -> None:
        nonlocal within
        within += 1
        sent.append(within)
        if len(sent) < 10:
            signal.raise_signal(signal.SIGINT)
        within -= 1

    class Hasty(Observer):
        def step(self, event: Any) -> None:
            if event.name == "approach" and not sent:
                signal.raise_signal(signal.SIGINT)
                signal.raise_signal(signal.SIGTERM)
                signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(DirectStage, "emergency_stop", send)
    assert run_scene(request_for(observers=[Hasty()])).exit_code == 130
    assert sent == [1, 1]  # the next signal after it sends it again


@pytest.fixture
def ctrl_c_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    close = Recorder.close

    def pressed(recorder: Recorder) -> None:
        signal.raise_signal(signal.SIGINT)
        close(recorder)

    monkeypatch.setattr(Recorder, "close", pressed)


@pytest.mark.usefixtures("ctrl_c_at_the_end")
def test_ctrl_c_while_a_recording_is_closed_begins_no_further_test(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "short.toml"
    scene.write_text(scene_text("sphere-60mm-vented", **SHORT), encoding="utf-8")
    command = ["run", str(scene), "--direct", "--no-live", "--no-picture", "--out"]
    assert main([*command, str(tmp_path / "one.h5")]) == 0
    assert main([*command, str(tmp_path / "r.h5"), "--repeat", "2"]) == 130
    assert "stopped by the operator before short-2" in capsys.readouterr().err
    assert [path.name for path in tmp_path.glob("r*.h5")] == ["r-short-1.h5"]


@pytest.fixture
def three_tests(tmp_path: Path) -> Path:
    (tmp_path / "zero.toml").write_text(scene_text("pressure-zero", rest_s=0.5), "utf-8")
    path = tmp_path / "small.toml"
    path.write_text('title = "small"\nrepeats = 30\n[[test]]\nscene = "zero.toml"\n', "utf-8")
    return path


@pytest.mark.usefixtures("ctrl_c_at_the_end")
def test_ctrl_c_while_a_recording_is_closed_ends_a_campaign(three_tests: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    assert main(["campaign", str(three_tests), "--direct", "--out", str(folder)]) == 130
    entries = [json.loads(line) for line in (folder / JOURNAL).read_text("utf-8").splitlines()]
    assert [entry["recording"] for entry in entries] == [path.name for path in folder.glob("*.h5")]
    assert len(entries) == 1


def test_a_failure_in_a_campaign_on_several_processes_begins_no_further_test(
    three_tests: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from concurrent import futures

    begun: list[str] = []

    class Pool(futures.ThreadPoolExecutor):
        def __init__(self, workers: int, mp_context: Any) -> None:
            super().__init__(workers)

    def fake(test: Any, *_: Any) -> tuple[str, int, str, bool]:
        begun.append(test.key)
        if len(begun) > 1:
            time.sleep(1.5)
        return f"{test.key}.h5", 4, "broken", False

    monkeypatch.setattr(futures, "ProcessPoolExecutor", Pool)
    monkeypatch.setattr(campaign_command, "_run_one", fake)
    assert main(["campaign", str(three_tests), "--jobs", "2", "--out", str(tmp_path / "out")]) == 4
    assert len(begun) < 10


@pytest.mark.timeout(300)
def test_ctrl_c_ends_the_emulator_whatever_it_is_doing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The handler runs while the waiting thread holds whatever it waits with."""
    wait, sleep = threading.Condition.wait, time.sleep

    def press() -> None:
        if threading.current_thread() is threading.main_thread():
            signal.raise_signal(signal.SIGINT)

    def waiting(condition: threading.Condition, timeout: float | None = None) -> bool:
        press()
        return wait(condition, timeout)

    def sleeping(seconds: float) -> None:
        press()
        sleep(seconds)

    before = [(number, signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)]
    monkeypatch.setattr(threading.Condition, "wait", waiting)
    monkeypatch.setattr(time, "sleep", sleeping)
    try:
        assert main(["emulate"]) == 0
    finally:
        for number, handler in before:
            signal.signal(number, handler)
