"""The accuracy study of the membrane in its reduced form: errors and counts, never seconds."""

import pytest

from analysis.accuracy import membrane_study
from analysis.accuracy.report import studies


@pytest.fixture(scope="module")
def table():
    name, case = next(iter(membrane_study.STATES.items()))
    section = membrane_study._one_state(name, *case, True, lambda _: None)
    return next(iter(section.tables.values()))


def test_studies_are_part_of_the_report():
    assert {"membrane_study", "load_sharing_study"} <= set(studies())


def test_collocation_reaches_rounding_with_few_points(table):
    ours = table[table["method"] == "collocation"].set_index("setting")
    assert ours.loc["N = 3", "error_force"] < 1e-5
    assert ours.loc["N = 6", "error_force"] < 1e-11
    assert ours.loc["N = 10", ["error_force", "error_height"]].max() < 1e-12
    assert ours["evaluations"].max() <= 200


def test_other_methods_converge_to_the_same_state(table):
    for method in ("solve_bvp", "shooting, DOP853"):
        rows = table[table["method"] == method]
        assert rows["error_force"].iloc[-1] < 1e-8
        assert rows["error_force"].iloc[-1] < rows["error_force"].iloc[0]
        assert rows["evaluations"].min() > 100
