"""The key of the emergency stop, wherever the focus is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import QEvent, QObject, Qt
from PySide6.QtGui import QKeyEvent
from PySide6.QtWidgets import QApplication

if TYPE_CHECKING:
    from rig.console.window import Console


class EmergencyKey(QObject):
    """Catches Esc before any dialog or widget does."""

    def __init__(self, console: Console) -> None:
        super().__init__(console)
        self._console = console
        application = QApplication.instance()
        if application is not None:
            application.installEventFilter(self)

    def remove(self) -> None:
        """Stop catching."""
        application = QApplication.instance()
        if application is not None:
            application.removeEventFilter(self)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """See ``QObject``."""
        if event.type() != QEvent.Type.KeyPress or not isinstance(event, QKeyEvent):
            return False
        if event.key() != Qt.Key.Key_Escape or not self._console.emergency.isEnabled():
            return False
        if not event.isAutoRepeat():
            self._console.emergency_stop()
        return True
