"""The report, the command line and the exports, on recordings made of synthetic runs."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from analysis import Run, analyze
from analysis.quantity import with_uncertainty
from analysis.synthetic import Experiment, Imperfections, Profile, pull_off_run
from model import Gas, Parameters, Substrate, predict
from rig.cli import main

SCENE = Parameters(Substrate("sphere", 60e-3), gas=Gas(initial_pressure=-1000.0))
FAST = Experiment(rate=100.0, retract_speed=100e-6, dwell=2.0, settle=2.0, tail=3.0)


@cache
def synthetic(name: str) -> Run:
    seed = sum(name.encode())
    run, _ = pull_off_run(
        Profile.of(predict(SCENE)), FAST, Imperfections(force_noise=3e-4), seed=seed, parameters=SCENE
    )
    run = replace(run, name=name)
    if name != "aborted":
        return run
    dwell = run.step("dwell")
    assert dwell is not None
    assert run.pressure is not None
    stop = dwell.stop
    return replace(
        run,
        force=run.force[:stop],
        pressure=run.pressure[:stop],
        height=run.height[:stop],
        steps=run.steps[:3],
        complete=False,
    )


@pytest.fixture
def recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Path]]:
    """Files that stand for recordings; what they hold comes from ``synthetic``."""
    monkeypatch.setattr("rig.measured.load_run", lambda path: synthetic(path.stem))
    monkeypatch.setattr("rig.recording.load_recording", lambda path: SimpleNamespace(path=path))
    monkeypatch.setattr("rig.measured.as_run", lambda recording: synthetic(recording.path.stem))
    monkeypatch.setattr("rig.calibrate.calibrate", lambda recording: None)
    monkeypatch.setattr("rig.measured.provenance", lambda recording: {"bench": "none"})
    paths = [tmp_path / f"{name}.h5" for name in ("first", "second", "aborted")]
    for path in paths:
        path.write_bytes(path.stem.encode())
    return iter([paths])


@pytest.fixture
def files(recordings: Iterator[list[Path]]) -> list[str]:
    return [str(path) for path in next(recordings)]


def test_report_is_one_page_that_needs_nothing_else(files: list[str], tmp_path: Path) -> None:
    page = tmp_path / "out.html"
    assert main(["analyze", *files, "--report", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    assert not re.search(r'(src|href)="(?!data:)', text)
    assert "http" not in re.sub(r"data:image/png;base64,[A-Za-z0-9+/=]+", "", text)
    assert text.count("data:image/png;base64,") >= 6
    for words in ("Table S1", "±", "Outliers", "Grubbs", "Measured and predicted", "Versions", "numpy", "aborted"):
        assert words in text, words
    for path in files:
        assert hashlib.sha256(Path(path).read_bytes()).hexdigest() in text
    assert str(tmp_path) not in text


def test_same_recordings_same_bytes(files: list[str], tmp_path: Path) -> None:
    outputs = []
    for number in range(2):
        page, print_out = tmp_path / f"{number}.html", tmp_path / f"{number}.pdf"
        assert main(["analyze", *files[:1], "--report", str(page), "--pdf", str(print_out)]) == 0
        outputs.append((page.read_bytes(), print_out.read_bytes()))
    assert outputs[0] == outputs[1]
    assert outputs[0][1].startswith(b"%PDF")


def test_json_of_one_run(files: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["analyze", files[0], "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    truth = predict(SCENE)
    assert found["pull_off_force_N"] == pytest.approx(truth.pull_off_force, rel=0.01)
    assert found["pull_off_distance_m"] == pytest.approx(truth.pull_off_distance, rel=0.01)
    assert found["uncertainty"]["pull_off_force_N"] > 0
    assert found["complete"] is True


def test_json_of_several_runs_pools_them(files: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["analyze", *files, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [run["run"] for run in found["runs"]] == ["first", "second", "aborted"]
    assert "no retraction" in found["runs"][2]["missing"]["pull_off_force_N"]
    force = next(row for row in found["pooled"] if row["feature"] == "pull_off_force_N")
    assert force["count"] == 2
    assert "Grubbs" in found["outlier_rule"]


def test_csv_and_words(files: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    import io

    assert main(["analyze", files[0], "--csv"]) == 0
    table = pd.read_csv(io.StringIO(capsys.readouterr().out))
    assert {"run", "feature", "value", "uncertainty", "unit", "explanation", "missing"} == set(table.columns)
    assert main(["analyze", *files, "--csv"]) == 0
    table = pd.read_csv(io.StringIO(capsys.readouterr().out))
    force = table[table["feature"] == "pull_off_force_N"]
    gap = force[force["run"] == "aborted"].iloc[0]
    assert np.isnan(gap["value"])
    assert "no retraction" in gap["missing"]
    force = force[force["value"].notna()]
    pooled, single = force[force["count"].notna()].iloc[0], force[force["count"].isna()]
    assert list(single["run"]) == ["first", "second"]
    assert pooled["count"] == 2
    assert pooled["value"] == pytest.approx(single["value"].mean())
    assert pooled["standard_deviation"] == pytest.approx(single["value"].std(), rel=1e-4)
    assert "60 mm" in pooled["run"]
    assert main(["analyze", files[2]]) == 0
    words = capsys.readouterr().out
    assert "aborted" in words
    assert "missing: the run has no retraction" in words
    assert main(["analyze", *files[:2], "--tables"]) == 0
    assert "Table S1" in capsys.readouterr().out


def test_curves_of_runs_and_their_mean(files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["analyze", *files, "--curves", str(tmp_path / "curves")]) == 1
    assert "no curve: aborted: the run has no retraction" in capsys.readouterr().err
    names = sorted(path.name for path in (tmp_path / "curves").iterdir())
    assert names == ["first.csv", "mean-1.csv", "second.csv"]
    mean = pd.read_csv(tmp_path / "curves" / "mean-1.csv")
    assert mean["force_N"].min() == pytest.approx(-predict(SCENE).pull_off_force, rel=0.02)


def test_afmformats_opens_the_export(files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import afmformats

    assert main(["analyze", files[0], files[2], "--afm", str(tmp_path)]) == 1
    assert "no .tab: aborted: no approach or no retraction" in capsys.readouterr().err
    (curve,) = afmformats.load_data(tmp_path / "first.tab")
    assert curve.modality == "force-distance"
    assert curve.retr["force"].min() == pytest.approx(-predict(SCENE).pull_off_force, rel=0.02)
    assert curve.appr["force"].max() == pytest.approx(FAST.preload, rel=0.05)
    height = curve.retr["height (measured)"]
    assert np.all(np.diff(height[10:-10]) > 0)
    assert curve.metadata["rate approach"] > 0


def test_no_recording_is_an_error_with_a_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["analyze"]) == 2
    assert "Remedy" in capsys.readouterr().err


def test_figure_command_writes_picture_and_data(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "fig.svg"
    assert main(["figure", "3c", files[0], "--out", str(out)]) == 0
    assert out.read_text(encoding="utf-8").lstrip().startswith("<?xml")
    assert (pd.read_csv(out.with_suffix(".csv"))["source"] == "measured").all()
    assert str(out) in capsys.readouterr().out
    assert main(["figure", "nonsense"]) == 1
    assert "choose one of" in capsys.readouterr().err
    assert main(["figure", "list"]) == 0
    assert "S8" in capsys.readouterr().out


def test_repeats_state_uncertainty_and_deviation() -> None:
    from analysis.repeats import group
    from analysis.report import pooled_table

    runs = [analyze(synthetic(name)) for name in ("first", "second")]
    both, alone = (pooled_table(group(runs[:count])) for count in (2, 1))
    pooled = group(runs)[0].pooled("initial_pressure_Pa")
    assert pooled is not None
    place = both.header.index("P_0 [kPa]")
    mean = with_uncertainty(pooled.mean * 1e-3, pooled.uncertainty * 1e-3)
    assert both.rows[0][1:2] == ("2",)
    number, deviation = both.rows[0][place].split(" ")  # the one place where a narrow page may break it
    assert number.split() == mean.split()
    assert deviation.split() == f"(s = {pooled.deviation * 1e-3:.2g})".split()
    assert alone.rows[0][place].replace("\u00a0", " ") == str(runs[0].features["initial_pressure_Pa"]).removesuffix(
        " kPa"
    )


def test_runs_stand_under_their_condition(files: list[str], tmp_path: Path) -> None:
    page = tmp_path / "out.html"
    assert main(["analyze", files[2], *files[:2], "--report", str(page)]) == 0
    runs = page.read_text(encoding="utf-8").partition("<h2>Runs</h2>")[2]
    assert re.findall("<h[34]>(.*?)</h[34]>", runs) == ["d_b 60 mm, P_0 = -1.0 kPa", "aborted", "first", "second"]
