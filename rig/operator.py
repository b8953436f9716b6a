"""The operator at the terminal: one thread reads the keyboard, so that the loop never waits for it."""

from __future__ import annotations

import contextlib
import io
import queue
import sys
import threading
from typing import TextIO

from rig.errors import Refused
from rig.observe import Controls, Event, Observer
from rig.voice import Voice, say


class Keyboard:
    """Lines from standard input, read by one thread from the first question on.

    An Enter answers the question asked last: of the program between runs, or of the run under way. What was typed in a
    terminal before it was asked answers nothing; a pipe's lines are answers prepared beforehand.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stdin or io.StringIO()
        self._presses: queue.Queue[None] = queue.Queue()
        self._lock = threading.Lock()
        self._controls: Controls | None = None
        self._alone = False
        self._thread: threading.Thread | None = None
        self._closed = False

    def confirm(self, text: str) -> None:
        """Ask between runs and wait for Enter.

        Raises
        ------
        Refused
            Standard input is closed: nobody can answer.
        """
        _forget_typed(self._stream)
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

    def answer_for(self, controls: Controls, *, alone: bool = True) -> bool:
        """Let the next Enter resume a run; return whether anyone can press it.

        If nobody can, now or later, and the keyboard is ``alone`` in taking answers, the run is ended in good order.
        """
        _forget_typed(self._stream)
        with self._lock:
            self._controls, self._alone = controls, alone
        self._read()
        self._give_up()
        return not self._closed

    def _give_up(self) -> None:
        """End a run that waits for an Enter which nobody can press any more."""
        with self._lock:
            if self._closed and self._alone and self._controls is not None:
                self._controls.stop()

    def _read(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._follow, name="keyboard", daemon=True)
            self._thread.start()

    def _follow(self) -> None:
        try:
            for _ in self._stream:
                self._pressed()
        except (OSError, ValueError) as error:  # the terminal is gone
            say(f"rig: the keyboard cannot be read any more ({error})")
        self._closed = True
        self._give_up()

    def _pressed(self) -> None:
        with self._lock:
            controls, self._controls = self._controls, None
        if controls is None:
            self._presses.put(None)
        else:
            controls.resume()


class Prompts(Observer):
    """Answers the prompts of one run from the keyboard; where consoles can attach, their button works as well."""

    def __init__(self, keyboard: Keyboard, controls: Controls, voice: Voice, *, linked: bool = False) -> None:
        self._keyboard = keyboard
        self._controls = controls
        self._voice = voice
        self._linked = linked

    def event(self, event: Event) -> None:
        """Say how to answer a prompt, and wait for the answer elsewhere."""
        if event.kind != "prompt":
            return
        can_answer = self._keyboard.answer_for(self._controls, alone=not self._linked)
        ways = ["press Enter"] * can_answer + ["resume in the console"] * self._linked
        nobody = (
            "nobody can answer, standard input is closed: the run ends. Remedy: run it in a terminal, or with --link"
        )
        with contextlib.suppress(OSError, ValueError):  # a terminal that shows nothing any more may still take answers
            self._voice.say(f"            {', or '.join(ways) or nobody}\n")


if sys.platform == "win32":
    import msvcrt

    def _forget_typed(stream: TextIO) -> None:
        """Throw away what waits in a terminal."""
        while stream.isatty() and msvcrt.kbhit():
            msvcrt.getwch()
else:
    import termios

    def _forget_typed(stream: TextIO) -> None:
        """Throw away what waits in a terminal."""
        if stream.isatty():
            with contextlib.suppress(termios.error):  # hung up; the reading thread tells
                termios.tcflush(stream, termios.TCIFLUSH)
