"""What stands beside the plots: step strip, readings, prediction, stage, pump, recording."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from PySide6.QtCore import QRectF, QSize, Qt
from PySide6.QtGui import QColor, QFont, QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QFrame, QGridLayout, QHBoxLayout, QLabel, QSizePolicy, QVBoxLayout, QWidget

from drivers.interfaces import PumpState
from rig.console.story import Moment, Story
from rig.console.theme import DARK, Theme
from rig.console.words import condition, fraction, number
from rig.live_prediction import Estimate, LivePrediction
from rig.observe import RunInfo

_FROM_FILES = ("title", "banner", "step")
"""Labels that show what a scene or an instrument says, to the letter."""


def label(name: str, text: str = "") -> QLabel:
    """Return a label that the style sheet knows by name."""
    widget = QLabel(text)
    widget.setObjectName(name)
    if name in _FROM_FILES:
        widget.setTextFormat(Qt.TextFormat.PlainText)
    return widget


def set_tone(widget: QWidget, tone: str) -> None:
    """Change the tone (``active``, ``good``, ``warning``, ``fault`` or none) a style sheet colours by."""
    if widget.property("tone") != tone:
        widget.setProperty("tone", tone)
        widget.style().unpolish(widget)
        widget.style().polish(widget)


class Card(QFrame):
    """A framed group with a caption."""

    def __init__(self, caption: str) -> None:
        super().__init__()
        self.setObjectName("card")
        self.setAccessibleName(caption)
        self.column = QVBoxLayout(self)
        self.column.setContentsMargins(12, 6, 12, 8)
        self.column.setSpacing(2)
        self.column.addWidget(label("caption", caption))


class Rows(Card):
    """A card of named values."""

    def __init__(self, caption: str, names: list[str]) -> None:
        super().__init__(caption)
        grid = QGridLayout()
        grid.setVerticalSpacing(1)
        grid.setColumnStretch(1, 1)
        self._values = {}
        for row, name in enumerate(names):
            grid.addWidget(label("caption", name), row, 0)
            value = label("small")
            value.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
            value.setAccessibleName(name)
            grid.addWidget(value, row, 1)
            self._values[name] = value
        self.column.addLayout(grid)

    def set(self, name: str, text: str) -> None:
        """Show a value."""
        if self._values[name].text() != text:
            self._values[name].setText(text)

    def text(self, name: str) -> str:
        """Return what is shown."""
        return self._values[name].text()


class StepStrip(QWidget):
    """The sequence as a strip of steps; the active one is marked and fills as its condition comes true."""

    def __init__(self) -> None:
        super().__init__()
        self._theme: Theme = DARK
        self._names: list[str] = []
        self._done: dict[str, str] = {}
        self._active = ""
        self._fraction = 0.0
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.setAccessibleName("steps")

    def sizeHint(self) -> QSize:
        """See ``QWidget``."""
        return QSize(600, 44)

    def paint_theme(self, theme: Theme) -> None:
        """Take on a theme."""
        self._theme = theme
        self.update()

    def plan(self, names: list[str]) -> None:
        """Show the steps to come."""
        self._names, self._done, self._active, self._fraction = names, {}, "", 0.0
        self.update()

    def show_moment(self, moment: Moment) -> None:
        """Mark what is done and what is active."""
        active = moment.step.name if moment.step else ""
        part = fraction(moment.progress) if active else 0.0
        if (moment.done, active, round(part, 3)) != (self._done, self._active, round(self._fraction, 3)):
            self._done, self._active, self._fraction = dict(moment.done), active, part
            self.setAccessibleDescription(f"active step: {active or 'none'}")
            self.update()

    @property
    def active(self) -> str:
        """Name of the step marked as active."""
        return self._active

    def paintEvent(self, event: QPaintEvent) -> None:
        """See ``QWidget``."""
        if not self._names:
            return
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        font = QFont(self.font())
        font.setPixelSize(17)
        width = (self.width() - 6 * (len(self._names) - 1)) / len(self._names)
        for place, name in enumerate(self._names):
            self._draw(painter, font, QRectF(place * (width + 6) + 1, 1, width - 2, self.height() - 2), name)
        painter.end()

    def _draw(self, painter: QPainter, font: QFont, box: QRectF, name: str) -> None:
        theme, active = self._theme, name == self._active
        over = name in self._done and not active
        failed = over and self._done[name] not in ("", "done")
        tone = theme.fault if failed else theme.active if active else theme.good if over else theme.line
        painter.setPen(QPen(QColor(tone), 3 if active else 1.5))
        painter.setBrush(QColor(theme.card))
        painter.drawRoundedRect(box, 7, 7)
        if active and self._fraction:
            fill = QColor(tone)
            fill.setAlpha(90)
            painter.setPen(Qt.PenStyle.NoPen)
            painter.setBrush(fill)
            inner = box.adjusted(2, 2, -2, -2)
            inner.setWidth(inner.width() * self._fraction)
            painter.drawRoundedRect(inner, 5, 5)
        mark = "\u2715 " if failed else "\u2713 " if over else "\u25b6 " if active else ""
        font.setBold(active)
        painter.setFont(font)
        painter.setPen(QColor(theme.text if active or over else theme.quiet))
        painter.drawText(box, Qt.AlignmentFlag.AlignCenter, mark + name)


class Reading(QWidget):
    """A large number with its symbol and unit."""

    def __init__(self, symbol: str, unit: str, name: str) -> None:
        super().__init__()
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        caption = label("unit", symbol)
        caption.setTextFormat(Qt.TextFormat.RichText)
        caption.setFixedWidth(44)
        self.value = label("reading", "\N{EN DASH}")
        self.value.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignBaseline)
        self.value.setAccessibleName(name)
        shown = label("unit", unit)
        shown.setFixedWidth(48)
        for widget, stretch in ((caption, 0), (self.value, 1), (shown, 0)):
            row.addWidget(widget, stretch)

    def set(self, text: str) -> None:
        """Show a number."""
        self.value.setText(text)


class Readings(Card):
    """Force, pressure, retraction."""

    def __init__(self) -> None:
        super().__init__("now")
        self.force = Reading("F<sub>r</sub>", "N", "force in N")
        self.pressure = Reading("P<sub>a</sub>", "kPa", "pressure in kPa")
        self.retraction = Reading("z<sub>r</sub>", "mm", "retraction in mm")
        for reading in (self.force, self.pressure, self.retraction):
            self.column.addWidget(reading)

    def prepare(self, *, uses_pressure: bool, retracts: bool) -> None:
        """Show only what the scene uses."""
        self.pressure.setVisible(uses_pressure)
        self.retraction.setVisible(retracts)

    def show_moment(self, moment: Moment) -> None:
        """Show the present values."""
        self.force.set(number(moment.force, 3))
        if moment.pressure is not None:
            self.pressure.set(number(moment.pressure * 1e-3, 2))
        height = moment.stage.position if moment.stage else np.nan
        self.retraction.set(number((height - moment.zero_height) * 1e3, 3))


class PredictionCard(Card):
    """Where the model says pull-off will be, how sure it is, and what came of it."""

    def __init__(self) -> None:
        super().__init__("pull-off: predicted, 90 % interval")
        self.force, self.distance = label("value"), label("value")
        self.work, self.note, self.measured = label("small"), label("note"), label("small")
        self.note.setWordWrap(True)
        self.measured.setTextFormat(Qt.TextFormat.RichText)
        for text in (self.force, self.distance, self.work):
            text.setTextFormat(Qt.TextFormat.RichText)
            self.column.addWidget(text)
        self.column.addWidget(self.measured)
        self.column.addWidget(self.note)
        self.clear()

    def clear(self) -> None:
        """Nothing predicted yet."""
        self.force.setText(_interval("F<sub>p</sub>", None, 1.0, "N"))
        self.distance.setText(_interval("D<sub>p</sub>", None, 1e3, "mm"))
        self.work.setText("")
        self.measured.setText("")
        self._say("the prediction begins when P\u2080 is reached", "")

    def expect(self, force: float, distance: float, model: str) -> None:
        """Show what the model says of the chosen scene before a run."""
        self.force.setText(f"F<sub>p</sub> {number(force, 3)} N")
        self.distance.setText(f"D<sub>p</sub> {number(distance * 1e3, 3)} mm")
        self.work.setText("")
        self.measured.setText("")
        self._say(f"{model} model, the scene's own values", "")

    def show_moment(self, moment: Moment, first: LivePrediction | None, measured: tuple[float, float] | None) -> None:
        """Show the prediction of this moment, the ``first`` one beside it, and what was measured once it is over."""
        prediction = moment.prediction
        if prediction is None:
            self.clear()
            return
        self.force.setText(_interval("F<sub>p</sub>", prediction.pull_off_force, 1.0, "N"))
        self.distance.setText(_interval("D<sub>p</sub>", prediction.pull_off_distance, 1e3, "mm"))
        work = prediction.work_of_adhesion
        self.work.setText(
            f"\u03c9<sub>a</sub> {number(work.value, 2)} J/m\u00b2 [{number(work.low, 2)}, {number(work.high, 2)}]"
            + ("" if first is None else f"<br>{_at_start(first)}")
        )
        self.measured.setText("" if measured is None else _measured(*measured))
        if not prediction.inside:
            self._say(f"\u26a0 {prediction.note or 'the data have left the band'}", "warning")
        elif measured is None:
            self._say("\u2713 data inside the band", "good")
        else:
            self._say(*_verdict(prediction if first is None else first, *measured))

    def _say(self, text: str, tone: str) -> None:
        self.note.setText(text)
        set_tone(self.note, tone)


def _interval(symbol: str, estimate: Estimate | None, scale: float, unit: str) -> str:
    if estimate is None:
        return f"{symbol} \N{EN DASH} {unit}"
    low, high = number(estimate.low * scale, 3), number(estimate.high * scale, 3)
    return f"{symbol} {number(estimate.value * scale, 3)} {unit} <span style='font-size:15px'>[{low}, {high}]</span>"


def _at_start(first: LivePrediction) -> str:
    force, distance = first.pull_off_force, first.pull_off_distance
    return (
        "<span style='font-size:13px'>at P\u2080: "
        f"F<sub>p</sub> {number(force.low, 2)}\u2013{number(force.high, 2)} N, "
        f"D<sub>p</sub> {number(distance.low * 1e3, 2)}\u2013{number(distance.high * 1e3, 2)} mm</span>"
    )


def _measured(force: float, distance: float) -> str:
    return (
        "<span style='font-size:15px'><b>measured "
        f"F<sub>p</sub> {number(force, 3)} N, D<sub>p</sub> {number(distance * 1e3, 3)} mm</b></span>"
    )


def _verdict(said: LivePrediction, force: float, distance: float) -> tuple[str, str]:
    """Hold what was measured against the intervals announced when P_0 was reached."""
    missed = [
        name
        for name, estimate, value in (("F_p", said.pull_off_force, force), ("D_p", said.pull_off_distance, distance))
        if not estimate.low <= value <= estimate.high
    ]
    if missed:
        return f"\u26a0 {' and '.join(missed)} outside the band announced at P\u2080", "warning"
    return "\u2713 F_p and D_p inside the band announced at P\u2080", "good"


class StageCard(Rows):
    """Stage: position, speed, limits."""

    def __init__(self) -> None:
        super().__init__("stage", ["position", "speed", "travel", "state"])
        self._travel: tuple[float, float] | None = None

    def prepare(self, info: RunInfo) -> None:
        """Note the limits."""
        low, high = info.limits.get("travel_low_m"), info.limits.get("travel_high_m")
        self._travel = None if low is None or high is None else (low, high)
        known = "\N{EN DASH}" if low is None or high is None else f"{low * 1e3:.1f} to {high * 1e3:.1f} mm"
        self.set("travel", known)

    def show_moment(self, moment: Moment) -> None:
        """Show the last poll."""
        if moment.stage is None:
            return
        self.set("position", f"{number(moment.stage.position * 1e3, 4)} mm")
        self.set("speed", f"{number(moment.speed * 1e6, 1)} \u00b5m/s")
        stage = moment.stage
        limit = "  \u26a0 at a limit" if stage.negative_limit or stage.positive_limit else ""
        servo = "" if stage.servo_on else ", servo off"
        fault = f", error {stage.error}" if stage.error else ""
        self.set("state", ("moving" if stage.moving else "at rest") + servo + fault + limit)


class PumpCard(Rows):
    """Pump: volume, rate, stall."""

    def __init__(self) -> None:
        super().__init__("pump", ["volume", "rate", "state"])

    def show_moment(self, moment: Moment) -> None:
        """Show the last poll."""
        if moment.pump is None:
            return
        self.set("volume", f"{number(moment.pump.volume * 1e6, 4)} ml")
        self.set("rate", f"{number(moment.pump.rate * 6e7, 3)} ml/min")
        bad = moment.pump.state in (PumpState.STALLED, PumpState.AT_LIMIT)
        self.set("state", ("\u26a0 " if bad else "") + str(moment.pump.state))


class RecordingCard(Rows):
    """The recording's name, and how long ago it was last written: a second is too long."""

    def __init__(self) -> None:
        super().__init__("recording", ["file", "last flush", "samples"])
        self._path: Path | None = None

    def prepare(self, info: RunInfo, *, replay: bool) -> None:
        """Note the file."""
        self._path = Path(info.recording) if info.recording else None
        name = self._path.name if self._path else "none"
        self.set("file", name if len(name) < 26 else f"\u2026{name[-24:]}")
        self._values["file"].setToolTip(info.recording)
        self.set("last flush", "replayed" if replay else "\N{EN DASH}")
        if replay:
            self._path = None

    def show_moment(self, moment: Moment, story: Story) -> None:
        """Show the age of the file."""
        self.set("samples", f"{moment.sample:,}".replace(",", "\N{NARROW NO-BREAK SPACE}"))
        if self._path is None:
            return
        if story.ending is not None:
            self.set("last flush", "closed")
            return
        try:
            age = max(0.0, time.time() - self._path.stat().st_mtime)
        except OSError:
            self.set("last flush", "\u26a0 file is gone")
            return
        self.set("last flush", ("\u26a0 " if age > 1 else "") + f"{number(age, 2)} s ago")


def step_words(moment: Moment) -> str:
    """Return the active step with its condition in words."""
    if moment.step is None:
        return ""
    return condition(moment.step, moment.progress)
