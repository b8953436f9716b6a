"""``rig`` in a process of its own, held in the middle of a run for as long as a test needs to do something to it.

As a script: ``held_run.py RECORDING FRAME WORDS...`` runs ``rig WORDS``, says ``held`` once it has written that frame
of that recording, counted from 1, and goes on when it is sent a line.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def held(recording: int, frame: int, *words: object) -> Iterator[subprocess.Popen[str]]:
    """Start ``rig`` and wait until it is held; ``communicate`` with a line lets it go on."""
    command = [sys.executable, __file__, str(recording), str(frame), *map(str, words)]
    ends: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen(command, text=True, **ends) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "held\n"
            yield process
        finally:
            process.kill()


def main() -> int:
    """Run the command."""
    from rig.cli import main as rig
    from rig.recorder import Recorder

    recording, number = int(sys.argv[1]), int(sys.argv[2])
    append = Recorder.append
    recorders: list[Recorder] = []

    def appended(self: Recorder, frame: Any, *rest: Any) -> None:
        append(self, frame, *rest)
        if self not in recorders:
            recorders.append(self)
        if (len(recorders), frame.number) == (recording, number):
            self.flush()
            sys.stdout.write("held\n")
            sys.stdout.flush()
            sys.stdin.readline()

    Recorder.append = appended  # type: ignore[method-assign]
    return rig(sys.argv[3:])


if __name__ == "__main__":
    sys.exit(main())
