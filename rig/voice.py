"""Says lines from a thread of its own: a terminal that takes no output must not hold the loop."""

from __future__ import annotations

import contextlib
import queue
import sys
import threading
from typing import TextIO

MOST_WAITING = 1000
"""Lines a terminal may be behind before more are dropped; the recording has them all."""
LAST_WORDS_S = 1.0
"""So long the end of a run waits for a terminal that is behind."""


def say(text: str, stream: TextIO | None = None) -> None:
    """Print on standard error, or elsewhere; a closed pipe or window changes nothing of what the program does."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr if stream is None else stream, flush=True)


class Voice:
    """Writes what it is given to a stream, in order.

    A terminal takes no output after Ctrl-S, while text is selected in a Windows console, or when a pager has stopped.

    Parameters
    ----------
    stream
        Standard error by default.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self.live = self._stream.isatty()
        self._lines: queue.Queue[str | None] = queue.Queue(MOST_WAITING)
        self._thread: threading.Thread | None = None
        self._failure: OSError | ValueError | None = None

    def say(self, text: str) -> None:
        """Write a text soon, or drop it where a thousand are waiting.

        Raises
        ------
        OSError, ValueError
            The terminal is gone.
        """
        if self._failure is not None:
            raise self._failure
        if self._thread is None:
            self._thread = threading.Thread(target=self._speak, name="voice", daemon=True)
            self._thread.start()
        if not self._lines.full():
            self._lines.put_nowait(text)

    def finish(self) -> None:
        """Wait a little until all has been said; what is said later is said by another thread."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        with contextlib.suppress(queue.Full):
            self._lines.put(None, timeout=LAST_WORDS_S)
            thread.join(LAST_WORDS_S)

    def _speak(self) -> None:
        try:
            while (text := self._lines.get()) is not None:
                self._stream.write(text)
                self._stream.flush()
        except (OSError, ValueError) as error:
            self._failure = error  # told by the next ``say``
