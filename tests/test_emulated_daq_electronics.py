"""Sensors, amplifier and converter of the emulated DAQ: physics, faults, and bits that do not depend on framing."""

from __future__ import annotations

import numpy as np
import pytest
from daq_world import CHANNELS, CHASSIS_CHANNELS, FORCE, PRESSURE, RATE, SUPPLY, SignalWorld, connect, constant
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.daq import Channel, VoltageChannel
from drivers.emulated.acquisition import Acquisition, AtOnce
from drivers.emulated.daq import EmulatedDaq
from drivers.emulated.electronics import (
    OPEN_INPUT,
    Cell,
    Device,
    Electronics,
    Input,
    PressureSensor,
    Refusal,
    compact_daq,
    usb_6009,
    usb_6211,
)
from drivers.emulated.faults import Fault
from drivers.flags import SensorFlags
from drivers.force import LoadCell
from drivers.pressure import HoneywellHSC

Volts = np.ndarray[tuple[int, ...], np.dtype[np.float64]]


def digitised(
    world: SignalWorld,
    cuts: list[int],
    *,
    device: Device | None = None,
    channels: tuple[Channel, ...] = CHANNELS,
    rate: float = RATE,
    seed: int = 0,
    run: int = 0,
) -> Volts:
    """What the device delivers of this world, produced in blocks of these sizes."""
    device = device or usb_6211()
    electronics = Electronics(
        device, [Input.of(channel) for channel in channels], rate, seed=seed, run=run, faults=world.faults
    )
    return np.concatenate([electronics.digitise(world.advance(n, rate)) for n in cuts], axis=1)


def lively() -> SignalWorld:
    world = SignalWorld(
        Fault("force", "over_range", at_sample=13, for_samples=20, value=9.0),
        Fault("force", "noise", at_sample=60, for_samples=9, value=50.0),
        Fault("pressure", "open_wire", at_sample=30, for_samples=11),
        Fault("pressure", "clipped", at_sample=45, for_samples=3),
        Fault("supply", "sag", at_sample=70, for_samples=10, value=4.6),
        Fault("supply", "lost", at_sample=90, for_samples=1),
    )
    world.force = lambda index: 3 * np.sin(index / 9)
    world.pressure = lambda index: 5e4 * np.sin(index / 7)
    world.supply = lambda index: 5 + 0.01 * np.sin(index / 31)
    return world


cuts_of_120 = st.lists(st.integers(1, 60), min_size=1, max_size=30).map(
    lambda cuts: [*(c for c, total in zip(cuts, np.cumsum(cuts), strict=True) if total < 120)]
)


@given(cuts=cuts_of_120, chassis=st.booleans(), rate=st.sampled_from([250.0, 1000.0, 2000.0, 3333.3]))
@settings(max_examples=60, deadline=None)
def test_the_way_samples_are_cut_changes_no_bit(cuts: list[int], chassis: bool, rate: float) -> None:
    options = {"device": compact_daq() if chassis else usb_6211(), "rate": rate}
    channels = CHASSIS_CHANNELS if chassis else CHANNELS
    whole = digitised(lively(), [120], channels=channels, **options)  # type: ignore[arg-type]
    parts = digitised(lively(), [*cuts, 120 - sum(cuts)], channels=channels, **options)  # type: ignore[arg-type]
    np.testing.assert_array_equal(parts, whole)


def test_wire_and_direct_deliver_the_same_bits() -> None:
    world, direct = lively(), lively()
    electronics = Electronics(usb_6211(), [Input.of(c) for c in CHANNELS], RATE, seed=3, faults=direct.faults)
    acquisition = Acquisition(direct, electronics, AtOnce(), RATE, 10_000)
    with EmulatedDaq(world, seed=3) as server, connect(server) as daq:
        for _ in range(6):
            np.testing.assert_array_equal(daq.read(20), acquisition.read(20, 1.0))


def test_seed_and_run_choose_the_noise() -> None:
    first = digitised(SignalWorld(), [200])
    np.testing.assert_array_equal(first, digitised(SignalWorld(), [200]))
    for other in (digitised(SignalWorld(), [200], seed=1), digitised(SignalWorld(), [200], run=1)):
        assert (first != other).mean() > 0.3
        np.testing.assert_allclose(first.mean(axis=1), other.mean(axis=1), atol=2e-4)


def test_channels_do_not_share_their_noise() -> None:
    volts = digitised(SignalWorld(), [20_000])
    assert np.abs(np.corrcoef(volts) - np.eye(3)).max() < 0.03


@pytest.mark.parametrize(
    ("device", "channel", "step"),
    [
        (usb_6211(), FORCE, 20 * 1.05 / 2**16),
        (usb_6211(), VoltageChannel("force", "Dev1/ai0", -5, 5), 10 * 1.05 / 2**16),
        (usb_6211(), VoltageChannel("force", "Dev1/ai0", -0.9, 0.1), 2 * 1.05 / 2**16),
        (usb_6009(), FORCE, 20 / 2**14),
        (compact_daq(), CHASSIS_CHANNELS[0], 50 / 2**24),
    ],
)
def test_values_lie_on_the_converters_steps(device: Device, channel: Channel, step: float) -> None:
    volts = digitised(SignalWorld(), [500], device=device, channels=(channel,))
    codes = volts / step
    np.testing.assert_allclose(codes, np.rint(codes), atol=1e-6)
    assert len(np.unique(codes)) > 2


def test_values_clip_at_the_range_plus_the_converters_reserve() -> None:
    world = SignalWorld()
    world.force = lambda index: np.where(index < 50, 100.0, -100.0)
    volts = digitised(world, [100])[0]
    assert volts[:50].min() == volts.max() == pytest.approx(10.5, abs=1e-3)
    assert volts[50:].max() == volts.min() == pytest.approx(-10.5, abs=1e-3)


@given(force=st.floats(-9.8, 9.8), bridge=st.booleans())
@settings(max_examples=40, deadline=None)
def test_the_certificate_gives_the_force_back_within_its_uncertainty(force: float, bridge: bool) -> None:
    world = SignalWorld()
    world.force = constant(force)
    cell = Cell()
    device = compact_daq() if bridge else usb_6211()
    channel = CHASSIS_CHANNELS[0] if bridge else FORCE
    loaded = digitised(world, [400], device=device, channels=(channel,))[0]
    world.force = constant(0.0)
    empty = digitised(world, [400], device=device, channels=(channel,))[0]
    sensor = LoadCell(
        cell.name, cell.capacity, cell.calibration(channel.unit), minimum=channel.minimum, maximum=channel.maximum
    )
    measured = sensor.convert(loaded).values[100:].mean() - sensor.convert(empty).values[100:].mean()
    record = sensor.calibration
    # Gain, linearity, and the mean of 300 samples of 0.5 mN noise, twice.
    assert abs(measured - force) < record.uncertainty * abs(force) + record.residual + 2e-4


def test_the_cell_is_not_exactly_what_its_certificate_says() -> None:
    cell = Cell()
    measured = cell.output(np.array([0.0, 5.0]), bridge=False) * cell.calibration().slope
    assert 1e-3 < np.diff(measured)[0] - 5.0 < 5e-3
    assert measured[0] == pytest.approx(0.004 * cell.capacity, rel=1e-3)


@given(pressure=st.floats(-59e3, 59e3), supply=st.floats(4.8, 5.2))
@settings(max_examples=40, deadline=None)
def test_the_ratiometric_formula_gives_the_pressure_back_whatever_the_supply(pressure: float, supply: float) -> None:
    world = SignalWorld()
    world.pressure, world.supply = constant(pressure), constant(supply)
    volts = digitised(world, [300])
    reading = HoneywellHSC(rate=RATE, quietest=None).convert(volts[1], volts[2])
    assert reading.flags == SensorFlags.NONE
    assert abs(reading.values.mean() - pressure) < 0.0025 * 120e3  # the accuracy of the data sheet


def test_hsc_puts_zero_at_half_its_supply_and_clips_near_its_ends() -> None:
    sensor = PressureSensor(offset=0.0, gain_error=0.0, noise=0.0)
    supply = np.full(5, 5.0)
    output = sensor.output(np.array([-90e3, -60e3, 0.0, 60e3, 90e3]), supply, np.zeros(5))
    np.testing.assert_allclose(output, [0.125, 0.5, 2.5, 4.5, 4.875])


def test_a_fast_sampled_sensor_shows_a_staircase_of_one_millisecond() -> None:
    world = SignalWorld()
    world.pressure = lambda index: 3.0 * index
    quiet = usb_6211(sensor=PressureSensor(noise=0.0))
    quiet = Device((quiet.modules[0],), quiet.wiring, sensor=quiet.sensor)
    volts = digitised(world, [400], device=quiet, channels=(PRESSURE,), rate=10e3)[0]
    levels = volts.reshape(40, 10)
    assert np.ptp(levels, axis=1).max() < 1.2e-3  # the converter's noise alone
    rises = np.diff(levels.mean(axis=1))
    assert np.abs(rises - 30 / 120e3 * 0.8 * 5.02).max() < 3e-4


def test_a_bridge_module_delays_by_forty_samples() -> None:
    world = SignalWorld()
    world.force = lambda index: np.where(index >= 100, 5.0, 0.0)
    volts = digitised(world, [50, 50, 50, 50], device=compact_daq(), channels=CHASSIS_CHANNELS[:1])[0]
    assert np.argmax(volts > 0.3) == 140


def test_an_unwired_input_sits_at_the_open_input_voltage() -> None:
    volts = digitised(SignalWorld(), [100], channels=(VoltageChannel("force", "Dev1/ai7"),))
    assert volts.mean() == pytest.approx(OPEN_INPUT, abs=1e-3)


@pytest.mark.parametrize(
    ("fault", "row", "level"),
    [
        (Fault("force", "over_range", value=9.0), 0, 9.0 * 0.8 + 0.004 * 0.8 * 9.80665),
        (Fault("force", "open_wire"), 0, 10.5),
        (Fault("pressure", "open_wire"), 1, 1.398),
        (Fault("pressure", "clipped"), 1, 0.975 * 5.02),
        (Fault("pressure", "clipped", value=-1), 1, 0.025 * 5.02),
        (Fault("pressure", "supply_lost"), 1, 0.0),
        (Fault("supply", "lost"), 1, 0.0),
        (Fault("supply", "lost"), 2, 0.0),
        (Fault("supply", "sag", value=4.5), 2, 4.5),
        (Fault("supply", "open_wire"), 2, 1.398),
    ],
)
def test_every_fault_begins_and_ends_at_its_sample(fault: Fault, row: int, level: float) -> None:
    world = SignalWorld()
    sound = digitised(SignalWorld(), [100])
    world.faults.add(Fault(fault.device, fault.kind, at_sample=37, for_samples=25, value=fault.value))
    volts = digitised(world, [30, 30, 40])
    np.testing.assert_allclose(volts[row, 37:62], level, atol=0.02)
    np.testing.assert_array_equal(volts[:, :37], sound[:, :37])
    np.testing.assert_array_equal(volts[:, 62:], sound[:, 62:])


def test_a_fault_keeps_its_sample_when_the_plant_moves_before_the_first_read() -> None:
    world = SignalWorld(Fault("supply", "sag", at_sample=25, for_samples=5, value=4.5))
    electronics = Electronics(usb_6211(), [Input.of(SUPPLY)], RATE, faults=world.faults, start=world.sample)
    acquisition = Acquisition(world, electronics, AtOnce(), RATE, 1000)
    world.advance(10, RATE)
    volts = acquisition.read(40, 1.0)[0]
    np.testing.assert_array_equal(np.flatnonzero(volts < 4.8), np.arange(15, 20))


def test_a_noise_fault_makes_noise() -> None:
    world = SignalWorld(Fault("force", "noise", value=20.0), Fault("pressure", "noise", value=20.0))
    quiet, loud = digitised(SignalWorld(), [1000]).std(axis=1), digitised(world, [1000]).std(axis=1)
    assert (loud[:2] > 10 * quiet[:2]).all()
    assert loud[2] == quiet[2]


@pytest.mark.parametrize(("asked", "got"), [(1000, 50e3 / 31), (1613, 50e3 / 30), (2000, 2000), (50e3, 50e3)])
def test_delta_sigma_rates_are_coerced_upwards(asked: float, got: float) -> None:
    assert compact_daq().coerce_rate(asked, 3) == pytest.approx(got)


@given(rate=st.floats(0.5, 50e3))
def test_a_coerced_rate_is_never_lower_and_coercing_again_keeps_it(rate: float) -> None:
    for device in (usb_6211(), compact_daq()):
        coerced = device.coerce_rate(rate, 3)
        assert coerced >= rate * (1 - 1e-12)
        assert device.coerce_rate(coerced, 3) == coerced


@pytest.mark.parametrize("rate", [0.0, -1.0, 1e7, float("nan")])
def test_an_impossible_rate_is_refused(rate: float) -> None:
    with pytest.raises(Refusal):
        usb_6211().coerce_rate(rate, 3)


def test_three_channels_share_the_converter() -> None:
    assert usb_6211().coerce_rate(200e3, 1) == 200e3
    with pytest.raises(Refusal, match="highest"):
        usb_6211().coerce_rate(200e3, 3)


def test_names_of_the_rows_do_not_matter_only_their_inputs() -> None:
    swapped = digitised(SignalWorld(), [100], channels=(SUPPLY, PRESSURE, FORCE))
    np.testing.assert_allclose(swapped.mean(axis=1), [5.02, 2.406, 0.43], atol=0.01)
