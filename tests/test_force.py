"""Load cells: signs, limits on the untared load, rails."""

from __future__ import annotations

from dataclasses import replace
from datetime import date

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drivers.calibration import Calibration, InvalidCalibration
from drivers.errors import SensorFault
from drivers.flags import SensorFlags, raise_for
from drivers.force import LoadCell

Volts = np.ndarray[tuple[int], np.dtype[np.float64]]

RECORD = Calibration(
    id="GSO-1K-2024-03",
    certificate="TT 48213",
    date=date(2024, 3, 5),
    operator="M. Weber",
    serial="317204",
    slope=1.25,
    intercept=0.02,
    residual=2e-3,
    uncertainty=1e-3,
    temperature=21.5,
)
CELL = LoadCell("GSO-1K", 9.80665, RECORD)


def at(cell: LoadCell, force: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Volts of this cell under a constant force."""
    sign = 1 if cell.compression_positive else -1
    return np.full(5, (sign * force - cell.calibration.intercept) / cell.calibration.slope)


def test_a_hung_weight_is_tension_and_negative_whichever_way_the_cell_is_mounted() -> None:
    """500 g under a cell whose signal falls, and under one whose signal rises when it is pulled."""
    volts = np.array([-0.5 * 9.80665 / 1.25])
    pulled_down = replace(CELL, calibration=replace(RECORD, intercept=0.0))
    upside_down = replace(pulled_down, compression_positive=False)
    assert pulled_down.convert(volts).values[0] == pytest.approx(-4.903325)
    assert upside_down.convert(-volts).values[0] == pytest.approx(-4.903325)


@given(st.floats(-7, 7), st.booleans())
def test_force_is_the_records_straight_line(force: float, positive: bool) -> None:
    cell = replace(CELL, compression_positive=positive)
    values, flags = cell.convert(at(cell, force))
    np.testing.assert_allclose(values, force, atol=1e-12)
    assert flags == SensorFlags.NONE


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("part", "expected"),
    [
        (0.79, SensorFlags.NONE),
        (0.81, SensorFlags.HIGH_LOAD),
        (1.01, SensorFlags.HIGH_LOAD | SensorFlags.OVER_RANGE),
        (1.21, SensorFlags.HIGH_LOAD | SensorFlags.OVER_RANGE | SensorFlags.OVERLOAD),
    ],
)
def test_limits_hold_in_both_directions_before_any_tare(part: float, expected: SensorFlags, sign: int) -> None:
    values, flags = CELL.convert(at(CELL, sign * part * CELL.capacity))
    assert flags == expected
    np.testing.assert_allclose(values, sign * part * CELL.capacity)


def test_one_sample_beyond_a_limit_is_enough() -> None:
    volts = at(CELL, 1.0)
    volts[3] = at(CELL, -1.3 * CELL.capacity)[0]
    assert SensorFlags.OVERLOAD in CELL.convert(volts).flags


@pytest.mark.parametrize("rail", [-10.0, 10.0, 10.5, -11.0])
def test_a_signal_at_a_rail_is_clipped(rail: float) -> None:
    flags = CELL.convert(np.array([0.0, rail, 0.0])).flags
    assert SensorFlags.CLIPPED in flags
    with pytest.raises(SensorFault, match=r"load cell: .*saturated"):
        raise_for("load cell", flags)


def test_clipping_depends_on_the_channels_range() -> None:
    narrow = replace(CELL, minimum=-1.0, maximum=1.0)
    assert narrow.convert(np.array([0.99])).flags == SensorFlags.NONE
    assert narrow.convert(np.array([1.0])).flags == SensorFlags.CLIPPED


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_a_number_is_invalid(value: float) -> None:
    flags = CELL.convert(np.array([0.1, value, 0.1])).flags
    assert flags == SensorFlags.INVALID
    with pytest.raises(SensorFault, match="not a number"):
        raise_for("load cell", flags)


@given(arrays(np.float64, st.integers(0, 40)), st.lists(st.integers(0, 40), max_size=4))
def test_nothing_depends_on_how_frames_are_cut(
    volts: np.ndarray[tuple[int], np.dtype[np.float64]], cuts: list[int]
) -> None:
    whole = CELL.convert(volts)
    parts = [CELL.convert(part) for part in np.split(volts, sorted(min(cut, volts.size) for cut in cuts))]
    np.testing.assert_array_equal(np.concatenate([part.values for part in parts]), whole.values)
    worst = SensorFlags.NONE
    for part in parts:
        worst |= part.flags
    if SensorFlags.INVALID in worst:
        assert SensorFlags.INVALID in whole.flags
    else:
        assert worst == whole.flags


def test_warnings_do_not_stop_a_run_but_faults_do() -> None:
    raise_for("load cell", SensorFlags.HIGH_LOAD | SensorFlags.OVER_RANGE | SensorFlags.SUPPLY_STEP)
    for flag in SensorFlags:
        text = flag.describe()
        assert text != "sound"
        if flag.faulty:
            with pytest.raises(SensorFault, match="Remedy"):
                raise_for("load cell", flag)
    assert SensorFlags.NONE.describe() == "sound"
    assert not SensorFlags.NONE.faulty


def test_the_worst_comes_first() -> None:
    assert (SensorFlags.HIGH_LOAD | SensorFlags.CLIPPED | SensorFlags.OVERLOAD).describe() == (
        "saturated; overloaded, beyond 120 % of capacity; beyond 80 % of capacity"
    )


def test_impossible_cells_are_refused() -> None:
    with pytest.raises(InvalidCalibration, match="is in Pa, not N"):
        replace(CELL, calibration=replace(RECORD, unit="Pa"))
    with pytest.raises(ValueError, match="capacity"):
        replace(CELL, capacity=0.0)
    with pytest.raises(ValueError, match="not below"):
        replace(CELL, minimum=1.0, maximum=-1.0)
