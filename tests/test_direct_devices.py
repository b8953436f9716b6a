"""The direct back end: the same instruments without a wire."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.daq_channels import VoltageChannel, signal_channel
from drivers.emulated.bench import EmulatedBench
from drivers.emulated.faults import Fault, Faults
from drivers.emulated.truth import Truth
from drivers.errors import (
    BadReply,
    CommandRefused,
    DataLost,
    DeviceError,
    MotionFault,
    NoReply,
    NotConnected,
    OutOfRange,
)
from drivers.interfaces import Daq, Pump, PumpState, PumpStatus, Stage, StageStatus

NAMES = ("force", "pressure", "supply")


@pytest.fixture
def faults() -> Faults:
    return Faults()


@pytest.fixture
def bench(faults):
    with EmulatedBench(Truth.pull_off(), wire=False, referenced=True, faults=faults) as bench:
        yield bench


@pytest.fixture
def stage(bench):
    return bench.stage()


@pytest.fixture
def daq(bench):
    daq = bench.daq(*NAMES)
    daq.start()
    return daq


def test_they_fit_the_interfaces(bench):
    stage: Stage = bench.stage()
    pump: Pump = bench.pump()
    daq: Daq = bench.daq("force")
    assert "C-863" in stage.identity.model
    assert "Legato" in pump.identity.model
    assert daq.identity.model == "USB-6211"
    assert daq.channels == ("force",)
    assert stage.travel == pytest.approx((0.0, 52e-3))
    assert stage.referenced


# Over the wire and directly


def play(stage: Stage, pump: Pump, daq: Daq) -> tuple[np.ndarray, list[StageStatus], list[PumpStatus]]:
    """A short test that meets, presses, sucks, pulls off; every poll is kept."""
    volts, polls, pumped = [], [], []

    def frames(count: int) -> None:
        for _ in range(count):
            volts.append(daq.read(20))
            polls.append(stage.status())
            pumped.append(pump.status())

    daq.start()
    stage.set_speed(5e-3)
    stage.move_to(19.05e-3)
    frames(60)
    stage.set_speed(1e-4)
    for _ in range(25):
        stage.move_to(polls[-1].position - 50e-6)
        frames(3)
    stage.stop()
    frames(5)
    pump.dispense(-0.2e-6, 2.34567e-7)
    frames(30)
    pump.dispense(0.1e-6, 1e-7)
    frames(10)
    pump.stop()
    stage.set_speed(0.5e-3)
    stage.move_to(22.0123456789e-3)
    frames(330)
    daq.stop()
    daq.start()
    frames(2)
    daq.stop()
    return np.concatenate(volts, axis=1), polls, pumped


def over_the_wire(bench: EmulatedBench) -> tuple[np.ndarray, list[StageStatus], list[PumpStatus]]:
    from drivers.daq import NIDaq
    from drivers.pump import LegatoPump
    from drivers.stage import PIStage

    ends = bench.endpoints
    assert ends.pump is not None
    stage = PIStage(ends.stage, clock=bench.clock)
    pump = LegatoPump(ends.pump, syringe_diameter=14.43e-3, force_percent=50, settle=0.0, clock=bench.clock)
    channels = [signal_channel(name, f"Dev1/ai{number}") for number, name in enumerate(NAMES)]
    daq = NIDaq(channels, rate=1000.0, connection=ends.daq)
    assert stage.identity.serial == pump.identity.serial == "EMULATED"
    try:
        return play(stage, pump, daq)
    finally:
        for device in (daq, pump, stage):
            device.close()


def test_both_back_ends_deliver_the_same_bits():
    truth = Truth.pull_off()
    with EmulatedBench(truth, seed=7, wire=False, referenced=True) as bench:
        volts, polls, pumped = play(bench.stage(), bench.pump(), bench.daq(*NAMES))
    with EmulatedBench(truth, seed=7, referenced=True) as bench:
        wired_volts, wired_polls, wired_pumped = over_the_wire(bench)
    assert volts[0].min() < -0.5 < 0.5 < volts[0].max()
    assert np.array_equal(volts, wired_volts)
    assert polls == wired_polls
    assert pumped == wired_pumped


@pytest.mark.parametrize(
    "code", [-200284, -200279, -200361, -88709, -201003, -200170, -200220, -50103, -200022, -200077, -12345]
)
def test_an_error_of_the_daq_is_the_same_over_the_wire_and_directly(code):
    from drivers.daq import NIDaq

    raised = []
    for wire in (False, True):
        faults = Faults()
        with EmulatedBench(Truth.pull_off(), wire=wire, referenced=True, faults=faults) as bench:
            channel = VoltageChannel("force", "Dev1/ai0")
            daq = NIDaq([channel], rate=1000.0, connection=bench.endpoints.daq) if wire else bench.daq("force")
            daq.start()
            faults.add(Fault("daq", "error_code", value=code))
            with pytest.raises(DeviceError) as failure:
                daq.read(20)
            raised.append((type(failure.value), failure.value.device))
            faults.clear()
            daq.close()
    assert raised[0] == raised[1]


# Stage


def settle(daq: Daq, stage: Stage, seconds: float) -> StageStatus:
    daq.read(round(seconds * 1000))
    return stage.status()


def test_a_move_arrives(stage, daq):
    stage.set_speed(2e-3)
    stage.move_to(23e-3)
    assert settle(daq, stage, 0.2).moving
    stage.status()
    daq.read(1000)
    stage.status()
    status = settle(daq, stage, 1.0)
    assert not status.moving
    assert status.on_target
    assert status.position == pytest.approx(23e-3, abs=1e-6)
    assert status.sent == status.received == pytest.approx(2.2)


def test_stopping(stage, daq):
    stage.set_speed(2e-3)
    stage.move_to(40e-3)
    settle(daq, stage, 0.5)
    stage.stop()
    assert not settle(daq, stage, 0.5).moving
    assert stage.status().error == 0


def test_an_emergency_stop_must_be_acknowledged(stage, daq):
    stage.set_speed(2e-3)
    stage.move_to(40e-3)
    settle(daq, stage, 0.5)
    stage.emergency_stop()
    place = stage.status().position
    with pytest.raises(MotionFault, match="emergency stop"):
        stage.move_to(25e-3)
    assert settle(daq, stage, 0.5).position == pytest.approx(place, abs=20e-6)
    stage.stop()
    stage.move_to(25e-3)
    assert settle(daq, stage, 0.2).moving


@pytest.mark.parametrize("target", [-1e-3, 53e-3])
def test_targets_outside_the_travel_are_refused(bench, target):
    with pytest.raises(OutOfRange, match="outside the travel"):
        bench.stage().move_to(target)
    with pytest.raises(OutOfRange, match="outside the travel"):
        bench.stage(minimum=10e-3, maximum=30e-3).move_to(9e-3)
    with pytest.raises(OutOfRange, match="positive"):
        bench.stage().set_speed(0.0)


def test_from_outside_the_travel_the_axis_may_come_back_and_go_no_further(bench):
    stage = bench.stage(minimum=10e-3, maximum=20e-3)
    assert stage.status().position == pytest.approx(22e-3)
    stage.move_to(21e-3)
    for target in (22.1e-3, 9e-3):
        with pytest.raises(OutOfRange, match="outside the travel"):
            stage.move_to(target)


def test_an_unreferenced_axis_does_not_move_until_it_is_referenced():
    with EmulatedBench(Truth.pull_off(), wire=False) as bench:
        stage, daq = bench.stage(), bench.daq("force")
        daq.start()
        assert not stage.referenced
        with pytest.raises(CommandRefused, match="error 5"):
            stage.move_to(25e-3)
        stage.reference()
        assert stage.status().moving
        for _ in range(2000):
            daq.read(20)
            if not stage.status().moving:
                break
        assert stage.referenced
        assert stage.status().position == pytest.approx(52e-3, abs=1e-6)
        assert bench.plant.axis.position == pytest.approx(52e-3, abs=1e-6)


def test_a_blocked_carriage_is_a_motion_fault(stage, daq, faults):
    stage.set_speed(2e-3)
    stage.move_to(40e-3)
    settle(daq, stage, 0.2)
    faults.add(Fault("stage", "blocked"))
    daq.read(20)
    with pytest.raises(MotionFault):
        settle(daq, stage, 1.0)


WIRE = [("unplugged", NotConnected), ("silent", NoReply), ("garbage", BadReply)]


@pytest.mark.parametrize(("kind", "error"), WIRE)
def test_a_hurt_wire_to_the_stage(stage, faults, kind, error):
    faults.add(Fault("stage", kind))
    with pytest.raises(error):
        stage.status()
    faults.clear()
    assert stage.status().servo_on


def test_no_stop_byte_reaches_an_unplugged_stage(bench, stage, daq, faults):
    stage.set_speed(2e-3)
    stage.move_to(24e-3)
    settle(daq, stage, 0.2)
    faults.add(Fault("stage", "unplugged"))
    with pytest.raises(NotConnected):
        stage.emergency_stop()
    daq.read(2000)
    assert bench.plant.axis.position == pytest.approx(24e-3, abs=1e-6)


def test_a_limit_switch_and_a_lost_servo(stage, daq, faults):
    faults.add(Fault("stage", "servo_lost"))
    with pytest.raises(MotionFault, match="servo"):
        stage.status()
    faults.clear()
    stage.servo(True)
    stage.set_speed(2e-3)
    stage.move_to(30e-3)
    settle(daq, stage, 0.2)
    faults.add(Fault("stage", "limit_switch", value=1.0))
    with pytest.raises(MotionFault, match="limit switch"):
        settle(daq, stage, 0.1)


# Pump


def test_the_pump_delivers_its_target_and_changes_the_pressure(bench, daq):
    pump = bench.pump()
    slowest, fastest = pump.rate_limits
    assert slowest < 1e-7 < fastest
    before = daq.read(200)[1].mean()
    pump.dispense(-0.1e-6, 1e-7)
    assert pump.status().state is PumpState.WITHDRAWING
    after = daq.read(1500)[1][-200:].mean()
    status = pump.status()
    assert status.state is PumpState.TARGET_REACHED
    assert status.volume == pytest.approx(-0.1e-6, rel=1e-3)
    assert after < before


@pytest.mark.parametrize(("kind", "error"), WIRE)
def test_a_hurt_wire_to_the_pump(bench, faults, kind, error):
    pump = bench.pump()
    faults.add(Fault("pump", kind))
    with pytest.raises((error, BadReply, NoReply)):
        pump.status()
    faults.clear()
    assert pump.status().state is PumpState.IDLE


# DAQ


def test_frames_do_not_matter_to_the_samples():
    def volts(cuts: list[int]) -> np.ndarray:
        with EmulatedBench(Truth.pull_off(), wire=False, seed=2) as bench:
            daq = bench.daq(*NAMES)
            daq.start()
            return np.concatenate([daq.read(cut) for cut in cuts], axis=1)

    assert np.array_equal(volts([1, 99, 400]), volts([250, 250]))


def test_every_start_has_its_own_noise(bench):
    daq = bench.daq(*NAMES)
    daq.start()
    first = daq.read(100)
    daq.stop()
    daq.start()
    assert not np.array_equal(daq.read(100), first)


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (Fault("daq", "removed"), NotConnected),
        (Fault("daq", "overrun"), DataLost),
        (Fault("daq", "error_code", value=-200000), CommandRefused),
        (Fault("daq", "silent"), NoReply),
    ],
)
def test_faults_of_the_daq(daq, faults, fault, error):
    faults.add(fault)
    with pytest.raises(error):
        daq.read(20)


def test_after_an_incomplete_read_nothing_is_missing(bench, faults):
    daq, whole = bench.daq(*NAMES), None
    daq.start()
    faults.add(Fault("daq", "partial", value=7))
    with pytest.raises(NoReply, match="7 of 20"):
        daq.read(20)
    faults.clear()
    found = daq.read(30)
    with EmulatedBench(Truth.pull_off(), wire=False) as other:
        whole = other.daq(*NAMES)
        whole.start()
        assert np.array_equal(found, whole.read(30))


def test_reading_needs_a_start_and_a_channel_that_exists(bench):
    with pytest.raises(DeviceError, match="start"):
        bench.daq("force").read(10)
    with pytest.raises(NotConnected):
        bench.daq(VoltageChannel("force", "Dev1/ai77"))
    with pytest.raises(DeviceError):
        bench.daq("force", rate=1e9)
