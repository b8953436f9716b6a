"""Calibration records: complete, unchangeable, and telling when they have been edited."""

from __future__ import annotations

import dataclasses
import json
import math
from datetime import date, datetime
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.calibration import Calibration, InvalidCalibration
from drivers.errors import DeviceError

RECORD: dict[str, Any] = {
    "id": "GSO-1K-2024-03",
    "certificate": "TT 48213",
    "date": "2024-03-05",
    "operator": "M. Weber",
    "serial": "317204",
    "slope": 1.25,
    "intercept": -0.01,
    "residual": 2e-3,
    "uncertainty": 1e-3,
    "temperature": 21.5,
}


def test_a_record_survives_a_file() -> None:
    record = Calibration.from_mapping(RECORD)
    again = Calibration.from_mapping(json.loads(json.dumps({**record.as_mapping(), "digest": record.digest})))
    assert again == record
    assert again.digest == record.digest
    assert record.date == date(2024, 3, 5)
    assert (record.unit, record.recorded_unit) == ("N", "V")


def test_a_record_cannot_be_changed() -> None:
    record = Calibration.from_mapping(RECORD)
    with pytest.raises(dataclasses.FrozenInstanceError):
        record.slope = 2.0  # type: ignore[misc]


@pytest.mark.parametrize("key", sorted(RECORD.keys() - {"id"}))
def test_an_edited_value_is_refused(key: str) -> None:
    digest = Calibration.from_mapping(RECORD).digest
    value = RECORD[key]
    edited = {**RECORD, key: "2024-03-06" if key == "date" else value + ("x" if isinstance(value, str) else 1e-9)}
    with pytest.raises(InvalidCalibration, match="has been edited"):
        Calibration.from_mapping({**edited, "digest": digest})
    Calibration.from_mapping({**edited, "digest": Calibration.from_mapping(edited).digest})


def test_whole_numbers_and_days_of_a_toml_file_are_the_same_record() -> None:
    from_toml = {**RECORD, "temperature": 21, "date": date(2024, 3, 5)}
    from_json = {**RECORD, "temperature": 21.0}
    assert Calibration.from_mapping(from_toml).digest == Calibration.from_mapping(from_json).digest
    with_time = {**RECORD, "date": datetime(2024, 3, 5, 12, 0)}
    assert Calibration.from_mapping(with_time).date == date(2024, 3, 5)


@pytest.mark.parametrize("key", sorted(RECORD))
def test_every_field_is_required(key: str) -> None:
    with pytest.raises(InvalidCalibration, match=f"{key} is missing"):
        Calibration.from_mapping({name: value for name, value in RECORD.items() if name != key})


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("slope", 0.0, "slope is 0"),
        ("slope", math.nan, "finite"),
        ("slope", "1.25", "finite"),
        ("slope", True, "finite"),
        ("intercept", math.inf, "finite"),
        ("residual", -1.0, "negative"),
        ("uncertainty", 1.5, "0...1"),
        ("uncertainty", -0.1, "0...1"),
        ("certificate", "", "must be a text"),
        ("operator", 7, "must be a text"),
        ("serial", "FILL IN", "placeholder"),
        ("certificate", "<number>", "placeholder"),
        ("date", "5.3.2024", "not of the form"),
        ("date", 20240305, "not a day"),
    ],
)
def test_an_impossible_value_is_refused_by_name(key: str, value: object, told: str) -> None:
    with pytest.raises(InvalidCalibration, match=told.replace(".", r"\.")) as failure:
        Calibration.from_mapping({**RECORD, key: value})
    assert key in str(failure.value)
    assert "GSO-1K-2024-03" in str(failure.value)


def test_an_unknown_key_is_refused() -> None:
    with pytest.raises(InvalidCalibration, match="unknown key 'slop'"):
        Calibration.from_mapping({**RECORD, "slop": 1.0})


values = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=9), st.dates(), st.lists(st.none())
)


@settings(suppress_health_check=[HealthCheck.too_slow])  # the first strings of a process take seconds
@given(st.dictionaries(st.sampled_from([*RECORD, "digest", "unit", "other"]), values))
def test_no_table_of_a_file_makes_anything_but_a_record_or_one_clear_error(table: dict[str, Any]) -> None:
    try:
        record = Calibration.from_mapping({**RECORD, **table})
    except DeviceError as error:
        assert error.remedy
    else:
        assert math.isfinite(record.slope)
        assert Calibration.from_mapping({**record.as_mapping(), "digest": record.digest}) == record


def test_weights_give_slope_intercept_residual_and_uncertainty() -> None:
    noise = np.random.default_rng(3)
    loads = -np.array([0, 1, 2, 3, 4, 5, 4, 3, 2, 1, 0]) * 0.980665  # hung weights, up and down
    volts = (loads + 0.05) / 1.25 + 1e-4 * noise.standard_normal(loads.size)
    rest = {key: value for key, value in RECORD.items() if key not in ("slope", "intercept", "residual", "date")}
    record = Calibration.from_points(volts, loads, date=date(2024, 3, 5), **rest)
    assert record.slope == pytest.approx(1.25, rel=2e-4)
    assert record.intercept == pytest.approx(-0.05, abs=4e-4)
    assert 2e-5 < record.residual < 4e-4
    assert 1e-3 < record.uncertainty < 1.01e-3


def test_the_uncertainty_of_a_fit_is_the_spread_of_repeated_fits() -> None:
    noise = np.random.default_rng(3)
    loads = -np.array([0, 1, 2, 3, 4, 5, 4, 3, 2, 1, 0]) * 0.980665
    rest = {key: value for key, value in RECORD.items() if key not in ("slope", "intercept", "residual", "date")}
    fits = [
        Calibration.from_points(
            loads / 1.25 + 1e-3 * noise.standard_normal(loads.size),
            loads,
            date=date(2024, 3, 5),
            **{**rest, "uncertainty": 0.0},
        )
        for _ in range(400)
    ]
    told = np.sqrt(np.mean([fit.uncertainty**2 for fit in fits]))
    assert told == pytest.approx(np.std([fit.slope for fit in fits]) / 1.25, rel=0.15)


@pytest.mark.parametrize("loads", [[0.0, 1.0, 2.0, 3.0], [1.0] * 8, [[0.0, 1.0, 2.0, 3.0, 4.0]]])
def test_too_few_weights_are_refused(loads: list[Any]) -> None:
    with pytest.raises(InvalidCalibration, match="at least 5"):
        Calibration.from_points(np.array(loads) * 2, loads, id="x")
