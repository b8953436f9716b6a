"""The operator answers prompts from the keyboard while the loop goes on."""

from __future__ import annotations

import io
import os
import queue
import select
import time
from unittest import mock

import pytest
from conftest import scene_text
from links import TERMINALS

from rig.bench import load_bench
from rig.errors import Refused
from rig.observe import Controls, Event, Observer, Wish
from rig.operator import Keyboard, Prompts
from rig.recording import load_recording
from rig.scene import parse_scene
from rig.session import Request, run_scene
from rig.voice import Voice

PROMPT = Event(0, "prompt", "Hang 20 g on the gripper, then go on")


@pytest.fixture
def line():
    """Return a keyboard and what presses its Enter."""
    reader, writer = os.pipe()
    with os.fdopen(reader, "r") as stream, os.fdopen(writer, "w", buffering=1) as press:
        yield Keyboard(stream), press


def taken(controls):
    """Return the operator's next wish."""
    while (wish := controls.take()) is Wish.NONE:
        time.sleep(0.001)
    return wish


def test_enter_resumes_the_run_that_asked(line):
    keyboard, press = line
    controls = Controls()
    Prompts(keyboard, controls, Voice()).event(PROMPT)
    press.write("\n")
    assert taken(controls) is Wish.RESUME
    press.close()


def test_only_a_prompt_is_answered(line):
    keyboard, press = line
    controls = Controls()
    Prompts(keyboard, controls, Voice()).event(Event(0, "warning", "the load is high"))
    press.write("\n")
    press.close()
    assert controls.take() is Wish.NONE


def test_between_runs_the_program_waits_for_enter(line, monkeypatch):
    keyboard, press = line

    class Terminal(io.StringIO):
        """Presses Enter once and hangs up, when the question is on the screen."""

        def flush(self):
            if not press.closed:
                press.write("\n")
                press.close()

    monkeypatch.setattr("sys.stderr", terminal := Terminal())
    keyboard.confirm("Mount the 60 mm sphere.")
    assert terminal.getvalue() == "Mount the 60 mm sphere. Press Enter to go on. "
    with pytest.raises(Refused, match="Mount the flat"):
        keyboard.confirm("Mount the flat.")


def test_an_enter_pressed_before_the_question_does_not_answer_it(line):
    keyboard, press = line
    press.write("\n\n")
    press.close()
    keyboard.answer_for(controls := Controls())
    assert taken(controls) is Wish.RESUME
    while keyboard.answer_for(controls):
        time.sleep(0.001)
    with pytest.raises(Refused, match="Nobody can answer"):
        keyboard.confirm("Mount the 60 mm sphere.")


@TERMINALS
def test_an_enter_typed_before_the_first_question_does_not_answer_it():
    read = queue.Queue()

    class Told(io.TextIOWrapper):
        """A terminal that tells what is read from it."""

        def __next__(self):
            read.put(line := super().__next__())
            return line

    hand, terminal = os.openpty()
    os.write(hand, b"too early\nand half a line")
    select.select([terminal], [], [])
    stream = Told(os.fdopen(terminal, "rb"))
    keyboard, controls = Keyboard(stream), Controls()
    try:
        keyboard.answer_for(controls)
        os.write(hand, b"in time\n")
        assert read.get(timeout=60) == "in time\n"
        assert taken(controls) is Wish.RESUME
        keyboard.answer_for(controls)
    finally:
        os.close(hand)
    assert taken(controls) is Wish.STOP
    stream.close()


def test_without_standard_input_nobody_can_answer(monkeypatch):
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(Refused, match="Nobody can answer"):
        Keyboard().confirm("Mount the sphere.")


def test_a_prompt_is_answered_where_its_words_reach_nobody(line):
    keyboard, press = line
    controls = Controls()
    gone = mock.Mock(say=mock.Mock(side_effect=BrokenPipeError))
    Prompts(keyboard, controls, gone).event(PROMPT)
    press.write("\n")
    assert taken(controls) is Wish.RESUME
    press.close()


def test_a_closed_keyboard_refuses_and_names_the_console(capsys, monkeypatch):
    monkeypatch.setattr("rig.voice.LAST_WORDS_S", 60.0)  # however busy this computer is
    keyboard = Keyboard(io.StringIO(""))
    with pytest.raises(Refused, match="Nobody can answer"):
        keyboard.confirm("Mount the sphere.")
    for linked in (False, True):
        controls, voice = Controls(), Voice()
        Prompts(keyboard, controls, voice, linked=linked).event(PROMPT)
        voice.finish()
        words = "resume in the console" if linked else "nobody can answer"
        assert words in capsys.readouterr().err.splitlines()[-1]
        assert controls.take() is (Wish.NONE if linked else Wish.STOP)


def test_a_question_ends_the_run_when_the_keyboard_is_closed_while_it_waits(line):
    keyboard, press = line
    controls = Controls()
    assert keyboard.answer_for(controls)
    assert controls.take() is Wish.NONE
    press.close()
    assert taken(controls) is Wish.STOP


def test_a_run_waits_at_a_prompt_and_keeps_recording(tmp_path, line, monkeypatch):
    keyboard, press = line
    controls = Controls()

    class Operator(Observer):
        """Takes half a second of the bench's time over everything."""

        asked_at = None

        def event(self, event):
            if event.kind == "prompt":
                self.asked_at = event.sample

        def frame(self, frame):
            if self.asked_at is not None and frame.stop >= self.asked_at + 500:
                self.asked_at = None
                press.write("\n")

    monkeypatch.setattr("rig.emulation.Hands.event", Observer.event)
    bench, bench_text = load_bench(None)
    text = scene_text("pressure-zero", rest_s=0.5)
    observers = [Prompts(keyboard, controls, Voice()), Operator()]
    out = tmp_path / "run.h5"
    request = Request(
        parse_scene(text, "scene"), text, bench, bench_text, out,
        wire=False, live=False, controls=controls, observers=observers,
    )  # fmt: skip
    assert run_scene(request).exit_code == 0
    press.close()
    steps = {step.name: step for step in load_recording(out).step_table()}
    assert steps["open"].stop - steps["open"].start >= 500
    assert steps["zero"].stop - steps["zero"].start >= 500
