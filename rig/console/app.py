"""Start the console."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rig.errors import RigError
from rig.library import shipped


class NoWindow(RigError):
    """There is no screen to open a window on, or Qt is not installed."""

    exit_code = 2


def open_console(
    *,
    scene: str | None = None,
    bench: Path | None = None,
    child: Sequence[str] | None = None,
    replay: Path | None = None,
    what_if: tuple[str | None, tuple[str, ...]] = (None, ()),
    theme: str = "dark",
    attach: bool = True,
) -> int:
    """Open the window and return when it is closed.

    Parameters
    ----------
    scene, bench
        Chosen at the start.
    child
        Command line of a run to start and watch.
    replay, what_if
        A recording to replay, with another model and other scene values.
    attach
        Whether to watch a run that is already going, if there is one.

    Raises
    ------
    NoWindow
        There is no screen, or no Qt.
    """
    application = _application()
    from rig.console.runner import Child
    from rig.console.window import Console
    from rig.link_address import running

    window = Console(_scenes(scene), theme)
    if bench is not None:
        window.controls.add_bench(bench)
    window.resize(1600, 1000)
    window.show()
    if child is not None:
        window.start(Child(child), replaying=False)
    elif replay is not None:
        window.replay(replay, *what_if)
    elif attach and running():
        window.attach_newest()
    return int(application.exec())


def _scenes(first: str | None) -> list[str]:
    names = shipped("scene")
    if first is None:
        return names
    return [first, *(name for name in names if name != first)]


def _application() -> Any:
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or os.environ.get("QT_QPA_PLATFORM")
    ):
        raise NoWindow("console: there is no screen. Remedy: run it on a desktop, or set DISPLAY or QT_QPA_PLATFORM.")
    try:
        from PySide6.QtWidgets import QApplication
    except ImportError as error:
        raise NoWindow(
            f"console: Qt cannot be loaded ({error}). Remedy: pip install 'membrane-adhesion-rig[console]', and on "
            "Debian the libraries the README names."
        ) from error
    return QApplication.instance() or QApplication(sys.argv[:1])
