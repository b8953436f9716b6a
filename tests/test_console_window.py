"""The real window, offscreen: start, hold, resume, stop, emergency stop, replay, export, bad scene."""

from __future__ import annotations

import csv
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

import numpy as np
import publisher
import pytest
from PySide6.QtCore import Qt
from PySide6.QtGui import QImage
from PySide6.QtWidgets import QApplication, QMessageBox
from pytestqt.qtbot import QtBot

from rig.console.app import NoWindow, open_console
from rig.console.panels import step_words
from rig.console.runner import Child, replay_arguments, run_arguments
from rig.console.theme import THEMES
from rig.console.window import Console
from rig.library import find, shipped
from rig.link import Answer, Link
from rig.link_address import DIRECTORY_VARIABLE
from rig.link_server import LinkServer
from rig.observe import Controls, Event, Wish

WAIT_MS = 200_000
"""A busy computer is no fault; the test's own time-out bounds it."""


UNHURRIED = 0.2
"""Times real time: the run lasts for minutes, so that no console comes too late to do something to it."""


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DIRECTORY_VARIABLE, str(tmp_path / "runtime"))
    monkeypatch.chdir(tmp_path)
    # Whatever a busy computer delays: the console would kill its run, which here is the tests' process.
    monkeypatch.setattr("rig.link.ACKNOWLEDGE_S", 60.0)
    monkeypatch.setattr("rig.link_proof.HANDSHAKE_S", 60.0)
    monkeypatch.setattr(Link.command, "__defaults__", (60.0,))


@pytest.fixture
def console(qtbot: QtBot) -> Iterator[Console]:
    window = Console(["sphere-60mm-low", *shipped("scene")])
    qtbot.addWidget(window)
    window.resize(1600, 1000)
    window.show()
    qtbot.waitExposed(window)
    yield window
    window.close()


class Published:
    """A synthetic run on a thread of the test, and what the console asked of it."""

    def __init__(self, *, speed: float = 40.0, pressure: bool = True, fault_at: int | None = None) -> None:
        self.controls = Controls()
        self.stopped_at: list[float] = []
        self.controls.connect(lambda: self.stopped_at.append(time.monotonic()))
        self.server = LinkServer(self.controls)
        self.ended: Wish | None = None
        self._arguments = (speed, pressure, fault_at)
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def _publish(self) -> None:
        speed, pressure, fault_at = self._arguments
        self.ended = publisher.publish(self.server, self.controls, speed, pressure=pressure, fault_at=fault_at)

    def close(self) -> None:
        self.controls.stop()
        self._thread.join()
        self.server.close()


@pytest.fixture
def publish() -> Iterator[Callable[..., Published]]:
    made: list[Published] = []

    def make(**options: Any) -> Published:
        made.append(Published(**options))
        return made[-1]

    yield make
    for published in made:
        published.close()


def attach(console: Console, qtbot: QtBot) -> None:
    console.attach_newest()
    qtbot.waitUntil(lambda: console.story is not None and console.story.end > 0, timeout=WAIT_MS)


def test_idle_shows_the_scene_its_check_and_what_the_model_expects(console: Console) -> None:
    assert console.state.text() == "checked: ready"
    assert "load cell" in console.log.toPlainText()
    assert "syringe" in console.log.toPlainText()
    assert console.force_path.model.xData.size > 50
    assert console.prediction.force.text().startswith("F<sub>p</sub> 0.830")
    assert "numerical error" in console.status_model.text()
    assert not console.emergency.isEnabled()


def test_a_scene_without_pressure_shows_no_pressure(console: Console, qtbot: QtBot) -> None:
    console.controls.scene.setCurrentText("sphere-60mm-vented")
    assert not console.pressure_time.widget.isVisible()
    assert not console.pressure_path.widget.isVisible()
    assert not console.pump.isVisible()
    assert not console.readings.pressure.isVisible()
    console.controls.scene.setCurrentText("sphere-60mm-low")
    assert console.pressure_time.widget.isVisible()
    assert console.readings.pressure.isVisible()


def test_a_bench_is_chosen_by_the_name_of_one_that_ships(console: Console) -> None:
    console.controls.scene.setCurrentText("fiber")
    assert console.state.text() == "refused"
    console.controls.add_bench(Path("emulated-gso25"))
    assert console.state.text() == "checked: ready"
    console.controls.add_bench(Path("none.toml"))
    assert console.state.text() == "refused"
    assert "bench none.toml: no such file" in console.banner.text()


def test_a_bad_scene_is_refused_with_key_value_and_remedy(console: Console, tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text('[substrate]\nshape = "sphere"\ndiameter_mm = -5.0\n')
    console.controls.add_file(bad)
    assert console.state.text() == "refused"
    assert "diameter_mm = -5.0" in console.banner.text()
    assert console.banner.isVisible()
    assert not console.controls.run.isEnabled()
    heavy = tmp_path / "heavy.toml"
    heavy.write_text('[substrate]\nshape = "flat"\n[protocol]\npreload_N = 40.0\ninitial_pressure_kPa = -1.0\n')
    console.controls.add_file(heavy)
    assert "preload_N = 40" in console.banner.text()
    assert "\u2715" in console.log.toPlainText()
    assert not console.controls.run.isEnabled()
    console.controls.scene.setCurrentIndex(0)
    assert not console.banner.isVisible()
    assert console.controls.run.isEnabled()


def test_a_run_is_followed_to_its_end(console: Console, qtbot: QtBot, publish: Callable[..., Published]) -> None:
    published = publish(speed=30.0)
    attach(console, qtbot)
    qtbot.waitUntil(lambda: console.state.text() == "done", timeout=WAIT_MS)
    story = console.story
    assert story is not None
    assert story.missed == 0
    assert story.end == 39_000
    assert step_words(story.at(8000)).startswith("preload 0.")
    assert step_words(story.at(8000)).endswith(" of 0.50 N")
    assert "measured" in console.prediction.measured.text()
    assert "inside the band" in console.prediction.note.text()
    assert "[" in console.prediction.distance.text()
    assert console.force_path.band.path().elementCount() > 10
    qtbot.waitUntil(lambda: console.link is None or not console.link.over, timeout=WAIT_MS)
    assert published.ended is Wish.NONE


def test_hold_resume_and_stop_with_keys(console: Console, qtbot: QtBot, publish: Callable[..., Published]) -> None:
    published = publish(speed=UNHURRIED)
    attach(console, qtbot)
    qtbot.mouseClick(console.controls.hold, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: console.state.text() == "holding", timeout=WAIT_MS)
    assert console.controls.resume.isEnabled()
    assert not console.controls.hold.isEnabled()
    qtbot.keyClick(console, Qt.Key.Key_F7)
    qtbot.waitUntil(lambda: console.state.text() == "running", timeout=WAIT_MS)
    qtbot.keyClick(console, Qt.Key.Key_F8)
    qtbot.waitUntil(lambda: console.state.text() == "stopped", timeout=WAIT_MS)
    assert published.ended is Wish.STOP
    assert "Stop by the operator" in console.banner.text()


def test_a_prompt_is_shown_and_answered(console: Console, qtbot: QtBot, publish: Callable[..., Published]) -> None:
    published = publish(speed=UNHURRIED)
    attach(console, qtbot)
    published.controls.hold()
    qtbot.waitUntil(lambda: console.state.text() == "holding", timeout=WAIT_MS)
    published.server.event(Event(0, "prompt", "hang 20 g on the load cell"))
    qtbot.waitUntil(lambda: "hang 20 g" in console.words.text(), timeout=WAIT_MS)
    qtbot.waitUntil(console.controls.resume.isEnabled, timeout=WAIT_MS)
    qtbot.mouseClick(console.controls.resume, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: console.state.text() == "running", timeout=WAIT_MS)


@pytest.mark.parametrize("how", ["key", "mouse", "key in a dialog"])
def test_emergency_stop(console: Console, qtbot: QtBot, publish: Callable[..., Published], how: str) -> None:
    published = publish(speed=UNHURRIED)
    attach(console, qtbot)
    if how == "mouse":
        qtbot.mousePress(console.emergency, Qt.MouseButton.LeftButton)  # on the way down
    elif how == "key":
        qtbot.keyPress(console.log, Qt.Key.Key_Escape)  # wherever the focus is
    else:
        dialog = QMessageBox(console)
        dialog.setModal(True)
        dialog.show()
        qtbot.waitExposed(dialog)
        qtbot.keyPress(dialog, Qt.Key.Key_Escape)
        assert dialog.isVisible()  # the key was the stop's, not the dialog's
        dialog.close()
    qtbot.waitUntil(lambda: bool(published.stopped_at), timeout=WAIT_MS)
    qtbot.waitUntil(lambda: published.ended is Wish.EMERGENCY, timeout=WAIT_MS)
    qtbot.waitUntil(lambda: console.state.text() == "stopped", timeout=WAIT_MS)
    assert "Emergency stop" in console.banner.text()


def test_the_emergency_stop_leaves_before_anything_is_painted(
    console: Console, qtbot: QtBot, publish: Callable[..., Published], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The byte is on the link when the key's handler returns, whatever the event loop has still to do."""
    publish(speed=UNHURRIED)
    attach(console, qtbot)
    link = console.link
    assert link is not None
    order: list[str] = []
    send = link.send_emergency_stop
    monkeypatch.setattr(link, "send_emergency_stop", lambda: (order.append("sent"), send())[1])
    monkeypatch.setattr(console, "_show", lambda *_: order.append("painted"))
    qtbot.keyPress(console, Qt.Key.Key_Escape)
    assert order[0] == "sent"


def test_a_stop_asked_for_just_before_the_window_closes_is_sent(
    console: Console, qtbot: QtBot, publish: Callable[..., Published], monkeypatch: pytest.MonkeyPatch
) -> None:
    published = publish(speed=UNHURRIED)
    attach(console, qtbot)
    assert console.link is not None
    command = console.link.command

    def slow(words: str) -> Answer:
        time.sleep(0.3 if words == "hold" else 0.0)
        return command(words)

    monkeypatch.setattr(console.link, "command", slow)
    console.hold()
    console.stop()
    console.close()
    qtbot.waitUntil(lambda: published.ended is Wish.STOP, timeout=WAIT_MS)


def test_an_emergency_stop_is_waited_for_by_a_window_that_closes(
    console: Console, qtbot: QtBot, publish: Callable[..., Published], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run is killed if it does not answer: not even a closed window may call that off."""
    publish(speed=UNHURRIED)
    attach(console, qtbot)
    link = console.link
    assert link is not None
    confirm, answers = link.confirm_emergency_stop, []

    def slowly(asked: Any) -> Answer:
        time.sleep(0.3)
        answers.append(confirm(asked))
        return answers[-1]

    monkeypatch.setattr(link, "confirm_emergency_stop", slowly)
    console.emergency_stop()
    console.close()
    assert [answer.done for answer in answers] == [True]


@pytest.fixture
def between(console: Console, qtbot: QtBot) -> Iterator[Child]:
    """Start a run that is between two tests."""
    waiting = Child(["-c", "import time; print('between', flush=True); time.sleep(600)"], command=[sys.executable])
    qtbot.waitUntil(lambda: waiting.output() == "between", timeout=WAIT_MS)
    console.start(waiting, replaying=False)
    yield waiting
    waiting.process.kill()
    waiting.process.wait()


def test_the_emergency_stop_ends_a_run_that_is_between_two_tests(
    console: Console, qtbot: QtBot, between: Child
) -> None:
    """There is no link to ask it by: the next test must not begin all the same."""
    assert console.emergency.isEnabled()
    qtbot.keyPress(console, Qt.Key.Key_Escape)
    qtbot.waitUntil(lambda: not between.alive, timeout=WAIT_MS)


@pytest.mark.parametrize("key", [Qt.Key.Key_Escape, Qt.Key.Key_F8])
def test_a_stop_that_comes_as_the_run_hangs_up_ends_it_before_its_next_test(
    console: Console, qtbot: QtBot, publish: Callable[..., Published], between: Child, key: Qt.Key
) -> None:
    published = publish(speed=UNHURRIED)
    attach(console, qtbot)
    console._timer.stop()  # the window has not yet seen it
    published.close()
    qtbot.keyClick(console, key)
    console._commands.submit(int).result()
    qtbot.waitUntil(lambda: bool(console._answers), timeout=WAIT_MS)
    assert between.alive
    console.refresh()
    qtbot.waitUntil(lambda: not between.alive, timeout=WAIT_MS)


def test_a_fault_is_said_in_full(console: Console, qtbot: QtBot, publish: Callable[..., Published]) -> None:
    publish(speed=60.0, fault_at=20_000)
    attach(console, qtbot)
    qtbot.waitUntil(lambda: console.state.text() == "failed", timeout=WAIT_MS)
    assert "exceeds the tension limit" in console.banner.text()
    assert "Remedy" in console.banner.text()
    assert "\u2715 interlock" in console.log.toPlainText()


def test_two_watch_and_one_commands(console: Console, qtbot: QtBot, publish: Callable[..., Published]) -> None:
    publish(speed=UNHURRIED)
    attach(console, qtbot)
    other = Console(["sphere-60mm-low"])
    qtbot.addWidget(other)
    other.show()
    attach(other, qtbot)
    console.hold()
    qtbot.waitUntil(lambda: console.holding, timeout=WAIT_MS)
    other.resume()
    qtbot.waitUntil(lambda: "another console commands this run" in other.statusBar().currentMessage(), timeout=WAIT_MS)
    other.close()
    assert console.link is not None
    assert not console.link.over


def table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def test_a_title_is_shown_to_the_letter(console: Console, tmp_path: Path) -> None:
    text, _ = find("scene", "sphere-60mm-low")
    scene = tmp_path / "odd.toml"
    scene.write_text(text.replace("60 mm glass sphere", "<h1>60 mm</h1>"), "utf-8")
    console.controls.scene.addItem(str(scene))
    console.controls.scene.setCurrentText(str(scene))
    console.check()
    assert console.title.text().startswith("<h1>60 mm</h1>")
    assert console.title.textFormat() is Qt.TextFormat.PlainText


def test_exports_hold_what_is_shown(
    console: Console, qtbot: QtBot, publish: Callable[..., Published], tmp_path: Path
) -> None:
    publish(speed=60.0)
    attach(console, qtbot)
    qtbot.waitUntil(lambda: console.state.text() == "done", timeout=WAIT_MS)
    for plot in console.plots:
        stem = tmp_path / f"{plot.y.name}-{plot.x.name}"
        for suffix in (".png", ".svg", ".csv"):
            console.save_plot(plot, stem.with_suffix(suffix))
        image = QImage(str(stem.with_suffix(".png")))
        assert image.width() == 2000
        assert len({image.pixel(x, y) for x in range(0, 2000, 50) for y in range(0, image.height(), 20)}) > 3
        assert ElementTree.parse(stem.with_suffix(".svg")).getroot().tag.endswith("svg")
        rows = table(stem.with_suffix(".csv"))
        assert {"series", plot.x.column, plot.y.column} <= set(rows[0])
    force = table(tmp_path / "force-time.csv")
    assert len(force) == 39_000
    peak = min(float(row["force_N"]) for row in force)
    assert peak == pytest.approx(-publisher.PULL_OFF_FORCE, rel=0.03)
    path = table(tmp_path / "force-retraction.csv")
    model = [row for row in path if row["series"] == "model cone"]
    assert len(model) > 50
    assert all(float(row["force_N_low"]) <= float(row["force_N"]) for row in model)
    console.save_plot(console.force_time, tmp_path / "no" / "such" / "folder.csv")
    assert "cannot be written" in console.banner.text()


def test_themes_switch_and_differ(console: Console, qtbot: QtBot) -> None:
    dark = console.grab().toImage().pixelColor(3, 3).name()
    qtbot.keyClick(console, Qt.Key.Key_T, Qt.KeyboardModifier.ControlModifier)
    light = console.grab().toImage().pixelColor(3, 3).name()
    assert (dark, light) == (THEMES["dark"].window, THEMES["light"].window)


def _luminance(colour: str) -> float:
    parts = np.array([int(colour[place : place + 2], 16) for place in (1, 3, 5)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("theme", THEMES.values(), ids=THEMES)
def test_every_colour_can_be_read_on_its_ground(theme: Any) -> None:
    """WCAG contrast: 4.5 for text, 3 for lines; the two curves differ for a deuteranope as well."""
    for colour, least in ((theme.text, 7.0), (theme.quiet, 4.5), (theme.measured, 3.0), (theme.model, 3.0)):
        bright, dim = sorted((_luminance(colour), _luminance(theme.card)), reverse=True)
        assert (bright + 0.05) / (dim + 0.05) >= least, colour
    to_deuteranope = np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]]
    )
    one, other = (
        to_deuteranope @ np.array([int(colour[place : place + 2], 16) for place in (1, 3, 5)])
        for colour in (theme.measured, theme.model)
    )
    assert np.linalg.norm(one - other) > 90


def test_everything_can_be_reached_with_the_keyboard(console: Console) -> None:
    names = {
        widget.accessibleName()
        for widget in console.findChildren(object)
        if hasattr(widget, "accessibleName") and widget.accessibleName()
    }
    assert {
        "scene",
        "bench",
        "repeats",
        "Check",
        "Run",
        "Hold",
        "Resume",
        "Stop",
        "emergency stop",
        "event log",
    } <= names
    reached, widget = set(), console.controls.scene
    for _ in range(400):
        widget = widget.nextInFocusChain()
        if widget.focusPolicy() & Qt.FocusPolicy.TabFocus:
            reached.add(widget.accessibleName())
    assert {"Run", "Check", "emergency stop", "event log"} <= reached


def test_zooming_stops_following_and_f_resumes_it(
    console: Console, qtbot: QtBot, publish: Callable[..., Published]
) -> None:
    publish(speed=1.0)
    attach(console, qtbot)
    plot = console.force_time
    plot.item.getViewBox().sigRangeChangedManually.emit([True, True])
    plot.item.setXRange(0.0, 0.1, padding=0)
    end = console.story.end if console.story else 0
    qtbot.waitUntil(lambda: console.story is not None and console.story.end > end + 500, timeout=WAIT_MS)
    assert plot.follow.isVisible()
    assert plot.item.getViewBox().viewRange()[0] == pytest.approx([0.0, 0.1])
    qtbot.keyClick(console, Qt.Key.Key_F)
    assert plot.item.getViewBox().viewRange()[0][1] > 0.4


def test_a_run_that_dies_before_it_serves_says_why(console: Console, qtbot: QtBot) -> None:
    script = "import sys; sys.exit('rig run: stage: no answer. Remedy: plug it in.')"
    console.start(Child([], command=(sys.executable, "-c", script)), replaying=False)
    qtbot.waitUntil(lambda: console.state.text() == "failed", timeout=WAIT_MS)
    assert "Remedy: plug it in" in console.banner.text()
    assert console.controls.run.isEnabled()


def test_nothing_to_attach_to_is_said(console: Console) -> None:
    console.attach_newest()
    assert "No run to attach to" in console.banner.text()


def test_command_lines_of_children() -> None:
    assert run_arguments("a", None, "1", 3) == ["run", "a", "--link", "--repeat", "3", "--speed", "1"]
    assert run_arguments("a", Path("b.toml"), None, 1)[-2:] == ["--bench", "b.toml"]
    words = replay_arguments(Path("r.h5"), "membrane", ("membrane.thickness_um=180",))
    assert words[:2] == ["replay", "r.h5"]
    assert words[-4:] == ["--model", "membrane", "--set", "membrane.thickness_um=180"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only X and Wayland can be absent")
def test_without_a_screen_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(NoWindow, match="no screen"):
        open_console()


def test_the_application_is_qt(qapp: QApplication) -> None:
    assert qapp.platformName() in ("offscreen", "xcb")


def test_rig_run_console_starts_the_same_run_in_a_child(monkeypatch: pytest.MonkeyPatch) -> None:
    from rig import cli
    from rig.console import app

    opened: list[dict[str, Any]] = []
    monkeypatch.setattr(app, "open_console", lambda **options: opened.append(options) or 0)
    words = ["run", "flat-low", "--console", "--direct", "--seed", "7", "--repeat", "2", "--speed", "4", "--no-live"]
    assert cli.main(words) == 0
    child = opened[0]["child"]
    assert child[:3] == ["run", "flat-low", "--link"]
    assert "--console" not in child
    for part in (["--seed", "7"], ["--repeat", "2"], ["--speed", "4"], ["--direct"], ["--no-live"]):
        place = child.index(part[0])
        assert child[place : place + len(part)] == part
    assert cli.main(["replay", "r.h5", "--console", "--model", "membrane"]) == 0
    assert opened[1]["replay"] == Path("r.h5")
    assert opened[1]["what_if"] == ("membrane", ())
    assert cli.main(["console", "flat-low", "--theme", "light", "--alone"]) == 0
    assert (opened[2]["scene"], opened[2]["theme"], opened[2]["attach"]) == ("flat-low", "light", False)
