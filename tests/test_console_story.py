"""What the console makes of what a run tells: at the end, and anywhere before it."""

from __future__ import annotations

import math

import numpy as np
import publisher
import pytest

from rig.console.playhead import Playhead
from rig.console.story import Story
from rig.console.timing import durations, time_left, time_to_pull_off
from rig.console.words import condition, duration, fraction, number, progress
from rig.observe import Ending, Event, StepEvent, StepPhase, StepPlan
from rig.wire import Gap, samples_of
from sequences.frame import Frame


def told(*, pressure: bool = True, every: int = 3) -> tuple[Story, list[Frame]]:
    """A whole synthetic run, its frames in messages of ``every``."""
    story, frames, batch = Story(publisher.info(pressure=pressure)), [], []
    for message in publisher.run(pressure=pressure):
        if isinstance(message, Frame):
            frames.append(message)
            batch.append(message)
            if len(batch) == every:
                story.add(samples_of(batch))
                batch = []
        else:
            if batch:
                story.add(samples_of(batch))
                batch = []
            story.add(message)
    return story, frames


@pytest.fixture(scope="module")
def whole() -> tuple[Story, list[Frame]]:
    return told()


def test_every_sample_is_kept_with_the_height_it_was_taken_at(whole: tuple[Story, list[Frame]]) -> None:
    story, frames = whole
    np.testing.assert_array_equal(story.force.values, np.concatenate([frame.force for frame in frames]))
    assert story.pressure is not None
    assert len(story.pressure) == len(story.height) == story.end == frames[-1].stop
    for frame in frames[1::97]:
        assert story.height.values[frame.stop - 1] == pytest.approx(frame.stage.position)
    start, stop = story.retraction(story.at(story.end))
    assert np.all(np.diff(story.height.values[start:stop]) > 0)


def test_a_moment_in_the_past_shows_what_was_seen_then(whole: tuple[Story, list[Frame]]) -> None:
    story, _ = whole
    middle = next(event for event in story.steps if event.name == "retract").sample + 5000
    moment, end = story.at(middle), story.at(story.end)
    assert moment.step is not None
    assert moment.step.name == "retract"
    assert list(moment.done) == ["tare", "approach", "preload", "dwell", "pressurize"]
    assert moment.prediction is not None
    assert moment.prediction.sample <= middle
    assert moment.ending is None
    assert moment.events < end.events
    assert end.ending == Ending("done", 0, story.end, end.ending.features if end.ending else {})
    assert end.step is None
    assert moment.speed == pytest.approx(publisher.SPEED, rel=1e-6)


def test_force_is_tared_and_pull_off_is_measured(whole: tuple[Story, list[Frame]]) -> None:
    story, _ = whole
    resting = story.at(next(event for event in story.steps if event.name == "approach").sample + 100)
    assert resting.force_zero == pytest.approx(publisher.FORCE_ZERO, abs=3e-4)
    assert resting.force == pytest.approx(0.0, abs=2e-3)
    assert story.measured(resting) is None
    measured = story.measured(story.at(story.end))
    assert measured is not None
    peak = -publisher.truth(np.linspace(0, publisher.PULL_OFF_DISTANCE, 2000)).min()
    assert measured[0] == pytest.approx(peak, rel=0.01)


def test_missed_messages_leave_a_gap_and_a_true_time_axis() -> None:
    _, frames = told()
    story = Story(publisher.info())
    story.add(samples_of(frames[:5]))
    story.add(Gap(2))
    story.add(samples_of(frames[9:12]))
    assert story.missed == 2
    assert story.end == frames[11].stop
    assert np.isnan(story.force.values[frames[5].start : frames[9].start]).all()
    np.testing.assert_array_equal(story.force.values[frames[9].start :][:20], frames[9].force)


def test_a_scene_without_pressure_has_none() -> None:
    story, _ = told(pressure=False)
    moment = story.at(story.end)
    assert story.pressure is None
    assert moment.pressure is None
    assert moment.pump is None


def test_time_left_comes_from_the_plan_the_prediction_and_earlier_repeats(whole: tuple[Story, list[Frame]]) -> None:
    story, _ = whole
    known = durations(story)
    assert known == pytest.approx({name: seconds for name, _, seconds in publisher.STEPS})
    total = sum(known.values())
    for sample in (1000, 8000, 14_000):
        moment = story.at(sample)
        assert time_left(story, moment, known) == pytest.approx(total - sample / 1000, abs=0.1)
    assert time_left(story, story.at(story.end), known) == 0.0
    retracting = story.at(20_000)
    assert retracting.stage is not None
    way = publisher.CONTACT + retracting.prediction.pull_off_distance.value - retracting.stage.position  # type: ignore[union-attr]
    assert time_to_pull_off(retracting) == pytest.approx(way / publisher.SPEED, rel=1e-3)
    assert math.isnan(time_to_pull_off(story.at(1000)))


def test_conditions_in_words() -> None:
    plan = StepPlan("preload", "force reaches 0.5 N")
    assert condition(plan, None) == "preload: until force reaches 0.5 N"
    event = StepEvent(StepPhase.PROGRESS, "preload", 0, "", 0.31, 0.5, "N")
    assert condition(plan, event) == "preload 0.31 of 0.50 N"
    assert fraction(event) == pytest.approx(0.62)
    pressure = StepEvent(StepPhase.PROGRESS, "pressurize", 0, "", -1600.0, -3200.0, "Pa")
    assert progress(pressure) == "\N{MINUS SIGN}1.60 of \N{MINUS SIGN}3.20 kPa"
    assert number(float("nan"), 2) == "\N{EN DASH}"
    assert [duration(s) for s in (0, 61.4, 3661, -1)] == ["0:00", "1:01", "1:01:01", "\N{EN DASH}"]


def test_the_playhead_plays_pauses_steps_and_jumps() -> None:
    head = Playhead(live=False)
    head.playing, head.speed = True, 10.0
    assert head.advance(0.5, 1000.0, 100_000) == 5000
    head.playing = False
    assert head.advance(9.0, 1000.0, 100_000) == 5000
    head.step(20, 100_000)
    assert head.sample == 5020
    head.jump(1e9, 100_000)
    assert head.sample == 100_000
    head.jump(-5, 100_000)
    head.playing, head.speed = True, math.inf
    assert head.advance(0.001, 1000.0, 100_000) == 100_000
    assert Playhead(live=True).advance(0.0, 1000.0, 777) == 777


def test_what_a_run_waits_for_is_its_own_word() -> None:
    story = Story(publisher.info())
    assert story.waiting(story.at(0)) == ""
    for kind, text, expected in (
        ("operator", "hold", "hold"),
        ("note", "still here", "hold"),
        ("operator", "resume", ""),
        ("prompt", "hang 20 g", "hang 20 g"),
        ("operator", "resume", ""),
    ):
        story.add(Event(0, kind, text))
        assert story.waiting(story.at(0)) == expected
