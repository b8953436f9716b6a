"""One character lost on the stage's wire: what is left is often a number or a command still, and a wrong one."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from links import GatewayWire
from motion_world import MotionWorld

import drivers.gateway
import rig.emulation
from drivers.emulated.stage import EmulatedController
from drivers.errors import BadReply, DeviceError, MotionFault
from drivers.interfaces import StageStatus
from drivers.stage import PIStage
from rig.observe import Observer, StepPhase
from rig.session import run_scene
from sequences.errors import StepFailed
from sequences.frame import Frame
from sequences.step import Apparatus, rest

LOOK_AHEAD = 50e-6
CLEAN_FORCE = 0.33
"""N; a whole run's largest true force at a preload of 0.3 N is 0.322 N."""


@dataclass
class Loss:
    """Loses the character at ``index`` of a command, or of the reply to it, as soon as it is armed.

    Attributes
    ----------
    skip
        So many messages of this kind are left whole first.
    times
        How many are hurt.
    """

    command: bytes
    index: int
    reply: bool = False
    skip: int = 0
    times: int = 1
    whole: bool = False
    armed: bool = True
    lost: int = 0

    def hurt(self, command: bytes, message: bytes) -> bytes:
        """Return what is left of a command or of the reply to it."""
        if not (self.armed and command.startswith(self.command) and self.times):
            return message
        if self.skip:
            self.skip -= 1
            return message
        self.times -= 1
        self.lost += 1
        return b"" if self.whole else message[: self.index] + message[self.index + 1 :]


class LossyPort:
    """The driver's port, with a loss."""

    def __init__(self, port: Any, loss: Loss) -> None:
        self._port, self._loss = port, loss
        self._asked = b""

    def write(self, data: bytes) -> None:
        self._asked = data
        self._port.write(data if self._loss.reply else self._loss.hurt(data, data))

    def read(self, timeout: float) -> bytes:
        data = self._port.read(timeout)
        return self._loss.hurt(self._asked, data) if self._loss.reply and data.endswith(b"\n") else data

    def drain(self) -> None:
        self._port.drain()

    def close(self) -> None:
        self._port.close()


@contextlib.contextmanager
def virtual_stage(world: MotionWorld, loss: Loss):
    """A stage in virtual time whose wire loses something."""
    wire = GatewayWire(EmulatedController(world, referenced=True))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drivers.gateway, "open_port", lambda connection, baud: LossyPort(wire, loss))
        patch.setattr(drivers.gateway, "time", wire)
        yield PIStage("fake", clock=lambda: world.time)


# ---------------------------------------------------------------- the driver


LOSSES = st.one_of(
    st.builds(Loss, st.just(b"POS?"), st.integers(2, 11), st.just(True), st.integers(3, 60)),
    st.builds(Loss, st.just(b"MOV 1"), st.integers(0, 12), st.just(False), st.integers(0, 10)),
    st.builds(Loss, st.just(b"MOV?"), st.integers(2, 11), st.just(True), st.integers(0, 10)),
)


@given(LOSSES, st.sampled_from([-1, 1]), st.sampled_from([22.7634e-3, 19.97e-3, 9.99e-3, 51.2e-3, 1.05e-3]))
def test_whatever_digit_is_lost_the_stage_is_never_sent_far(loss, direction, start):
    world = MotionWorld(position=start)
    with virtual_stage(world, loss) as stage:
        for _ in range(3):
            stage.status()
            world.pass_time(0.02)
        stage.set_speed(200e-6)
        try:
            for _ in range(60):
                stage.move_to(stage.status().position + direction * LOOK_AHEAD)
                world.pass_time(0.02)
                assert abs(world.axis.target - world.axis.position) < LOOK_AHEAD + 10e-6
        except DeviceError:
            stage.stop()
            world.pass_time(0.1)
            assert world.axis.velocity == 0
    assert loss.lost


@given(st.integers(0, 9), st.sampled_from([100e-6, 15e-6, 54.32e-6, 500e-6, 1e-6]))
def test_whatever_digit_of_a_speed_is_lost_none_that_is_wrong_is_kept(index, speed):
    world = MotionWorld()
    with virtual_stage(world, Loss(b"VEL 1", index)) as stage:
        try:
            stage.set_speed(speed)
        except DeviceError:
            return
        stage.move_to(23e-3)
        assert world.axis.velocity == 0
        world.pass_time(0.1)
        assert world.axis.velocity == pytest.approx(speed, rel=0.11, abs=1.1e-6)


@pytest.mark.parametrize("fault", [Loss(b"HLT", 1), Loss(b"HLT", 0, whole=True), Loss(b"HLT", 5)])
def test_a_lost_halt_is_noticed(fault):
    world = MotionWorld()
    with virtual_stage(world, fault) as stage:
        stage.set_speed(1e-3)
        stage.move_to(40e-3)
        world.pass_time(0.5)
        with contextlib.suppress(DeviceError):
            stage.stop()
        assert world.axis.velocity == 0
        stage.stop()
        stage.move_to(23e-3)


def test_a_stage_that_does_not_stop_is_told_so(monkeypatch):
    world = MotionWorld()
    with virtual_stage(world, Loss(b"", 0, armed=False)) as stage:
        stage.set_speed(1e-3)
        stage.move_to(40e-3)
        world.pass_time(0.5)
        monkeypatch.setattr(EmulatedController, "_stop", lambda self, deceleration: None)
        with pytest.raises(MotionFault, match=r"told twice to stop.*Remedy"):
            stage.stop()


def test_a_position_off_the_way_is_asked_again_then_refused():
    for times in (1, 2):
        world = MotionWorld(position=22.7634e-3)
        with virtual_stage(world, Loss(b"POS?", 2, reply=True, skip=1, times=times)) as stage:
            stage.status()
            stage.set_speed(1e-3)
            stage.move_to(22.8e-3)
            if times == 1:
                assert stage.status().position == pytest.approx(22.7634e-3, abs=1e-6)
            else:
                with pytest.raises(BadReply, match=r"^stage: .* 2\.7634 mm.* was at 22\.7634 mm.*Remedy"):
                    stage.status()


def test_a_long_pause_or_a_stage_faster_than_the_clock_is_no_wrong_position():
    """The computer may have been busy; an emulated bench may run faster than the clock."""
    world = MotionWorld()
    with virtual_stage(world, Loss(b"", 0, armed=False)) as stage:
        now = 0.0
        stage._clock = lambda: now
        stage.status()
        stage.set_speed(500e-6)
        stage.move_to(30e-3)
        for pause in (0.02, 0.02, 20.0, 0.02):
            world.pass_time(pause)
            now += 0.001
            assert stage.status().position == pytest.approx(world.axis.position, abs=1e-7)


def test_a_rest_ends_when_the_stage_moves():
    stage = mock.Mock()
    still = StageStatus(0.0, 0.0, 20e-3, True, True, True, False, False)
    force = np.zeros((1, 20))
    frame = Frame(0, 0, 1000.0, force, force[0], None, still, None)
    steps = rest(Apparatus(stage, None, mock.Mock()), 1.0, frame)
    next(steps)
    for micrometres in (1, 3, 5, 15):
        steps.send(replace(frame, stage=replace(still, position=20e-3 - micrometres * 1e-6)))
    with pytest.raises(StepFailed, match=r"20\.0000 to 19\.9600 mm.*Remedy"):
        steps.send(replace(frame, stage=replace(still, position=19.96e-3)))
    stage.stop.assert_called_once_with()


# ---------------------------------------------------------------- a whole run


class Arming(Observer):
    """Arms the loss some frames into a step."""

    def __init__(self, loss: Loss, step: str) -> None:
        self._loss, self._step = loss, step

    def step(self, event: Any) -> None:
        if event.name == self._step and event.phase is StepPhase.STARTED:
            self._loss.armed = True


def run(request, loss, step, monkeypatch):
    """Run with a loss from this step on; return the ending and the extremes of the true force, N."""
    open_port, make = drivers.gateway.open_port, rig.emulation.emulated_bench
    forces = [0.0]

    def emulated(request):
        bench = make(request)
        advance = bench.plant.advance

        def advanced(samples, rate):
            signals = advance(samples, rate)
            if samples:
                forces[:] = [min(forces[0], signals["force"].min()), max(forces[-1], signals["force"].max())]
            return signals

        bench.plant.advance = advanced
        return bench

    monkeypatch.setattr(drivers.gateway, "open_port", lambda *address: LossyPort(open_port(*address), loss))
    monkeypatch.setattr(rig.emulation, "emulated_bench", emulated)
    patient = {  # a busy computer is no fault
        name: getattr(request.bench, name).model_copy(update={"reply_timeout_ms": 5000.0}) for name in ("stage", "pump")
    }
    request.bench = request.bench.model_copy(update=patient)
    loss.armed = False
    request.observers = [Arming(loss, step)]
    ending = run_scene(request)
    assert loss.lost == 1, ending.reason
    return ending, forces


QUICK = {"retract_speed_um_s": 200.0, "tare_s": 0.3, "preload_dwell_s": 0.5}


@pytest.mark.parametrize(("step", "index"), [("approach", 3), ("preload", 2), ("retract", 2), ("pull-off", 3)])
def test_a_garbled_position_crushes_nothing(request_for, monkeypatch, step, index):
    request = request_for(wire=True, referenced=True, protocol=QUICK)
    ending, (_, most) = run(request, Loss(b"POS?", index, reply=True), step, monkeypatch)
    assert ending.exit_code == 0
    assert most < CLEAN_FORCE


@pytest.mark.parametrize("step", ["preload", "retract"])
def test_a_garbled_target_crushes_nothing(request_for, monkeypatch, step):
    request = request_for(wire=True, referenced=True, protocol=QUICK)
    ending, (_, most) = run(request, Loss(b"MOV 1", 6), step, monkeypatch)
    assert most < CLEAN_FORCE
    assert ending.exit_code == 6
    assert f"in step {step}" in ending.reason


@pytest.mark.parametrize("whole", [False, True])
def test_a_lost_halt_crushes_nothing(request_for, monkeypatch, whole):
    request = request_for(wire=True, referenced=True, protocol=QUICK)
    ending, (_, most) = run(request, Loss(b"HLT", 1, whole=whole), "preload", monkeypatch)
    assert ending.exit_code == 0
    assert most < CLEAN_FORCE
