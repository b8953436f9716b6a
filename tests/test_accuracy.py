"""The reduced accuracy report: errors and evaluation counts, never seconds."""

from __future__ import annotations

import functools

import pandas as pd
import pytest

from analysis.accuracy import cone_study
from analysis.accuracy.report import markdown, studies, write_report
from analysis.accuracy.section import Section
from model import Gas, GasAnchor, Parameters, Substrate, cone, grid

FLAT = cone_study.PROBLEMS["flat, +1 kPa"]


@functools.cache
def solved():
    return cone.solve(FLAT)


@pytest.mark.parametrize("name", list(cone_study.PROBLEMS))
def test_solver_is_exact_at_every_resolution_of_its_scan(name):
    scene = cone_study.PROBLEMS[name]
    truth = cone_study.exact(scene)
    for nodes in cone_study.SCANS:
        one = cone.solve(scene, nodes=nodes)
        assert abs(float(one.pull_off_force / truth.pull_off_force - 1)) < 1e-13
        assert abs(float(one.pull_off_distance / truth.pull_off_distance - 1)) < 1e-13


@pytest.mark.parametrize(("name", "most"), list(zip(cone_study.PROBLEMS, (800, 900, 1600), strict=True)))
def test_solver_needs_few_evaluations(name, most):
    counts = cone.solve(cone_study.PROBLEMS[name]).evaluations
    assert counts["elastic energy"] <= most
    assert counts.get("contact stretch", 0) <= 400


@pytest.mark.parametrize("as_described", [False, True])
def test_grid_converges_to_the_solver_with_first_order(as_described):
    sizes = ((101, 251), (401, 1001), (1601, 4001))
    errors = []
    for positions, radii in sizes:
        result = grid.solve(FLAT, positions=positions, radii=radii, as_described=as_described)
        errors.append(abs(result.pull_off_force / solved().pull_off_force - 1))
        assert result.pull_off_distance == pytest.approx(solved().pull_off_distance, rel=4e-3)
        assert result.evaluations > 0.9 * positions * radii
    assert errors[0] > 2 * errors[1] > 4 * errors[2]
    assert errors[2] < 2e-4


def test_grid_in_single_precision_loses_digits():
    result = grid.solve(FLAT, positions=1001, radii=2501, dtype="float32")
    assert abs(result.pull_off_force / solved().pull_off_force - 1) > 1e-3


@pytest.mark.parametrize("anchor", [GasAnchor.FREE, GasAnchor.START, GasAnchor.VENTED])
@pytest.mark.parametrize("contact_stretch", [True, False])
def test_grid_knows_every_scene(anchor, contact_stretch):
    scene = Parameters(Substrate("sphere", 40e-3), gas=Gas(-500.0, anchor=anchor))
    ours = cone.solve(scene, contact_stretch=contact_stretch)
    result = grid.solve(scene, contact_stretch=contact_stretch, positions=501, radii=1251)
    assert result.pull_off_force == pytest.approx(ours.pull_off_force, rel=1e-2)
    assert result.pull_off_distance == pytest.approx(ours.pull_off_distance, rel=1e-2)


def test_every_study_of_the_package_is_found():
    assert {"cone_study", "published_study", "stability_study"} <= set(studies())


def test_report_writes_page_tables_and_pictures(tmp_path, monkeypatch):
    from analysis.accuracy import report

    table = pd.DataFrame({"method": ["a", "b"], "error": [1.23456e-7, float("nan")]})

    def sections(quick, progress):
        progress("one")
        picture = {"picture": lambda path: path.write_bytes(b"png")}
        tables = {"short": table, "long": table}
        return [Section("A study", "words", tables, picture, {"picture": "What it shows"}, frozenset({"long"}))]

    monkeypatch.setattr(report, "studies", lambda: ["one_study"])
    monkeypatch.setattr(report, "_sections", lambda name: sections)
    said = []
    page = write_report(tmp_path, quick=True, progress=said.append).read_text(encoding="utf-8")
    assert said == ["one"]
    assert "## A study" in page
    assert page.count("| a | 1.235e-07 |") == 1
    assert "(accuracy/long.csv)" in page
    assert "(long.csv)" in (tmp_path / "accuracy" / "one_study.md").read_text(encoding="utf-8")
    assert (tmp_path / "accuracy" / "picture.png").read_bytes() == b"png"
    assert "| b | - |" in markdown(table)


def test_work_precision_and_limits_are_drawn(tmp_path):
    from analysis.accuracy.plots import limits, scatter, work_precision

    rows = [cone_study._row("solver", "n", solved(), cone_study.Timing(1.0, 1.0, 0.9, 1.1), 10, cone_study.exact(FLAT))]
    work_precision(pd.DataFrame(rows), cone_study.ERRORS, tmp_path / "work.png")
    points = pd.DataFrame({"series": ["a", "a"], "x": [1e-3, 1e-2], "y": [0.0, 1e-2]})
    limits([("title", "x", "y", points)] * 4, tmp_path / "limits.png")
    scatter(points, ("x", "estimate"), ("y", "error"), tmp_path / "scatter.png")
    assert all((tmp_path / name).stat().st_size > 5000 for name in ("work.png", "limits.png", "scatter.png"))


def test_terms_are_counted_by_scene():
    table = cone_study._terms().tables["cone-terms"].set_index("scene")
    assert table.loc["flat, vented", "chamber gas"] == 0
    assert table.loc["flat, closed chamber", "spherical cap"] == 0
    assert table.loc["60 mm sphere, vented, cone-2017", "contact stretch"] == 0
    assert (table.loc["60 mm sphere, closed chamber, cone"] > 0).all()
