"""The fault matrix: every step of a pull-off test times every fault, each cell run and judged.

A cell is safe when stage and pump are at rest afterwards, the plant's true force has stayed within the limits, the
recording opens with plain h5py and holds every acknowledged sample as the DAQ delivered it, and the run has ended
either undisturbed or with one message that names the instrument, the step and the remedy.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import signal
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import h5py
import numpy as np
from conftest import SHORT, scene_text

import rig.emulation
import rig.session
from drivers.emulated.bench import EmulatedBench, Endpoints
from drivers.emulated.faults import Fault, Faults
from rig.bench import load_bench
from rig.observe import Controls, Ending, Observer, StepPhase
from rig.recorder import Recorder
from rig.recording import load_recording
from rig.scene import Scene
from rig.session import Request, run_scene

STEPS = ("tare", "approach", "preload", "dwell", "pressurize", "retract", "pull-off", "return")
TO_PRESSURIZE = STEPS[:5]
REPEATED = ("preload", "pressurize", "retract")
MOVING = ("approach", "preload", "retract", "pull-off", "return")
PROTOCOL = {**SHORT, "tare_s": 0.3, "preload_dwell_s": 0.5, "retract_speed_um_s": 200.0}
LIMIT = load_bench(None)[0].limits.compression_N
PATIENCE_MS = 1000.0
"""Longer than the benches' time-outs: the computer of a test may be busy."""
LATER = 100
"""Samples between the beginning of a step and the fault."""

LOOK_AHEAD = 50e-6
AT_REST = 5e-6
"""What a stage may still travel after its stop: from 500 um/s the brake and the lag of the servo take 3 um, m."""
AFTERWARDS = 30.0
"""Plant seconds watched after the run."""


@dataclass
class Stage:
    """Where a cell is played: what an act may lay its hands on while the run goes on."""

    request: Request
    bench: EmulatedBench | None = None
    recorder: Recorder | None = None
    volts: list[np.ndarray] = field(default_factory=list)
    broken: set[str] = field(default_factory=set)
    leave: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)


@dataclass(frozen=True)
class Trouble:
    """One row of the matrix.

    Attributes
    ----------
    title
        In the operator's words.
    names
        Words of which the message must hold one: the instrument.
    codes
        Exit codes that are right for it.
    faults
        (device, kind, value) for the fault script.
    act
        What is done at the step instead: receives the stage of the cell.
    wire
        Played over the wire; ``"terminal"`` on pseudo-terminals.
    harms
        Steps in which the run has to end; elsewhere it may go on, unharmed.
    steps
        Steps in which it is played: what the direct back end plays everywhere, the wire repeats in three.
    cut_off
        Instruments that a stop cannot reach: they end their motion by themselves.
    """

    title: str
    names: tuple[str, ...]
    codes: tuple[int, ...]
    faults: tuple[tuple[str, str, float], ...] = ()
    act: Callable[[Stage], None] | None = None
    wire: bool | str = False
    harms: Sequence[str] = STEPS
    steps: Sequence[str] = STEPS
    cut_off: tuple[str, ...] = ()


def _links(device: str) -> Iterator[Trouble]:
    words = (f"{device}:",)
    for wire in (False, True):
        where = ", on the wire" if wire else ""
        steps = REPEATED if wire else STEPS
        yield Trouble(f"{device} silent{where}", words, (6,), ((device, "silent", 0),), wire=wire, steps=steps)
        yield Trouble(
            f"{device} unplugged{where}",
            words,
            (6,),
            ((device, "unplugged", 0),),
            wire=wire,
            steps=steps,
            cut_off=(device,),
        )
        yield Trouble(f"{device} sends garbage{where}", words, (6,), ((device, "garbage", 0),), wire=wire, steps=steps)
    yield Trouble(f"{device} slow: replies after 4 s", words, (6,), ((device, "slow", 4.0),), wire=True)
    yield Trouble(f"{device} answers late (stale replies)", words, (6,), ((device, "late", 0),), wire=True)


def cells(*, wire: bool | None = None) -> list[tuple[Trouble, str]]:
    """Return every cell; ``wire`` keeps those that are played over a wire, or those that are not."""
    rows = sorted(troubles(), key=lambda trouble: bool(trouble.wire))
    return [(trouble, step) for trouble in rows if wire in (None, bool(trouble.wire)) for step in trouble.steps]


def _press(number: signal.Signals, times: int) -> Callable[[Stage], None]:
    def act(_: Stage) -> None:
        for _count in range(times):
            signal.raise_signal(number)

    return act


def _break(method: str) -> Callable[[Stage], None]:
    def act(stage: Stage) -> None:
        stage.broken.add(method)

    return act


def _break_and_stop(method: str) -> Callable[[Stage], None]:
    def act(stage: Stage) -> None:
        stage.broken.add(method)
        stage.request.controls.stop()

    return act


def _fill_the_disk(stage: Stage) -> None:
    """Nearly no room is left; the recorder sees it before HDF5 does."""
    usage = mock.patch("shutil.disk_usage", return_value=mock.Mock(free=1 << 20))
    stage.leave.enter_context(usage)


def _write_to(path: str, flags: int) -> Callable[[Stage], None]:
    """Let the recording's writes go elsewhere, where each fails: on a file open for reading (EBADF), on /dev/full."""

    def act(stage: Stage) -> None:
        assert stage.recorder is not None
        held = os.open(path or stage.request.out, flags)
        os.dup2(held, stage.recorder._file.id.get_vfd_handle())
        os.close(held)

    return act


def _remove_the_file(stage: Stage) -> None:
    stage.request.out.unlink()


def troubles() -> list[Trouble]:
    """Return every row of the matrix."""
    stage, pump, daq = ("stage:",), ("pump",), ("daq:",)
    cell, sensor = ("force", "load cell"), ("pressure",)
    rows = [
        *_links("stage"),
        Trouble("stage answers error 2", stage, (6,), (("stage", "error_code", 2),), harms=MOVING),
        Trouble("stage stalls (-1024)", stage, (6,), (("stage", "blocked", 0),)),
        Trouble("stage: negative limit switch", stage, (6,), (("stage", "limit_switch", -1),)),
        Trouble("stage: positive limit switch", stage, (6,), (("stage", "limit_switch", 1),)),
        Trouble("stage loses its servo", stage, (6,), (("stage", "servo_lost", 0),)),
        Trouble("stage controller reboots", stage, (6,), (("stage", "rebooted", 0),)),
        Trouble(
            "stage controller reboots, on the wire",
            stage,
            (6,),
            (("stage", "rebooted", 1.0),),
            wire=True,
            steps=REPEATED,
        ),
        *_links("pump"),
        Trouble("pump answers with an error", pump, (6,), (("pump", "error", 0),), harms=TO_PRESSURIZE),
        Trouble("pump stalls", pump, (4, 6), (("pump", "stalled", 0),), harms=TO_PRESSURIZE),
        Trouble("pump reports its target early", pump, (4, 6), (("pump", "target_early", 0.3),), harms=TO_PRESSURIZE),
        Trouble("pump touched at its screen", pump, (6,), (("pump", "touched", 0),), harms=()),
        Trouble("pump told of another syringe", pump, (6,), (("pump", "wrong_syringe", 20.0),), harms=TO_PRESSURIZE),
        Trouble("pump loses its power for a moment", pump, (4, 6), (("pump", "restarted", 0),), harms=()),
        Trouble("DAQ silent", daq, (6,), (("daq", "silent", 0),)),
        Trouble("DAQ slow: reads come 2 s late", daq, (6,), (("daq", "slow", 2.0),)),
        Trouble("DAQ overrun", daq, (6,), (("daq", "overrun", 0),)),
        Trouble("DAQ partial read", daq, (6,), (("daq", "partial", 0),)),
        Trouble("DAQ removed", daq, (6,), (("daq", "removed", 0),)),
        Trouble("DAQ error -200010", daq, (6,), (("daq", "error_code", -200010),)),
        Trouble("DAQ overrun, on the wire", daq, (6,), (("daq", "overrun", 0),), wire=True, steps=REPEATED),
        Trouble("DAQ removed, on the wire", daq, (6,), (("daq", "removed", 0),), wire=True, steps=REPEATED),
        Trouble("DAQ server never answers, on the wire", daq, (6,), (("daq", "hang", 0),), wire=True, steps=REPEATED),
        Trouble("force over range, compression", cell, (3, 6), (("force", "over_range", 4.7),)),
        Trouble("force over range, tension", cell, (3, 6), (("force", "over_range", -4.7),)),
        Trouble("load cell's amplifier at its rail", cell, (3, 6), (("force", "open_wire", 0),)),
        Trouble("pressure wire open (a believable -330 mbar)", sensor, (3, 6), (("pressure", "open_wire", 0),)),
        Trouble("pressure sensor clipped high", sensor, (3, 6), (("pressure", "clipped", 1),)),
        Trouble("pressure sensor clipped low", sensor, (3, 6), (("pressure", "clipped", -1),)),
        Trouble("pressure sensor without power", sensor, (3, 6), (("pressure", "supply_lost", 0),)),
        Trouble("supply lost", sensor, (3, 6), (("supply", "lost", 0),)),
        Trouble("supply sags to 4 V", sensor, (3, 6), (("supply", "sag", 4.0),)),
        Trouble("supply's wire open", sensor, (3, 6), (("supply", "open_wire", 0),)),
        Trouble("Ctrl-C", ("operator",), (130,), act=_press(signal.SIGINT, 1)),
        Trouble("Ctrl-C twice", ("operator",), (130,), act=_press(signal.SIGINT, 2)),
        Trouble("SIGTERM", ("operator",), (130,), act=_press(signal.SIGTERM, 1)),
        Trouble("stage's stop raises, operator stops", ("stage",), (130, 70), act=_break_and_stop("stage.stop")),
        Trouble("pump's stop raises, operator stops", ("pump",), (130, 70), act=_break_and_stop("pump.stop")),
        Trouble("DAQ's stop raises, operator stops", ("DAQ",), (130, 70), act=_break_and_stop("daq.stop")),
        Trouble(
            "stage's driver raises something unheard-of", ("ZeroDivisionError",), (70,), act=_break("stage.status")
        ),
        Trouble("DAQ's driver raises something unheard-of", ("ZeroDivisionError",), (70,), act=_break("daq.read")),
        Trouble("disk nearly full", ("recording",), (2,), act=_fill_the_disk),
        Trouble("disk gone: every write fails", ("recording",), (2,), act=_write_to("", os.O_RDONLY)),
        Trouble("recording removed", ("recording",), (2,), act=_remove_the_file),
    ]
    if sys.platform == "linux":
        rows += [
            Trouble(
                "stage unplugged, at a terminal (EIO)",
                stage,
                (6,),
                (("stage", "unplugged", 0),),
                wire="terminal",
                steps=REPEATED,
                cut_off=("stage",),
            ),
            Trouble(
                "pump unplugged, at a terminal (EIO)",
                pump,
                (6,),
                (("pump", "unplugged", 0),),
                wire="terminal",
                steps=REPEATED,
                cut_off=("pump",),
            ),
            Trouble("disk full all of a sudden", ("recording",), (2,), act=_write_to("/dev/full", os.O_WRONLY)),
        ]
    return rows


@dataclass(frozen=True)
class Verdict:
    """What came of a cell; ``flaws`` is empty when it is safe and its data are intact."""

    trouble: str
    step: str
    ending: Ending
    unsafe: tuple[str, ...]
    lost: tuple[str, ...]
    unclear: tuple[str, ...]
    found_in: str
    overrun: float
    largest_force: float

    @property
    def flaws(self) -> tuple[str, ...]:
        """Everything that is wrong."""
        return self.unsafe + self.lost + self.unclear


class _Terminals(EmulatedBench):
    """Stage and pump on pseudo-terminals, the DAQ on its socket."""

    @property
    def endpoints(self) -> Endpoints:
        stage, pump = self.serve_terminals()
        return dataclasses.replace(super().endpoints, stage=stage, pump=pump)


class _Act(Observer):
    """Does what the trouble says, some frames into its step."""

    def __init__(self, trouble: Trouble, step: str, stage: Stage) -> None:
        self._trouble, self._step, self._stage = trouble, step, stage
        self._due = -1
        self.steps: list[str] = []

    def step(self, event: Any) -> None:
        if event.phase is StepPhase.STARTED:
            self.steps.append(event.name)
            if event.name == self._step:
                self._due = event.sample + LATER

    def frame(self, frame: Any) -> None:
        if 0 <= self._due <= frame.stop and self._trouble.act is not None:
            self._due = -1
            self._trouble.act(self._stage)


def request_of(out: Path, trouble: Trouble, step: str) -> Request:
    """Return the request of a cell."""
    text = scene_text("sphere-60mm-low", **PROTOCOL)
    bench, bench_text = load_bench(None)
    assert bench.pump is not None
    parts = {
        "stage": bench.stage.model_copy(update={"reply_timeout_ms": PATIENCE_MS}),
        "pump": bench.pump.model_copy(update={"reply_timeout_ms": PATIENCE_MS}),
    }
    bench = bench.model_copy(update=parts)
    script = [
        Fault(device, kind, at_step=step, after_samples=LATER, value=value) for device, kind, value in trouble.faults
    ]
    return Request(
        Scene.model_validate(tomllib.loads(text)),
        text,
        bench,
        bench_text,
        out,
        wire=bool(trouble.wire),
        live=False,
        faults=Faults(script),
        referenced=True,
        controls=Controls(),
    )


def play(trouble: Trouble, step: str, folder: Path) -> Verdict:
    """Run one cell and judge it."""
    request = request_of(folder / "cell.h5", trouble, step)
    stage = Stage(request)
    act = _Act(trouble, step, stage)
    request.observers = [act]
    forces: list[float] = [0.0]
    with stage.leave, _watched(stage, trouble, forces):
        ending = run_scene(request)
    assert stage.bench is not None
    unsafe, overrun = _judge_motion(stage.bench, trouble, forces, request)
    lost = _judge_data(stage, ending, request.out)
    unclear = _judge_words(trouble, step, ending, act.steps)
    return Verdict(
        trouble.title,
        step,
        ending,
        tuple(unsafe),
        tuple(lost),
        tuple(unclear),
        act.steps[-1],
        overrun,
        max(map(abs, forces)),
    )


@contextlib.contextmanager
def _watched(stage: Stage, trouble: Trouble, forces: list[float]) -> Iterator[None]:
    """Keep the cell's bench and recorder in sight, and let drivers break when they are told to."""
    make, record = rig.emulation.emulated_bench, rig.session.Recorder
    opening = rig.session.open_instruments

    def emulated(request: Request) -> EmulatedBench:
        stage.bench = bench = make(request)
        if trouble.wire == "terminal":
            bench.__class__ = _Terminals
        advance = bench.plant.advance

        def advanced(samples: int, rate: float) -> Any:
            signals = advance(samples, rate)
            if samples:
                forces[:] = [
                    min(forces[0], float(signals["force"].min())),
                    max(forces[-1], float(signals["force"].max())),
                ]
            return signals

        bench.plant.advance = advanced  # type: ignore[method-assign]
        return bench

    def recorder(*arguments: Any, **options: Any) -> Recorder:
        stage.recorder = record(*arguments, **options)
        return stage.recorder

    def opened(request: Request) -> Any:
        devices = opening(request)
        _keep(devices.daq, stage.volts)
        for name in ("stage", "pump", "daq"):
            _breakable(getattr(devices, name), name, stage.broken)
        return devices

    with (
        mock.patch("rig.emulation.emulated_bench", emulated),
        mock.patch("rig.session.Recorder", recorder),
        mock.patch("rig.session.open_instruments", opened),
    ):
        yield


def _keep(daq: Any, volts: list[np.ndarray]) -> None:
    """Keep what the DAQ delivers, from its last start on."""
    start, read = daq.start, daq.read

    def started() -> None:
        volts.clear()
        start()

    def kept(samples: int) -> np.ndarray:
        volts.append(read(samples))
        return volts[-1]

    daq.start, daq.read = started, kept


def _breakable(device: Any, name: str, broken: set[str]) -> None:
    for method in ("stop", "status", "read"):
        intact = getattr(device, method, None)
        if intact is None:
            continue

        def guarded(*arguments: Any, intact: Any = intact, key: str = f"{name}.{method}") -> Any:
            if key in broken:
                raise ZeroDivisionError(f"a defect in {key}")
            return intact(*arguments)

        setattr(device, method, guarded)


def _judge_motion(
    bench: EmulatedBench, trouble: Trouble, forces: list[float], request: Request
) -> tuple[list[str], float]:
    plant, limits = bench.plant, request.bench.limits
    flaws = []
    before = plant.axis.position
    if plant.syringe.rate and "pump" not in trouble.cut_off:
        flaws.append("the pump runs on")
    lowest = before
    for _ in range(round(AFTERWARDS / 0.1)):
        plant.advance(100, 1000.0)
        lowest = min(lowest, plant.axis.position)
    overrun = abs(plant.axis.position - before)
    allowed = LOOK_AHEAD + AT_REST if "stage" in trouble.cut_off else AT_REST
    if plant.axis.moving or overrun > allowed or before - lowest > allowed:
        flaws.append(f"the stage went on by {overrun * 1e6:.1f} um")
    if plant.syringe.rate:
        flaws.append("the pump never stops")
    if not -limits.tension_N <= min(forces) <= max(forces) <= limits.compression_N:
        flaws.append(f"true force {min(forces):+.3f} to {max(forces):+.3f} N")
    return flaws, overrun


def _judge_data(stage: Stage, ending: Ending, path: Path) -> list[str]:
    assert stage.recorder is not None
    acknowledged = stage.recorder.acknowledged
    flaws = []
    if acknowledged < ending.samples and ending.exit_code != 2:
        flaws.append(f"{acknowledged} of {ending.samples} samples acknowledged")
    try:
        load_recording(path)
        with h5py.File(path) as file:
            volts = file["entry/raw/volts"][:]
            told = file["entry/ending"]["reason"][:]
    except Exception as error:  # noqa: BLE001 - whatever it is, the reader would meet it
        return [*flaws, f"recording: {error!r}"]
    delivered = np.concatenate(stage.volts, axis=1).T
    if len(volts) < acknowledged:
        flaws.append(f"{len(volts)} samples in the file, {acknowledged} acknowledged")
    if not np.array_equal(volts, delivered[: len(volts)]):
        flaws.append("the file holds other samples than the DAQ delivered")
    if ending.exit_code != 2 and not len(told):
        flaws.append("the file does not say how the run ended")
    return flaws


def _judge_words(trouble: Trouble, step: str, ending: Ending, steps: list[str]) -> list[str]:
    if ending.exit_code == 0:
        return [f"the run ended as if nothing had been ({ending.reason})"] if step in trouble.harms else []
    flaws = []
    if ending.exit_code not in trouble.codes:
        flaws.append(f"exit code {ending.exit_code}")
    if not any(name in ending.reason for name in trouble.names):
        flaws.append(f"none of {trouble.names} named")
    if f"step {steps[-1]}" not in ending.reason:
        flaws.append("step not named")
    if ending.reason.count("Remedy") != (0 if ending.reason.endswith(f"operator in step {steps[-1]}") else 1):
        flaws.append(f"{ending.reason.count('Remedy')} remedies")
    return flaws


def page(verdicts: Sequence[Verdict]) -> str:
    """Return the matrix as a page of the documentation."""
    rows: dict[str, dict[str, Verdict]] = {}
    for verdict in verdicts:
        rows.setdefault(verdict.trouble, {})[verdict.step] = verdict
    lines = [
        "# The fault matrix",
        "",
        "Every step of a pull-off test times every fault. Made by `pytest -m soak tests/test_fault_matrix.py`.",
        "",
        f"{len(verdicts)} cells, {sum(not v.unsafe for v in verdicts)} safe (stage and pump at rest, true force within "
        f"the limits), {sum(not v.lost for v in verdicts)} with the data intact (plain h5py opens the recording, every "
        f"acknowledged sample is there as the DAQ delivered it), {sum(not v.unclear for v in verdicts)} with the right "
        "exit code and one message that names instrument, step and remedy.",
        "",
        f"Largest true force: {max(v.largest_force for v in verdicts):.3f} N (limit {LIMIT:g} N). Furthest the "
        f"stage went on after a run: {max(v.overrun for v in verdicts) * 1e6:.1f} um unplugged (look-ahead 50 um), "
        f"{max(v.overrun for v in verdicts if 'unplugged' not in v.trouble) * 1e6:.1f} um otherwise.",
        "",
        "A number is the run's exit code (2 file, 3 interlock, 4 step failed, 6 instrument, 70 defect of the program, "
        "130 operator); with an arrow the fault was found in a later step; 0: it did no harm there and the run was "
        "finished; blank: not played on this wire. **Bold** is a flaw.",
        "",
        "| fault begins in | " + " | ".join(STEPS) + " |",
        "|---" * (len(STEPS) + 1) + "|",
    ]
    lines += [
        f"| {title} | " + " | ".join(_mark(row.get(step)) for step in STEPS) + " |" for title, row in rows.items()
    ]
    lines += ["", "## What the operator reads (fault in preload)", ""]
    lines += [f"- **{title}**: {_told(row['preload'])}" for title, row in rows.items() if "preload" in row]
    return "\n".join(lines) + "\n"


def _mark(verdict: Verdict | None) -> str:
    if verdict is None:
        return ""
    later = f" -> {verdict.found_in}" if verdict.ending.exit_code and verdict.found_in != verdict.step else ""
    text = f"{verdict.ending.exit_code}{later}"
    return f"**{text}: {'; '.join(verdict.flaws)}**" if verdict.flaws else text


def _told(verdict: Verdict) -> str:
    text = re.sub(r"recording \S+:", "recording FILE:", verdict.ending.reason)
    return re.sub(r"socket://\S+?:\d+|/dev/pts/\d+", "PORT", text)
