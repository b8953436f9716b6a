"""The check of the published tables, and the interval arithmetic behind it."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.intervals import Interval, as_printed, mean
from analysis.published import (
    KNOWN_ERRATA,
    TABLE_S3,
    TABLE_S4,
    Verdict,
    checks,
    consistent_populations,
    is_erratum,
    markdown,
)
from rig.cli import main

FINITE = st.floats(-1e3, 1e3)
PAIRS = st.tuples(FINITE, FINITE).map(sorted)


def test_only_the_known_erratum_disagrees() -> None:
    disagreeing = [check for check in checks() if check.verdict is Verdict.DISAGREES]
    assert len(disagreeing) == 4
    assert all(is_erratum(check) for check in disagreeing)
    assert [check.table for check in checks() if is_erratum(check)] == ["S1"] * 4
    assert len(KNOWN_ERRATA) == 1


def test_the_erratum_is_the_soft_systems_area() -> None:
    for check in checks():
        if is_erratum(check):
            wrong = check.recomputed * 1.7 / 2.545
            assert Interval.printed(check.printed).overlaps(Interval(wrong * 0.99, wrong * 1.01))


def test_every_derived_value_is_checked() -> None:
    counts = Counter(check.table for check in checks())
    assert counts == {"S1": 14, "S2": 23, "S3": 4, "S4": 4, "S5": 7}
    verdicts = Counter(check.verdict for check in checks())
    assert verdicts == {Verdict.REPRODUCES: 23, Verdict.AGREES: 25, Verdict.DISAGREES: 4}


def test_mixed_populations() -> None:
    assert consistent_populations(TABLE_S4) == pytest.approx((2.615, 57.5), rel=2e-3)
    assert consistent_populations(TABLE_S3) == pytest.approx((4.276, 104.2), rel=2e-3)


def test_page_is_up_to_date() -> None:
    page = Path(__file__).parents[1] / "docs" / "published-tables.md"
    assert page.read_text(encoding="utf-8") == markdown()


def test_command_prints_the_check(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["analyze", "--published", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["checks"]
    assert len(found) == len(checks())
    assert sum(row["verdict"] == "disagrees" for row in found) == 4


@given(PAIRS, PAIRS, st.floats(0, 1), st.floats(0, 1))
def test_intervals_hold_every_result(first: list[float], second: list[float], s: float, t: float) -> None:
    a, b = Interval(*first), Interval(*second)
    x, y = (low + u * (high - low) for (low, high), u in ((first, s), (second, t)))
    slack = 1e-9 * (1 + abs(x) + abs(y) + abs(x * y))
    assert (a + b).low - slack <= x + y <= (a + b).high + slack
    assert (a * b).low - slack <= x * y <= (a * b).high + slack


@given(st.floats(0.01, 1e3), st.floats(0.01, 1e3))
def test_division_undoes_multiplication(value: float, factor: float) -> None:
    product = Interval.exactly(value) * Interval.exactly(factor) / Interval.exactly(factor)
    assert product.low == pytest.approx(value)
    assert product.high == pytest.approx(value)


def test_division_by_zero_is_refused() -> None:
    with pytest.raises(ZeroDivisionError, match="holds zero"):
        Interval(1, 2) / Interval(-1, 1)


def test_printed_numbers_stand_for_half_a_unit() -> None:
    assert Interval.printed("0.30") == Interval(pytest.approx(0.295), pytest.approx(0.305))
    assert Interval.printed("-51.0").low == pytest.approx(-51.05)
    assert as_printed(1.15, "1.2") == "1.2"
    assert as_printed(2.346, "1.23") == "2.35"
    assert mean([Interval(1, 2), Interval(3, 4)]) == Interval(2, 3)
