"""How long a run will still take: from the plan, the prediction, and the repeats that are already over."""

from __future__ import annotations

import numpy as np

from rig.console.story import Moment, Story
from rig.observe import StepPhase

_GUESS_S = {"approach": 20.0, "preload": 3.0, "pressurize": 8.0, "retract": 120.0, "pull-off": 8.0, "return": 8.0}
_NAMED = {"tare": "tare_s", "dwell": "preload_dwell_s"}


def durations(story: Story) -> dict[str, float]:
    """Return how long each finished step took, s."""
    begun: dict[str, int] = {}
    took: dict[str, float] = {}
    for event in story.steps:
        if event.phase is StepPhase.STARTED:
            begun[event.name] = event.sample
        elif event.phase is StepPhase.ENDED and event.name in begun:
            took[event.name] = (event.sample - begun[event.name]) / story.rate
    return took


def time_left(story: Story, moment: Moment, known: dict[str, float]) -> float:
    """Return the sample time left in this run and its repeats, s; ``known`` holds durations of an earlier repeat."""
    if moment.ending is not None:
        return 0.0
    expected = {plan.name: _expected(story, plan.name, known) for plan in story.info.plan}
    left = sum(seconds for name, seconds in expected.items() if name not in moment.done)
    if moment.step is not None and moment.step.name not in moment.done:
        left -= min(_elapsed(story, moment), expected.get(moment.step.name, 0.0))
        if moment.step.name == "retract":
            left += _correction(moment, expected["retract"] - _elapsed(story, moment))
    return left + sum(expected.values()) * (story.info.repeats - story.info.repeat)


def time_to_pull_off(moment: Moment) -> float:
    """Return when pull-off is expected at the present speed, s from now; ``nan`` when it is not."""
    prediction = moment.prediction
    if prediction is None or moment.stage is None or moment.step is None or moment.step.name != "retract":
        return np.nan
    if not moment.speed > 1e-7:
        return np.nan
    left = prediction.zero_height + prediction.pull_off_distance.value - moment.stage.position
    return max(0.0, left / moment.speed)


def _correction(moment: Moment, planned: float) -> float:
    better = time_to_pull_off(moment)
    return 0.0 if np.isnan(better) else better - max(0.0, planned)


def _elapsed(story: Story, moment: Moment) -> float:
    begun = [sample for sample, _ in story.boundaries(moment)]
    return (moment.sample - begun[-1]) / story.rate if begun else 0.0


def _expected(story: Story, name: str, known: dict[str, float]) -> float:
    if name in known:
        return known[name]
    key = _NAMED.get(name)
    value = story.info.scene.get("protocol", {}).get(key) if key else None
    return float(value) if value is not None else _GUESS_S.get(name, 5.0)
