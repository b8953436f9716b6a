"""The Honeywell sensor: ratiometric conversion, what cannot be true, the zero."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drivers.errors import SensorFault
from drivers.flags import SensorFlags, raise_for
from drivers.pressure import MILLIBAR, HoneywellHSC

Volts = np.ndarray[tuple[int], np.dtype[np.float64]]
RATE = 1000.0


def hsc(**options: object) -> HoneywellHSC:
    return HoneywellHSC(rate=RATE, **options)  # type: ignore[arg-type]


def signal_of(pressure: float, supply: Volts) -> Volts:
    """What the data sheet's sensor puts out, V."""
    return supply * (0.10 + 0.80 * (pressure + 60e3) / 120e3)


def steady(value: float, samples: int = 300, noise: float = 0.0, seed: int = 0) -> Volts:
    return value + noise * np.random.default_rng(seed).standard_normal(samples)


@pytest.mark.parametrize(("volts", "millibar"), [(0.5, -600), (2.5, 0), (4.5, 600), (2.8, 90)])
def test_the_points_of_the_data_sheet(volts: float, millibar: float) -> None:
    values, flags = hsc().convert(np.array([volts]), np.array([5.0]))
    assert values[0] / MILLIBAR == pytest.approx(millibar)
    assert flags == SensorFlags.NONE


@given(st.floats(-59.9e3, 59.9e3), st.floats(4.76, 5.24))
def test_the_supply_does_not_matter_when_it_is_measured(pressure: float, supply: float) -> None:
    rail = steady(supply)
    values, _ = hsc(quietest=None).convert(signal_of(pressure, rail), rail)
    np.testing.assert_allclose(values, pressure, atol=5e-2)


def test_vacuum_is_negative() -> None:
    rail = steady(5.0)
    assert (hsc().convert(signal_of(-3200.0, rail), rail).values < 0).all()


def test_noise_of_the_supply_is_not_added_to_the_pressure() -> None:
    rail = steady(5.0, 5000, noise=5e-3)
    signal = signal_of(-20e3, np.full(5000, 5.0))
    values = hsc().convert(signal, rail).values[200:]
    by_sample = 150e3 * signal / rail - 75e3
    assert np.std(values) < 0.15 * np.std(by_sample[200:])


doubtful_volts = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([0.0, 0.1, 0.125, 1.398, 1.4, 2.5, 4.6, 4.875, 5.0, 5.02, 5.25, 5.3]),
)


@given(
    signal=arrays(np.float64, 260, elements=doubtful_volts, fill=st.sampled_from([1.398, 2.5, 0.4, 4.8])),
    supply=arrays(np.float64, 260, elements=doubtful_volts, fill=st.sampled_from([5.0, 4.76, 5.2])),
    cuts=st.lists(st.integers(0, 260), max_size=6),
)
@settings(max_examples=120, deadline=None)
def test_nothing_depends_on_how_frames_are_cut(signal: Volts, supply: Volts, cuts: list[int]) -> None:
    whole = hsc().convert(signal, supply)
    sensor = hsc()
    parts = [
        sensor.convert(*part)
        for part in zip(np.split(signal, sorted(cuts)), np.split(supply, sorted(cuts)), strict=True)
    ]
    np.testing.assert_array_equal(np.concatenate([part.values for part in parts]), whole.values)
    worst = SensorFlags.NONE
    for part in parts:
        worst |= part.flags
    assert worst == whole.flags


@given(
    samples=st.integers(1, 200),
    block=st.integers(1, 50),
    level=st.floats(0.0, 5.2),
    wave=st.floats(0, 0.2),
    supply=st.floats(4.7, 5.3),
)
@settings(max_examples=100, deadline=None)
def test_a_quick_look_and_a_close_look_agree(
    samples: int, block: int, level: float, wave: float, supply: float
) -> None:
    """Sample by sample every sample is looked at closely; in blocks most of them are passed over quickly."""
    index = np.arange(samples)
    signal, rail = level + wave * np.sin(index), supply + wave / 10 * np.sin(index / 17)
    single, blocks = hsc(), hsc()
    expected = [
        single._convert_doubtful(s, r, single._supply.take(r), single._remember(s))
        for s, r in zip(np.split(signal, samples), np.split(rail, samples), strict=True)
    ]
    cuts = range(block, samples, block)
    found = [blocks.convert(*part) for part in zip(np.split(signal, cuts), np.split(rail, cuts), strict=True)]
    np.testing.assert_array_equal(
        np.concatenate([r.values for r in found]), np.concatenate([r.values for r in expected])
    )
    assert {flag for r in found for flag in r.flags} == {flag for r in expected for flag in r.flags}


def test_a_long_stream_keeps_the_last_tenth_of_a_second_exactly() -> None:
    rail = steady(5.0, 20_000, noise=2e-2)
    sensor = hsc()
    means = np.concatenate([sensor._supply.take(part) for part in np.split(rail, 1000)])
    exact = np.convolve(rail, np.full(100, 0.01), mode="valid")
    np.testing.assert_allclose(means[99:], exact, atol=1e-6)
    np.testing.assert_allclose(means[9], rail[:10].mean(), atol=1e-6)


@pytest.mark.parametrize(
    ("part", "expected", "kept"),
    [
        (0.895, SensorFlags.NONE, True),
        (0.92, SensorFlags.OVER_RANGE, True),
        (0.08, SensorFlags.OVER_RANGE, True),
        (0.975, SensorFlags.OVER_RANGE | SensorFlags.CLIPPED, True),
        (0.025, SensorFlags.OVER_RANGE | SensorFlags.CLIPPED, True),
        (0.99, SensorFlags.OVER_RANGE | SensorFlags.CLIPPED | SensorFlags.WIRING, False),
        (0.0, SensorFlags.OVER_RANGE | SensorFlags.CLIPPED | SensorFlags.WIRING, False),
    ],
)
def test_bands_of_the_output(part: float, expected: SensorFlags, kept: bool) -> None:
    rail = steady(5.1)
    values, flags = hsc().convert(rail * part, rail)
    assert flags == expected
    assert np.isfinite(values).all() == kept


def test_a_saturated_sensor_is_never_shown_as_a_vacuum() -> None:
    """A good pump goes to -900 mbar; the sensor stops near -710."""
    rail = steady(5.0)
    reading = hsc().convert(rail * 0.025, rail)
    assert reading.values[0] / MILLIBAR == pytest.approx(-712.5)
    with pytest.raises(SensorFault, match="saturated"):
        raise_for("pressure sensor", reading.flags)


@pytest.mark.parametrize(
    ("supply", "flag"),
    [
        (4.74, SensorFlags.SUPPLY_RANGE),
        (5.26, SensorFlags.SUPPLY_RANGE),
        (0.0, SensorFlags.SUPPLY_LOST),
        (1.398, SensorFlags.SUPPLY_LOST),
        (-5.0, SensorFlags.SUPPLY_LOST),
    ],
)
def test_without_a_sound_supply_nothing_is_converted(supply: float, flag: SensorFlags) -> None:
    values, flags = hsc().convert(steady(2.5), steady(supply))
    assert flag in flags
    assert np.isnan(values).all()
    assert flags.faulty


def test_a_lost_supply_is_seen_at_its_first_sample() -> None:
    sensor = hsc()
    rail = steady(5.0)
    assert sensor.convert(signal_of(0.0, rail), rail).flags == SensorFlags.NONE
    rail[20:] = 0.0
    values, flags = sensor.convert(signal_of(0.0, rail), rail)
    assert {SensorFlags.SUPPLY_LOST, SensorFlags.WIRING} <= set(flags)
    assert np.isfinite(values[:20]).all()
    assert np.isnan(values[20:]).all()


def test_a_step_of_the_supply_is_marked_until_its_mean_has_followed() -> None:
    sensor = hsc()
    rail = steady(5.1)
    sensor.convert(signal_of(0.0, rail), rail)
    lower = steady(5.0, 100)
    assert sensor.convert(signal_of(0.0, lower), lower).flags == SensorFlags.SUPPLY_STEP
    values, flags = sensor.convert(signal_of(0.0, lower), lower)
    assert flags == SensorFlags.NONE
    np.testing.assert_allclose(values, 0.0, atol=0.1)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308])
@pytest.mark.parametrize("row", [0, 1])
def test_what_is_not_a_voltage_is_told(value: float, row: int) -> None:
    rows = [steady(2.5), steady(5.0)]
    rows[row][50] = value
    values, flags = hsc().convert(*rows)
    assert flags.faulty
    assert np.isnan(values[50])


def test_an_open_wire_is_seen_though_it_reads_a_believable_vacuum() -> None:
    sensor = hsc()
    rail = steady(5.0, 500, noise=2e-4)
    live = signal_of(-33e3, np.full(500, 5.0)) + steady(0.0, 500, noise=4e-4, seed=1)
    values, flags = sensor.convert(live, rail)
    assert flags == SensorFlags.NONE
    dead = steady(1.398, 500, noise=1.2e-4, seed=2)
    values, flags = sensor.convert(dead, rail)
    assert SensorFlags.OPEN_WIRE in flags
    assert values[50] / MILLIBAR == pytest.approx(-330.6, abs=1)  # the first 100 ms are not yet told apart
    assert np.isnan(values[150:]).all()


def test_a_true_pressure_at_the_open_wires_value_passes_while_it_is_alive() -> None:
    rail = steady(5.0, 20_000, noise=2e-4)
    live = steady(1.398, 20_000, noise=3e-4, seed=4)
    assert hsc().convert(live, rail).flags == SensorFlags.NONE


def test_the_open_wire_test_can_be_switched_off() -> None:
    assert hsc(quietest=None).convert(steady(1.398), steady(5.0)).flags == SensorFlags.NONE


def test_the_zero_is_subtracted() -> None:
    rail = steady(5.0, 2000)
    values = hsc(zero=480.0).convert(signal_of(-2720.0, rail), rail).values
    np.testing.assert_allclose(values, -3200.0, atol=1e-6)


@pytest.mark.parametrize(("rate", "averaging"), [(1000.0, 0.01), (1000.0, float("nan")), (1.0, 0.1)])
def test_an_average_too_short_is_refused(rate: float, averaging: float) -> None:
    with pytest.raises(ValueError, match="averaging"):
        HoneywellHSC(rate=rate, averaging=averaging)


def test_an_empty_block_is_an_empty_reading() -> None:
    assert hsc().convert(np.empty(0), np.empty(0)).values.size == 0
