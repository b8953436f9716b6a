"""A replay from the recording to its end: the loop, interlocks, observers and analysis of a run."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from drivers.errors import DeviceError
from model.parameters import Parameters
from rig.commanded import CommandedPump, CommandedStage
from rig.errors import FileError, RigError
from rig.instruments import sensor_converter
from rig.interlocks import Interlocks, limits_of
from rig.loop import Instruments, Loop, Reporter
from rig.observe import Controls, Ending, Observer, RunInfo, StepPlan
from rig.protocols import apparatus_of, build_steps
from rig.recording import Recording
from rig.replay import EndOfRecording, Pace, ReplayedControls, ReplayedDaq, ReplayedPump, ReplayedStage, Verification
from rig.safe_state import make_safe
from rig.scene import Scene
from rig.validation import Section, validated
from sequences.errors import StepFailed
from sequences.step import play


@dataclass(frozen=True)
class Outcome:
    """How a replay ended, and where it differs from the recording."""

    ending: Ending
    differences: tuple[str, ...]


@dataclass(frozen=True)
class WhatIf:
    """Other parameters and another model for the live prediction of a replay."""

    parameters: Parameters
    model: str = "cone"


def replay(
    recording: Recording,
    *,
    pace: Pace,
    observers: Iterable[Observer] = (),
    controls: Controls | None = None,
    live: bool = True,
    what_if: WhatIf | None = None,
) -> Outcome:
    """Feed a recording through the loop.

    The sequence makes its decisions again from the recorded frames; what it commands goes nowhere but into the log.

    Parameters
    ----------
    live
        Make the live predictions again: those of the recording, or others by ``what_if``.
    controls
        What the operator asks for now, besides what was asked for then.
    """
    reporter = Reporter(observers)
    daq, stage = ReplayedDaq(recording, pace), ReplayedStage(recording)
    pump = None if recording.pump is None else ReplayedPump(recording)
    instruments = Instruments(
        CommandedStage(stage, lambda text: reporter.event("command", text)),
        None if pump is None else CommandedPump(pump, lambda text: reporter.event("command", text)),
        daq,
        daq.clock,
    )
    verification = Verification(recording)
    reporter.store = verification
    bench = recording.bench
    apparatus = apparatus_of(bench, instruments.stage, instruments.pump, reporter)
    steps = build_steps(recording.scene, apparatus, recording.configuration.get("hands", ""))
    if live and (what_if is not None or len(recording.predictions)):
        reporter.add(_live(recording, reporter, what_if))
    loop = Loop(
        instruments,
        sensor_converter(bench, pump is not None, recording.rate),
        Interlocks(limits_of(bench, stage.travel, pump is not None)),
        verification,
        reporter,
        ReplayedControls(recording, lambda: reporter.sample, controls),
        frame_samples=int(recording.info["frame_samples"]),
    )
    reporter.notify("started", _info(recording))
    reason = "done"
    try:
        loop.run(play(steps, reporter))
    except EndOfRecording:
        reason = recording.ending[0] if recording.ending else "the recording ends here"
    except (RigError, DeviceError, StepFailed) as error:
        reason = str(error)
    make_safe(instruments.stage, instruments.pump, daq)
    ending = Ending(reason, recording.ending[1] if recording.ending else 1, loop.samples)
    reporter.notify("finished", ending)
    return Outcome(ending, tuple(verification.finish(predictions=live and what_if is None)))


def _live(recording: Recording, reporter: Reporter, what_if: WhatIf | None) -> Observer:
    """Return what predicts: from the same frames as then, or anew for a 'what if'."""
    from rig.live_run import live_again, live_what_if

    compliance = recording.bench.force.compliance_um_per_N * 1e-6
    if what_if is not None:
        return live_what_if(what_if.parameters, reporter.prediction, model=what_if.model, compliance=compliance)
    recorded = [(int(row["sample"]), row["json"].decode()) for row in recording.predictions]
    return live_again(recording.scene.parameters(), reporter.prediction, recorded, compliance=compliance)


def _info(recording: Recording) -> RunInfo:
    """Return what the run said of itself, for this process and this file."""
    info = {**recording.info, "pid": os.getpid(), "recording": str(recording.path)}
    return RunInfo(**{**info, "plan": tuple(StepPlan(**step) for step in info["plan"])})


def what_if(recording: Recording, model: str | None, changes: Sequence[str]) -> WhatIf | None:
    """Return another model or scene values replaced, ``KEY=VALUE`` each; ``None`` for no change.

    Raises
    ------
    FileError
        The key is unknown or the value impossible, as in a scene file.
    """
    if not changes and model is None:
        return None
    content = tomllib.loads(recording.configuration["scene"])
    for change in changes:
        key, _, value = change.partition("=")
        *tables, name = key.strip().split(".")
        table = content
        for part in tables or [_table_of(recording.scene, name)]:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise FileError(f"{change}: {part} of the scene is no table. Remedy: name a key of the scene file.")
        try:
            table[name] = float(value)
        except ValueError:
            table[name] = value.strip()
    scene = validated(Scene, "scene", content, f"{recording.path} with {', '.join(changes)}")
    return WhatIf(scene.parameters(), model or "cone")


def _table_of(scene: Scene, key: str) -> str:
    """Return the table of the scene that has this key; an unknown key is left to the scene's own check."""
    for name, section in scene:
        if isinstance(section, Section) and key in type(section).model_fields:
            return name
    return "membrane"
