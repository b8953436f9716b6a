"""The real program from its command line: the window on a virtual screen, a real run, the mouse and the keyboard."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig.bench import load_bench
from rig.link import Link
from rig.link_address import DIRECTORY_VARIABLE, LinkError, running
from rig.observe import Ending, Event, RunInfo, StepEvent, StepPhase
from rig.recording import load_recording
from rig.wire import Samples

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="X and SIGSTOP are POSIX")

PATIENT = "import sys, rig.cli, rig.link; rig.link.ACKNOWLEDGE_S = 60.0; sys.exit(rig.cli.main(sys.argv[1:]))"
"""A console that does not kill a run which a busy computer keeps from answering."""

SCENE = """
title = "end to end"
[substrate]
shape = "sphere"
diameter_mm = 60.0
[protocol]
preload_N = 0.3
approach_speed_um_s = 12.0
retract_speed_um_s = 100.0
preload_dwell_s = 1.0
tare_s = 0.5
"""


def wait_for(condition: Callable[[], object], what: str) -> None:
    """Wait as long as the test may last; its time-out bounds it."""
    for _ in range(25_000):
        if condition():
            return
        time.sleep(0.02)
    raise AssertionError(f"never: {what}")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(DIRECTORY_VARIABLE, str(tmp_path / "runtime"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    _, bench = load_bench(None)
    patient = bench.replace("[limits]", "[limits]\nlag_s = 4.0")  # a busy machine is no fault of this test
    patient = patient.replace("[stage]", "[stage]\nreply_timeout_ms = 5000.0")
    patient = patient.replace("start_mm = 22.0", "start_mm = 20.1\nleft_on = true")
    (tmp_path / "bench.toml").write_text(patient)
    return tmp_path


@pytest.fixture
def screen() -> Iterator[dict[str, str]]:
    """A virtual screen of its own; where there is no Xvfb, Qt's offscreen one."""
    if shutil.which("Xvfb") is None or shutil.which("xdotool") is None:
        yield {"QT_QPA_PLATFORM": "offscreen"}
        return
    reading, writing = os.pipe()
    command = ["Xvfb", "-displayfd", str(writing), "-screen", "0", "1600x1000x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, pass_fds=[writing], stderr=subprocess.DEVNULL) as server:
        os.close(writing)
        with os.fdopen(reading) as answer:
            number = answer.readline().strip()
        yield {"DISPLAY": f":{number}", "QT_QPA_PLATFORM": "xcb"}
        server.terminate()


@pytest.fixture
def window(place: Path, screen: dict[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    """``rig console scene.toml``, shown."""
    words = [sys.executable, "-c", PATIENT, "console", "scene.toml", "--bench", "bench.toml", "--alone"]
    with subprocess.Popen(words, env=os.environ | screen, stderr=subprocess.DEVNULL) as console:
        yield console
        if console.poll() is None:
            console.kill()


class Hand:
    """The operator's mouse and keyboard."""

    def __init__(self, screen: dict[str, str]) -> None:
        self._environment = os.environ | screen

    def _tool(self, *words: str) -> str:
        done = subprocess.run(["xdotool", *words], env=self._environment, capture_output=True, text=True, check=False)
        return done.stdout.strip()

    def window(self) -> str:
        wait_for(lambda: self._tool("search", "--onlyvisible", "--name", "rig console"), "a window")
        return self._tool("search", "--onlyvisible", "--name", "rig console").splitlines()[0]

    def press(self, key: str) -> None:
        self._tool("windowfocus", self.window())
        self._tool("key", key)

    def click(self, x: int, y: int) -> None:
        self._tool("mousemove", "--window", self.window(), str(x), str(y), "click", "1")

    def size(self) -> tuple[int, int]:
        found = dict(
            line.split("=")
            for line in self._tool("getwindowgeometry", "--shell", self.window()).splitlines()
            if "=" in line
        )
        return int(found["WIDTH"]), int(found["HEIGHT"])


def attached() -> Link:
    """Watch the run that is going, once there is one."""
    found: list[Link] = []

    def look() -> bool:
        for address in running():
            try:
                found.append(Link(address))
            except LinkError:
                continue
        return bool(found)

    wait_for(look, "a run to attach to")
    return found[0]


def told(link: Link, kind: type, count: int = 1) -> list[object]:
    """Take messages until ``count`` of a kind have come; return all of them."""
    got: list[object] = []

    def enough() -> bool:
        got.extend(link.take())
        if sum(isinstance(message, kind) for message in got) >= count:
            return True
        endings = [message for message in got if isinstance(message, Ending)]
        assert not endings, f"the run has ended before {count} {kind.__name__}: {endings}"
        return False

    wait_for(enough, f"{count} {kind.__name__}")
    return got


@pytest.mark.skipif(shutil.which("xdotool") is None, reason="no mouse and keyboard without xdotool")
def test_start_hold_resume_and_emergency_stop_with_mouse_and_keyboard(
    window: subprocess.Popen[bytes], screen: dict[str, str], place: Path
) -> None:
    hand = Hand(screen)
    hand.window()
    wait_for(lambda: (hand.press("F5"), time.sleep(0.3), running())[2], "F5 starts the run")
    watcher = attached()
    got = told(watcher, Samples, 5)
    assert any(isinstance(message, RunInfo) for message in got)
    wait_for(
        lambda: (
            hand.press("F6"),
            got.extend(watcher.take()),
            any(isinstance(m, Event) and m.text == "hold" for m in got),
        )[2],
        "F6 holds",
    )
    wait_for(
        lambda: (
            hand.press("F7"),
            got.extend(watcher.take()),
            any(isinstance(m, Event) and m.text == "resume" for m in got),
        )[2],
        "F7 resumes",
    )
    width, _ = hand.size()
    wait_for(
        lambda: (
            hand.click(width - 150, 42),  # the large red button, top right
            got.extend(watcher.take()),
            isinstance(got[-1], Ending),
        )[2],
        "the emergency stop ends the run",
    )
    ending = got[-1]
    assert isinstance(ending, Ending)
    assert "emergency stop" in ending.reason
    watcher.close()
    (path,) = (place / "recordings").glob("*.h5")
    recording = load_recording(path)
    assert recording.force.size == ending.samples
    assert window.poll() is None  # the window stays, with what has happened on it


def test_a_run_outlives_what_happens_to_its_consoles(place: Path) -> None:
    """One of three consoles is frozen, one killed, one closed: the run goes on to its end, its recording complete."""
    words = [sys.executable, "-m", "rig", "run", "scene.toml", "--bench", "bench.toml", "--direct", "--no-live"]
    words += ["--no-picture", "--link", "--speed", "3", "--out", "watched.h5"]
    environment = os.environ | {"QT_QPA_PLATFORM": "offscreen"}
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with contextlib.ExitStack() as started:

        def start(words: list[str], **options: Any) -> subprocess.Popen[bytes]:
            process = started.enter_context(subprocess.Popen(words, **quiet, **options))
            started.callback(process.kill)
            return process

        run = start(words)
        watcher = attached()
        consoles = [start([sys.executable, "-c", WATCHING], env=environment) for _ in range(3)]
        wait_for(lambda: len(list(place.glob("watching-*"))) == 3, "three consoles that show the run")
        for console, harm in zip(consoles, (signal.SIGSTOP, signal.SIGKILL, signal.SIGTERM), strict=True):
            os.kill(console.pid, harm)
        got = told(watcher, Ending)
        ending = next(message for message in got if isinstance(message, Ending))
        assert (ending.reason, ending.exit_code) == ("done", 0)
        assert run.wait() == 0
        watcher.close()
    names = [m.name for m in got if isinstance(m, StepEvent) and m.phase is StepPhase.ENDED and m.outcome == "done"]
    assert "pull-off" in names
    recording = load_recording(place / "watched.h5")
    assert recording.force.size == ending.samples
    assert np.isfinite(recording.force).all()


WATCHING = """
import os, time
from pathlib import Path
from PySide6.QtWidgets import QApplication
from rig.console.window import Console
application = QApplication([])
window = Console(["sphere-60mm-low"])
window.show()
window.attach_newest()
while window.story is None or window.story.end == 0:
    application.processEvents()
    time.sleep(0.01)
Path(f"watching-{os.getpid()}").touch()
application.exec()
"""


def test_replay_in_the_window(place: Path) -> None:
    """A recorded run comes back through the loop into the console's own process."""
    words = [sys.executable, "-m", "rig", "run", "scene.toml", "--direct", "--no-picture", "--out", "one.h5"]
    words += ["--bench", "bench.toml"]
    subprocess.run(words, check=True, capture_output=True)
    script = Path(__file__).with_name("replay_script.py")
    done = subprocess.run(
        [sys.executable, str(script), "one.h5"],
        env=os.environ | {"QT_QPA_PLATFORM": "offscreen"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["loaded", "paused", "stepped", "jumped", "played", "left"]
