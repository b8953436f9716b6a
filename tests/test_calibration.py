"""Calibration records: complete, possible and unchangeable."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import replace
from datetime import date
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.calibration import Calibration, InvalidCalibration
from drivers.errors import DeviceError

RECORD = Calibration(
    id="GSO-1K-2024-03",
    certificate="TT 48213",
    date=date(2024, 3, 5),
    operator="M. Weber",
    serial="317204",
    slope=1.25,
    intercept=-0.01,
    residual=2e-3,
    uncertainty=1e-3,
    temperature=21.5,
)
FIELDS = [field.name for field in dataclasses.fields(Calibration)]


def test_a_record_cannot_be_changed() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        RECORD.slope = 2.0  # type: ignore[misc]


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
        ("date", "5.3.2024", "not a day"),
        ("date", 20240305, "not a day"),
    ],
)
def test_an_impossible_value_is_refused_by_name(key: str, value: Any, told: str) -> None:
    with pytest.raises(InvalidCalibration, match=told.replace(".", r"\.")) as failure:
        replace(RECORD, **{key: value})
    assert key in str(failure.value)
    assert "GSO-1K-2024-03" in str(failure.value)


values = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=9), st.dates(), st.lists(st.none())
)


@given(st.dictionaries(st.sampled_from(FIELDS), values))
def test_no_values_make_anything_but_a_record_or_one_clear_error(changes: dict[str, Any]) -> None:
    try:
        record = replace(RECORD, **changes)
    except DeviceError as error:
        assert error.remedy
    else:
        assert math.isfinite(record.slope)
        assert record.slope != 0
