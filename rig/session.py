"""One run from scene and bench to the closed recording. Every way out leads through the safe state."""

from __future__ import annotations

import json
import os
import platform
import signal
import threading
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from drivers.errors import DeviceError
from rig.bench import Bench
from rig.check import check, parking
from rig.commanded import CommandedPump, CommandedStage
from rig.errors import FileError, Interlock, Refused, RigError, StoppedByOperator
from rig.instruments import Opened, open_instruments
from rig.interlocks import Interlocks, limits_of
from rig.loop import Instruments, Loop, Reporter
from rig.observe import Controls, Ending, Observer, RunInfo, StepPlan, Wish
from rig.protocols import apparatus_of, build_steps
from rig.recorder import Recorder, insist_on_new
from rig.recovery import recover
from rig.safe_state import make_safe, release
from rig.scene import Scene
from rig.undisturbed import undisturbed
from rig.voice import say
from rig.writer import this_process
from sequences.errors import StepFailed
from sequences.reference import reference
from sequences.step import Step, play

if TYPE_CHECKING:
    from drivers.emulated.faults import Faults

PROGRAM_ERROR = 70
"""Exit code of a run that a defect of the program itself has ended."""

_ENDING_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
"""What asks a program to end: Ctrl-C, the system, a closed terminal; Ctrl-Break on Windows."""

_REPORTED = (DeviceError, RigError, StepFailed)
_LIBRARIES = ("membrane-adhesion-rig", "numpy", "h5py", "pipython", "pyserial", "nidaqmx", "grpcio")


@dataclass
class Request:
    """What to run.

    Attributes
    ----------
    scene_text, bench_text
        The files as they were read; they are kept in the recording.
    out
        The recording, which must not exist; afterwards where it lies, for its place may have been taken meanwhile.
    live
        Whether to predict live where the papers have a model.
    observers, controls
        Who is told of everything, and how the operator speaks to the run.
    place
        Position on the membrane, or sample, where a protocol names several.
    hands
        What the operator is asked to do before the first step, while the instruments are open.
    repeat, repeats
        Which of how many tests of this scene in a row, from 1.
    seed, speed, wire, faults, referenced
        For the emulated bench only: ``speed`` in times real time, ``None`` as fast as possible; ``wire`` false puts
        the instruments straight on the plant; ``referenced`` is a stage that has not been off since its reference move.
    """

    scene: Scene
    scene_text: str
    bench: Bench
    bench_text: str
    out: Path
    seed: int = 0
    speed: float | None = None
    wire: bool = True
    live: bool = True
    faults: Faults | None = None
    referenced: bool = False
    observers: Iterable[Observer] = ()
    controls: Controls = field(default_factory=Controls)
    repeat: int = 1
    repeats: int = 1
    place: str = ""
    hands: str = ""


def run_scene(request: Request) -> Ending:
    """Run one scene and record it.

    Raises
    ------
    RigError, DeviceError
        Before the recording has begun; nothing has moved but, where the bench allows it, the reference move.
        Afterwards every failure is in the returned ending and in the recording.
    """
    check(request.scene, request.bench)
    insist_on_new(request.out)
    opened = open_instruments(request)
    ending: Ending | None = None
    with _signals(request.controls, opened):
        try:
            _make_ready(request, opened)
            ending = _recorded(request, opened)
            return ending
        finally:
            _leave(opened, ending)


def reference_only(request: Request) -> float:
    """Reference the stage, park it, and return where it stands, m. Only on the operator's explicit word."""
    opened = open_instruments(request)
    with _signals(request.controls, opened):
        try:
            reference_stage(request, opened)
            return opened.stage.status().position
        finally:
            _leave(opened)


def _leave(opened: Opened, ending: Ending | None = None) -> None:
    """Stop everything once more, close every port, and say what failed unless the ending has said so."""
    failures = make_safe(opened.stage, opened.pump, opened.daq)
    failures += release(opened.stage, opened.pump, opened.daq)
    opened.shut_down()
    told = "" if ending is None else ending.reason
    for failure in failures:
        if failure.partition(" failed")[0] not in told:
            say(f"rig: {failure}. Remedy: switch the device off by hand.")


def _recorded(request: Request, opened: Opened) -> Ending:
    reporter = Reporter([*request.observers, *opened.observers])
    stage, pump = _commanded(request, opened, reporter)
    apparatus = apparatus_of(request.bench, stage, pump, reporter)
    steps = build_steps(request.scene, apparatus, request.hands)
    info = _info(request, opened, steps)
    journalled = request.bench.recording.survives_power_cut
    daq = opened.daq
    recorder = Recorder(request.out, info, daq.channels, daq.units, _metadata(request), journalled=journalled)
    reporter.store = recorder
    if request.live:
        add_live_prediction(reporter, request.scene, request.bench, virtual=opened.virtual)
    ending = Ending("failed before the first frame", 1, 0)
    loop = _loop(request, opened, Instruments(stage, pump, opened.daq, opened.clock), reporter, recorder)
    try:
        reporter.notify("started", info)
        with nullcontext("") if opened.virtual else undisturbed() as precedence:
            if precedence:
                reporter.event("timing", precedence)
            ending = _play(loop, steps, reporter)
    finally:
        failures = make_safe(stage, pump, opened.daq)
        reporter.event("timing", _timing(loop, virtual=opened.virtual))
        ending = _finish(recorder, reporter, ending, failures, loop.samples)
        request.out = recorder.path
    reporter.store = None  # closed
    reporter.notify("finished", ending)
    return ending


def _commanded(request: Request, opened: Opened, reporter: Reporter) -> tuple[CommandedStage, CommandedPump | None]:
    """Return stage and pump as the steps command them: every command is logged, none follows an emergency stop."""

    def log(text: str) -> None:
        reporter.event("command", text)

    def insist() -> None:
        if request.controls.emergency:
            raise StoppedByOperator(f"{Wish.EMERGENCY.value} by the operator in step {reporter.step}")

    pump = None if opened.pump is None else CommandedPump(opened.pump, log, insist)
    return CommandedStage(opened.stage, log, insist), pump


def _timing(loop: Loop, *, virtual: bool) -> str:
    """Return how long the interlocks took and how old the samples were that they passed."""
    clock = "the plant's clock, which waits for the program" if virtual else "the bench's clock"
    return (
        f"frame to interlocks passed: {loop.checks.describe()} of {loop.checks.count} frames; "
        f"age of a frame's oldest sample then: {loop.ages.describe()} by {clock}"
    )


def add_live_prediction(reporter: Reporter, scene: Scene, bench: Bench, *, virtual: bool) -> None:
    """Predict live where the papers have a model: pull-off with the rigid gripper."""
    if scene.protocol.name != "pull_off" or scene.gripper.kind != "rigid":
        return
    from rig.live_run import live

    compliance = bench.force.compliance_um_per_N * 1e-6
    try:
        reporter.add(live(scene.parameters(), reporter.prediction, virtual=virtual, compliance=compliance))
    except OSError as error:  # the test goes on without it
        reporter.event("warning", f"no live prediction: its process cannot be started ({error})")


def _play(loop: Loop, steps: list[Step], reporter: Reporter) -> Ending:
    try:
        loop.run(play(steps, reporter))
    except _REPORTED as error:
        kind = "interlock" if isinstance(error, Interlock) else "fault"
        where = "" if f"step {reporter.step}" in str(error) else f" (in step {reporter.step})"
        reporter.event(kind, f"{error}{where}")
        if loop.interlock_latency is not None and loop.stop_age is not None:
            after = f"{loop.interlock_latency * 1e3:.2f} ms after the frame was read"
            reporter.event("timing", f"stop sent {after}, {loop.stop_age * 1e3:.2f} ms after the sample that passed")
        return Ending(f"{error}{where}", int(getattr(error, "exit_code", 1)), loop.samples)
    except Exception as error:  # noqa: BLE001 - a defect of the program must not cost the recording or the stop
        text = f"the program has failed in step {reporter.step}: {error!r}"
        reporter.event("fault", f"{text}\n{traceback.format_exc()}")
        return Ending(f"{text}. Remedy: report it with the recording, which is complete.", PROGRAM_ERROR, loop.samples)
    return Ending("done", 0, loop.samples)


def _finish(recorder: Recorder, reporter: Reporter, ending: Ending, failures: list[str], samples: int) -> Ending:
    """Close the recording whatever has happened; a disk that is full must not hide how the run ended."""
    reason = ending.reason
    if failures:
        remedy = "switch it off by hand." if "Remedy" in reason else "Remedy: switch it off by hand."
        reason = f"{reason.rstrip('.')}. Besides, {', '.join(failures)}; {remedy}"
    samples = recorder.acknowledged if recorder.failed else samples
    ending = Ending(reason, ending.exit_code if ending.exit_code or not failures else 1, samples)
    try:
        for failure in failures:
            reporter.event("fault", failure)
        reporter.event("end", ending.reason)
        recorder.end(ending)
        recorder.close()
    except (RigError, OSError, RuntimeError) as error:
        samples = recorder.acknowledged if recorder.failed else samples
        ending = Ending(f"{ending.reason}; {error}", ending.exit_code or 2, samples)
    if recorder.failed:
        with suppress(FileError):  # no room for the copy; the ending's message names `rig recover`
            recover(recorder.path, force=True)
    return ending


def _loop(
    request: Request, opened: Opened, instruments: Instruments, reporter: Reporter, recorder: Recorder | None
) -> Loop:
    bench = request.bench
    travel = opened.stage.travel if recorder is not None else (-float("inf"), float("inf"))
    interlocks = Interlocks(limits_of(bench, travel, opened.pump is not None))
    return Loop(
        instruments,
        opened.converter(),
        interlocks,
        recorder,
        reporter,
        request.controls,
        frame_samples=bench.daq.frame_samples(opened.daq.rate),
    )


def _make_ready(request: Request, opened: Opened) -> None:
    """Reference the stage if the bench allows it, or refuse; switch the servo on."""
    if not opened.stage.referenced:
        if not request.bench.stage.reference_on_start:
            raise Refused(
                "the stage is not referenced. Remedy: take specimen and gripper out of its path and run `rig reference`"
            )
        reference_stage(request, opened)
    opened.stage.servo(True)


def reference_stage(request: Request, opened: Opened) -> None:
    """Run the reference sequence under the force interlock, without a recording."""
    reporter = Reporter(opened.observers)
    stage, _ = _commanded(request, opened, reporter)
    apparatus = apparatus_of(request.bench, stage, None, reporter)
    instruments = Instruments(stage, None, opened.daq, opened.clock)
    steps = reference(apparatus, parking(request.bench))
    try:
        _loop(request, opened, instruments, reporter, None).run(play(steps, reporter))
    finally:
        opened.daq.stop()


def _info(request: Request, opened: Opened, steps: list[Step]) -> RunInfo:
    bench, (low, high) = request.bench, opened.stage.travel
    limits = {
        "compression_N": bench.limits.compression_N,
        "tension_N": bench.limits.tension_N,
        "travel_low_m": low,
        "travel_high_m": high,
        "force_capacity_N": bench.force.capacity_N,
    }
    if opened.pump is not None and bench.pump is not None:
        slowest, fastest = opened.pump.rate_limits
        limits |= {
            "pressure_low_Pa": bench.limits.pressure_low_kPa * 1e3,
            "pressure_high_Pa": bench.limits.pressure_high_kPa * 1e3,
            "pump_slowest_m3_s": slowest,
            "pump_fastest_m3_s": fastest,
            "syringe_m3": bench.pump.syringe_volume_ml * 1e-6,
        }
    return RunInfo(
        title=request.scene.title,
        protocol=request.scene.protocol.name,
        recording=str(request.out),
        pid=os.getpid(),
        rate=opened.daq.rate,
        frame_samples=bench.daq.frame_samples(opened.daq.rate),
        uses_pressure=opened.pump is not None,
        plan=tuple(StepPlan(step.name, step.condition) for step in steps),
        limits=limits,
        scene=request.scene.model_dump(),
        identities=opened.identities(),
        virtual=opened.virtual,
        repeat=request.repeat,
        repeats=request.repeats,
    )


def _metadata(request: Request) -> dict[str, str]:
    return {
        "scene": request.scene_text,
        "bench": request.bench_text,
        "seed": str(request.seed),
        "place": request.place,
        "hands": request.hands,
        "versions": json.dumps(
            {"python": platform.python_version(), **{name: version(name) for name in _LIBRARIES}}, sort_keys=True
        ),
        "writer": this_process(),
    }


@contextmanager
def _signals(controls: Controls, opened: Opened) -> Iterator[None]:
    """Ctrl-C, SIGTERM and a closed terminal end the run in good order; a second one sends the emergency stop at once.

    Signals never raise here: the loop leaves through the safe state, undisturbed.
    """
    controls.connect(opened.stage.emergency_stop)
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    count = 0
    sending = False
    untold: list[str] = []

    def on_signal(number: int, frame: FrameType | None) -> None:
        nonlocal count, sending
        count += 1
        if count == 1:
            controls.stop()
            return
        if sending:  # this signal has interrupted the sending of the stop, and would wait for it
            return
        sending = True
        try:
            controls.emergency_stop()
        except DeviceError as error:  # the loop ends the run at its next frame all the same
            untold.append(str(error))
        finally:
            sending = False

    numbers = [getattr(signal, name) for name in _ENDING_SIGNALS if hasattr(signal, name)]
    numbers = [number for number in numbers if number.name != "SIGHUP" or signal.getsignal(number) != signal.SIG_IGN]
    before: dict[signal.Signals, Any] = {number: signal.signal(number, on_signal) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for failure in untold:
            say(f"rig: {failure}")
