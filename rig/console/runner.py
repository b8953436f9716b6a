"""Starts runs and replays as processes of their own: what happens to the console must not happen to them."""

from __future__ import annotations

import os
import secrets
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from rig.link_address import Address, find
from rig.link_server import NAME_VARIABLE

_TAIL = 2000


class Child:
    """A run this console has started.

    Its output goes to a file, not to a pipe that would break with the console; it is in a session of its own, so that
    neither a closed terminal nor a Ctrl-C meant for the console reaches it.
    """

    def __init__(self, arguments: Sequence[str], *, command: Sequence[str] | None = None) -> None:
        self.name = f"console-{secrets.token_hex(6)}"
        self._output = Path(tempfile.gettempdir()) / f"rig-{self.name}.log"
        environment = os.environ | {NAME_VARIABLE: self.name, "PYTHONUNBUFFERED": "1"}
        words = [*(command or (sys.executable, "-m", "rig")), *arguments]
        apart = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
        descriptor = os.open(self._output, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
        with open(descriptor, "wb") as file:
            self.process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=sys.platform != "win32",
                creationflags=apart,
            )

    @property
    def alive(self) -> bool:
        """Whether it is still running."""
        return self.process.poll() is None

    @property
    def exit_code(self) -> int | None:
        """Its exit code, or ``None`` while it runs."""
        return self.process.poll()

    def address(self) -> Address | None:
        """Return where it serves, or ``None`` while it does not."""
        return find(self.name)

    def output(self) -> str:
        """Return the end of what it has printed."""
        return self._output.read_text(encoding="utf-8", errors="replace")[-_TAIL:].strip()

    def forget(self) -> None:
        """Remove its output once it is over; a run that goes on keeps it."""
        if not self.alive:
            self._output.unlink(missing_ok=True)


def run_arguments(scene: str, bench: Path | None, speed: str | None, repeats: int) -> list[str]:
    """Return the command line of a run; ``speed`` is ``None`` for real instruments."""
    words = ["run", scene, "--link", "--repeat", str(repeats)]
    if bench is not None:
        words += ["--bench", str(bench)]
    return words if speed is None else [*words, "--speed", speed]


def replay_arguments(recording: Path, model: str | None = None, changes: Sequence[str] = ()) -> list[str]:
    """Return the command line of a replay; the console's playhead sets the pace."""
    words = ["replay", str(recording), "--speed", "max", "--link"]
    if model is not None:
        words += ["--model", model]
    for change in changes:
        words += ["--set", change]
    return words
