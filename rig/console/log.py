"""The event log: what the run has said up to the shown moment."""

from __future__ import annotations

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QPlainTextEdit, QToolButton, QVBoxLayout

from rig.console.story import Moment, Story
from rig.console.words import number
from rig.observe import Event

LINES = 2000


class EventLog(QPlainTextEdit):
    """One line per event; commands sent to instruments only if asked for."""

    def __init__(self) -> None:
        super().__init__()
        self._events, self._missed = 0, 0
        self.setReadOnly(True)
        self.setMaximumBlockCount(LINES)
        self.setFixedHeight(118)
        self.setAccessibleName("event log")
        self.setTabChangesFocus(True)
        self.commands = QToolButton(self)
        self.commands.setText("commands")
        self.commands.setCheckable(True)
        self.commands.setToolTip("Show every command sent to an instrument as well")
        self.commands.setAccessibleName("show commands in the log")
        self.commands.toggled.connect(self._write_anew)
        corner = QVBoxLayout(self)
        corner.addWidget(self.commands, 0, Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignTop)
        corner.setContentsMargins(0, 4, 22, 0)

    def forget(self) -> None:
        """Begin with another run."""
        self._events, self._missed = 0, 0

    def _write_anew(self) -> None:
        if self._events:
            self.clear()
            self._events = 0

    def show_moment(self, moment: Moment, story: Story) -> None:
        """Write what has come, or all anew after a step back."""
        if moment.events < self._events:  # the playhead went back
            self.clear()
            self._events = 0
        for event in story.events[max(self._events, moment.events - LINES) : moment.events]:
            if event.kind != "command" or self.commands.isChecked():
                self.appendPlainText(_line(event, story.rate))
        if moment.events != self._events:
            self.verticalScrollBar().setValue(self.verticalScrollBar().maximum())
        if story.missed != self._missed:
            self.appendPlainText(f"{story.missed - self._missed} messages were missed by this console (not by the run)")
        self._events, self._missed = moment.events, story.missed


def _line(event: Event, rate: float) -> str:
    mark = {"fault": "\u2715 ", "interlock": "\u2715 ", "warning": "\u26a0 "}.get(event.kind, "")
    return f"{number(event.sample / rate, 2):>9} s  {mark}{event.kind:<9} {event.text}"
