"""The operator's hand: scene, check, run, hold, resume, stop; and the transport of a replay."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from PySide6.QtCore import Qt
from PySide6.QtGui import QKeySequence
from PySide6.QtWidgets import (
    QComboBox,
    QFileDialog,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QSlider,
    QSpinBox,
    QWidget,
)

from rig.console.panels import label
from rig.console.words import duration

SPEEDS = (1.0, 10.0, 100.0, float("inf"))
"""Of a replay, times real time; infinite is as fast as possible."""


def button(text: str, key: str, tip: str, action: Callable[[], None]) -> QPushButton:
    """Return a button with its key on it."""
    widget = QPushButton(f"{text}  {key}" if key else text)
    if key:
        widget.setShortcut(QKeySequence(key))
    widget.setToolTip(tip)
    widget.setAccessibleName(text)
    widget.clicked.connect(lambda _checked: action())
    return widget


class RunControls(QWidget):
    """What can be done with a run."""

    def __init__(self, actions: dict[str, Callable[[], None]], scenes: list[str]) -> None:
        super().__init__()
        self.scene = QComboBox()
        self.scene.addItems(scenes)
        self.scene.setMinimumWidth(200)
        self.scene.setAccessibleName("scene")
        self.bench = QComboBox()
        self.bench.addItem("emulated bench", None)
        self.bench.setAccessibleName("bench")
        self.speed = QComboBox()
        self.speed.addItem("real time", "1")
        self.speed.addItem("10 \u00d7", "10")
        self.speed.addItem("fastest", "max")
        self.speed.setAccessibleName("speed of the emulated bench")
        self.repeats = QSpinBox()
        self.repeats.setRange(1, 999)
        self.repeats.setPrefix("\u00d7 ")
        self.repeats.setAccessibleName("repeats")
        self.repeats.setToolTip("how many tests in a row")
        self.check = button("Check", "F4", "Hold the scene against the bench; moves nothing", actions["check"])
        self.run = button("Run", "F5", "Start the sequence", actions["run"])
        self.hold = button("Hold", "F6", "Stop the motion and wait; data keep coming", actions["hold"])
        self.resume = button("Resume", "F7", "Go on after a hold", actions["resume"])
        self.stop = button("Stop", "F8", "End the run in good order", actions["stop"])
        self.attach = button("Attach", "F9", "Watch a run that is already going", actions["attach"])
        self.open = button("Replay", "Ctrl+O", "Replay a recording", actions["open"])
        browse = button("\u2026", "", "Take a scene or a bench from a file", self._browse)
        browse.setAccessibleName("scene or bench from a file")
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.setSpacing(8)
        for widget in (self.scene, browse, self.bench, self.speed, self.repeats):
            row.addWidget(widget)
        row.addStretch(1)
        for widget in (self.check, self.run, self.hold, self.resume, self.stop):
            row.addWidget(widget)
        row.addSpacing(12)
        row.addWidget(self.attach)
        row.addWidget(self.open)

    @property
    def bench_path(self) -> Path | None:
        """The chosen bench file, or ``None`` for the emulated bench."""
        held = self.bench.currentData()
        return None if held is None else Path(held)

    def _browse(self) -> None:
        name, _ = QFileDialog.getOpenFileName(self, "Scene or bench", "", "Scene or bench (*.toml)")
        if name:
            self.add_file(Path(name))

    def add_file(self, path: Path) -> None:
        """Offer a file: a bench if it has instruments, else a scene."""
        text = path.read_text(encoding="utf-8", errors="replace")
        if "[stage]" in text and "[daq]" in text:
            self.add_bench(path)
        else:
            self.scene.addItem(str(path))
            self.scene.setCurrentIndex(self.scene.count() - 1)

    def add_bench(self, path: Path) -> None:
        """Offer a bench: a file, or the name of one that ships."""
        self.bench.addItem(path.name, str(path))
        self.bench.setCurrentIndex(self.bench.count() - 1)

    def enable(self, *, ready: bool, running: bool, commands: bool, holding: bool) -> None:
        """Offer what makes sense now."""
        for widget in (self.scene, self.bench, self.repeats, self.check, self.open, self.attach):
            widget.setEnabled(not running)
        self.speed.setEnabled(not running)
        self.run.setEnabled(ready and not running)
        self.hold.setEnabled(running and commands and not holding)
        self.resume.setEnabled(running and commands and holding)
        self.stop.setEnabled(running and commands)


class Transport(QWidget):
    """Play, pause, step and jump in a recording."""

    def __init__(self, actions: dict[str, Callable[[], None]], moved: Callable[[float], None]) -> None:
        super().__init__()
        self.play = button("Play", "Space", "Play or pause", actions["play"])
        self.play.setCheckable(True)
        self.back = button("\u25c0 step", "Left", "One frame back", actions["back"])
        self.forward = button("step \u25b6", "Right", "One frame on", actions["forward"])
        self.previous = button("|\u25c0", "PgUp", "To the start of the step before", actions["previous"])
        self.next = button("\u25b6|", "PgDown", "To the start of the next step", actions["next"])
        self.leave = button("Close", "Ctrl+W", "Leave the replay", actions["leave"])
        self.speed = QComboBox()
        for speed in SPEEDS:
            self.speed.addItem("fastest" if speed == float("inf") else f"{speed:g} \u00d7", speed)
        self.speed.setAccessibleName("speed of the replay")
        self.slider = QSlider(Qt.Orientation.Horizontal)
        self.slider.setRange(0, 100_000)
        self.slider.setAccessibleName("place in the recording")
        self.slider.sliderMoved.connect(lambda place: moved(place / self.slider.maximum()))
        self.place: QLabel = label("small")
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.setSpacing(8)
        for widget in (self.previous, self.back, self.play, self.forward, self.next, self.speed):
            row.addWidget(widget)
        row.addWidget(self.slider, 1)
        row.addWidget(self.place)
        row.addSpacing(16)
        row.addWidget(self.leave)

    def show_place(self, sample: int, end: int, rate: float, *, playing: bool) -> None:
        """Show where the playhead stands."""
        if not self.slider.isSliderDown():
            self.slider.setValue(int(self.slider.maximum() * sample / max(end, 1)))
        self.place.setText(f"{duration(sample / rate)} of {duration(end / rate)}")
        if self.play.isChecked() != playing:
            self.play.setChecked(playing)
        text = "Pause  Space" if playing else "Play  Space"
        if self.play.text() != text:
            self.play.setText(text)
            self.play.setShortcut(QKeySequence("Space"))
