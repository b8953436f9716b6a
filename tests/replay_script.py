"""Drives a replay in the console's window; run by a test in a process of its own."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

from PySide6.QtWidgets import QApplication

from rig.console.window import Console
from rig.recording import load_recording


def say(word: str) -> None:
    """Tell the test how far it has come."""
    sys.stdout.write(f"{word}\n")


def main() -> None:
    application = QApplication([])
    window = Console(["sphere-60mm-low"])
    window.show()

    def until(condition: Callable[[], object]) -> None:
        while not condition():
            if window.state.text() in ("failed", "link lost"):
                raise RuntimeError(window.banner.text())
            application.processEvents()
            time.sleep(0.002)

    recording = load_recording(Path(sys.argv[1]))
    window.replay(Path(sys.argv[1]))
    until(lambda: window.story is not None and window.story.ending is not None)
    story = window.story
    assert story is not None
    assert story.end == recording.force.size
    assert (story.force.values == recording.force).all()
    assert len(story.predictions) == len(recording.predictions) > 0
    assert window.transport.isVisible()
    assert not window.controls.isVisible()
    assert not window.emergency.isEnabled()
    say("loaded")
    assert window.playhead.sample < story.end  # it does not run ahead by itself
    window.playhead.playing = False
    say("paused")
    window.jump(0.5)
    here = window.playhead.sample
    assert here == story.end // 2
    window.transport.forward.click()
    assert window.playhead.sample == here + story.info.frame_samples
    window.transport.back.click()
    assert window.playhead.sample == here
    say("stepped")
    retract = next(event.sample for event in story.steps if event.name == "retract")
    window.jump(0.0)
    until(lambda: window.clock.text() == "0:00")
    while window.playhead.sample < retract:
        window.transport.next.click()
    until(lambda: window.strip.active == "retract")
    say("jumped")
    window.transport.speed.setCurrentIndex(window.transport.speed.count() - 1)
    window.transport.play.click()
    until(lambda: window.state.text() == "done")
    assert "measured" in window.prediction.measured.text()
    say("played")
    window.transport.leave.click()
    until(window.controls.isVisible)
    say("left")
    window.close()


if __name__ == "__main__":
    main()
