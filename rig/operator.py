"""The operator at the terminal: one thread reads the keyboard, so that the loop never waits for it."""

from __future__ import annotations

import contextlib
import queue
import sys
import threading
from typing import TextIO

from rig.errors import Refused
from rig.observe import Controls, Event, Watcher


class Keyboard:
    """Lines from standard input, read by one thread from the first question on.

    An Enter answers the question asked last: of the program between runs, or of the run under way.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stdin if stream is None else stream
        self._presses: queue.Queue[None] = queue.Queue()
        self._lock = threading.Lock()
        self._controls: Controls | None = None
        self._thread: threading.Thread | None = None
        self._closed = False

    def confirm(self, text: str) -> None:
        """Ask between runs and wait for Enter.

        Raises
        ------
        Refused
            Standard input is closed: nobody can answer.
        """
        with self._lock:
            self._controls = None
            while not self._presses.empty():
                self._presses.get_nowait()
        print(f"{text} Press Enter to go on. ", end="", file=sys.stderr, flush=True)
        self._read()
        while not (self._closed and self._presses.empty()):
            with contextlib.suppress(queue.Empty):  # wakes up for Ctrl-C
                return self._presses.get(timeout=0.2)
        raise Refused(f"{text} Nobody can answer: standard input is closed. Remedy: run it in a terminal")

    def answer_for(self, controls: Controls) -> bool:
        """Let the next Enter resume a run; return whether anyone can press it."""
        with self._lock:
            self._controls = controls
        self._read()
        return not self._closed

    def _read(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._follow, name="keyboard", daemon=True)
            self._thread.start()

    def _follow(self) -> None:
        try:
            for _ in self._stream:
                self._pressed()
        except (OSError, ValueError) as error:  # the terminal is gone
            print(f"rig: the keyboard cannot be read any more ({error})", file=sys.stderr)
        self._closed = True

    def _pressed(self) -> None:
        with self._lock:
            controls, self._controls = self._controls, None
        if controls is None:
            self._presses.put(None)
        else:
            controls.resume()


class Prompts(Watcher):
    """Answers the prompts of one run from the keyboard; the console's button works as well."""

    def __init__(self, keyboard: Keyboard, controls: Controls) -> None:
        self._keyboard = keyboard
        self._controls = controls

    def event(self, event: Event) -> None:
        """Say how to answer a prompt, and wait for the answer elsewhere."""
        if event.kind != "prompt":
            return
        can_answer = self._keyboard.answer_for(self._controls)
        words = "press Enter, or resume in the console" if can_answer else "resume in the console"
        print(f"            {words}", file=sys.stderr, flush=True)
