"""A replay from the recording to its end: the loop, interlocks, observers and analysis of a run."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass

from drivers.errors import DeviceError
from rig.commanded import CommandedPump, CommandedStage
from rig.errors import RigError
from rig.instruments import sensor_converter
from rig.interlocks import Interlocks, limits_of
from rig.loop import Instruments, Loop, Reporter
from rig.observe import Ending, Observer, RunInfo, StepPlan
from rig.protocols import build_steps
from rig.recording import Recording
from rig.replay import EndOfRecording, Pace, ReplayedControls, ReplayedDaq, ReplayedPump, ReplayedStage, Verification
from rig.safe_state import make_safe
from sequences.errors import StepFailed
from sequences.step import Apparatus, play


@dataclass(frozen=True)
class Outcome:
    """How a replay ended, and where it differs from the recording."""

    ending: Ending
    differences: tuple[str, ...]


def replay(
    recording: Recording,
    *,
    pace: Pace,
    observers: Iterable[Observer] = (),
) -> Outcome:
    """Feed a recording through the loop.

    The sequence makes its decisions again from the recorded frames; what it commands goes nowhere but into the log.
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
    apparatus = Apparatus(instruments.stage, instruments.pump, reporter, bench.limits.look_ahead_um * 1e-6)
    steps = build_steps(recording.scene, apparatus)
    loop = Loop(
        instruments,
        sensor_converter(bench, pump is not None, recording.rate),
        Interlocks(limits_of(bench, stage.travel, pump is not None)),
        verification,
        reporter,
        ReplayedControls(recording, lambda: reporter.sample),
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
    return Outcome(ending, tuple(verification.finish()))


def _info(recording: Recording) -> RunInfo:
    """Return what the run said of itself, for this process and this file."""
    info = {**recording.info, "pid": os.getpid(), "recording": str(recording.path)}
    return RunInfo(**{**info, "plan": tuple(StepPlan(**step) for step in info["plan"])})
