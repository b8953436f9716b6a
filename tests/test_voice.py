"""What is said to a terminal never holds whoever says it."""

from __future__ import annotations

import io
import threading

import pytest

from rig.observe import Ending, StepEvent, StepPhase
from rig.session import run_scene
from rig.terminal import Terminal
from rig.voice import MOST_WAITING, Voice


@pytest.fixture
def heard(monkeypatch):
    """Wait for the last words however long a busy computer takes over them."""
    monkeypatch.setattr("rig.voice.LAST_WORDS_S", 60.0)


class Frozen(io.StringIO):
    """A terminal after Ctrl-S."""

    def __init__(self):
        super().__init__()
        self.go_on = threading.Event()

    def write(self, text):
        self.go_on.wait()
        return super().write(text)


def test_a_terminal_that_takes_no_output_does_not_hold_a_run(request_for):
    stream = Frozen()
    request = request_for(observers=[Terminal(Voice(stream))])
    assert run_scene(request).exit_code == 0
    assert stream.getvalue() == ""
    stream.go_on.set()


@pytest.mark.usefixtures("heard")
def test_what_a_terminal_is_behind_with_is_bounded_and_said_in_order():
    stream = Frozen()
    voice = Voice(stream)
    for number in range(3 * MOST_WAITING):
        voice.say(f"{number}\n")
    stream.go_on.set()
    voice.finish()
    said = [int(line) for line in stream.getvalue().splitlines()]
    assert said[:MOST_WAITING] == list(range(MOST_WAITING))
    assert len(said) <= MOST_WAITING + 1


@pytest.mark.usefixtures("heard")
def test_all_is_said_when_a_run_has_ended_and_the_next_one_is_heard_too():
    stream = io.StringIO()
    terminal = Terminal(Voice(stream))
    for reason in ("done", "again"):
        terminal.step(StepEvent(StepPhase.STARTED, "tare", 0))
        terminal.finished(Ending(reason, 0, 10))
        assert stream.getvalue().endswith(f"ended: {reason}\n")


@pytest.mark.usefixtures("heard")
def test_a_terminal_that_is_gone_is_told_to_whoever_speaks_next():
    stream = io.StringIO()
    voice = Voice(stream)
    stream.close()
    voice.say("first")
    voice.finish()
    with pytest.raises(ValueError, match="closed file"):
        voice.say("second")
