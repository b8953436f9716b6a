"""Recordings given to ``rig analyze`` and ``rig figure``: bad ones, folders, copies, equal names, their origin."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import pandas as pd
import pytest
from conftest import SHORT, scene_text

from analysis import analyze as analysis_of
from analysis.figures.reasons import reasons
from analysis.figures.run_overview import overview_bytes
from analysis.figures.style import SETTINGS
from rig.bench import load_bench
from rig.calibrate import calibrate
from rig.campaign import JOURNAL, Journal
from rig.cli import main
from rig.collection import Collection, own_names
from rig.measured import load_run
from rig.recording import load_recording
from rig.scene import Scene
from rig.session import Request, run_scene

PROTOCOL = {**SHORT, "retract_speed_um_s": 200.0}


def record(out: Path, name: str = "sphere-60mm-vented", seed: int = 0, *, wire: bool = False, **protocol: Any) -> Path:
    text = scene_text(name, **protocol)
    bench, bench_text = load_bench(None)
    scene = Scene.model_validate(tomllib.loads(text))
    request = Request(scene, text, bench, bench_text, out, seed=seed, wire=False, live=False)
    assert run_scene(request).exit_code == 0
    return out


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of recordings, one of each kind; tests copy what they change."""
    folder = tmp_path_factory.mktemp("made")
    record(folder / "first.h5", seed=0, **PROTOCOL)
    record(folder / "second.h5", seed=1, **PROTOCOL)
    record(folder / "leak.h5", "leak", hold_s=5.0)
    record(folder / "zero.h5", "pressure-zero", rest_s=0.5)
    shutil.copy(folder / "first.h5", folder / "empty.h5")
    with h5py.File(folder / "empty.h5", "r+") as file:
        for group in (file["entry/data"], file["entry/raw"]):
            for item in group.values():
                item.resize(0, axis=0)
    (folder / "text.h5").write_text("no recording")
    return folder


def analyze(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = main(["analyze", *map(str, words)])
    output = capsys.readouterr()
    return code, output.out, output.err


def test_a_bad_recording_does_not_hold_up_the_others(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, names = tmp_path / "new" / "r.html", ("empty", "first", "text", "zero", "leak")
    files = [made / f"{name}.h5" for name in names]
    words = ("--report", page, "--curves", tmp_path / "c", "--afm", tmp_path / "a", "--json", "--jobs", 1)
    code, out, err = analyze(capsys, *files, *words)
    assert code == 1
    found = json.loads(out)
    assert [run["run"] for run in found["runs"]] == ["first", "leak"]
    left = {Path(one["file"]).stem: one["reason"] for one in found["not_analysed"]}
    assert left.keys() == {"empty", "text", "zero"}
    assert left["empty"] == "only 0 samples; nothing to analyse"
    assert "not a readable HDF5 file" in left["text"]
    assert "a calibration (pressure_zero)" in left["zero"]
    text = page.read_text("utf-8")
    assert "3 files could not be analysed" in text
    for name, reason in left.items():
        assert f"not analysed: {made / name}.h5: {reason}" in err
        assert f"{name}.h5" in text
    assert "no curve: leak: a test of the kind leak has none" in err
    assert "no .tab: leak: no approach or no retraction" in err
    assert [path.name for path in (tmp_path / "c").iterdir()] == ["first.csv"]
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["first.tab"]


def test_nothing_to_analyse_is_an_error_and_writes_nothing(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = analyze(capsys, made / "text.h5", made / "gone.h5", "--report", tmp_path / "r.html")
    assert (code, out) == (2, "")
    assert f"not analysed: {made / 'gone.h5'}: no such file" in err
    assert not (tmp_path / "r.html").exists()


def test_an_error_nobody_has_thought_of_is_named(
    made: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*words: object, **options: object) -> None:
        raise ZeroDivisionError("float division")

    monkeypatch.setattr("analysis.batch.analyze_run", fail)
    code, _, err = analyze(capsys, made / "first.h5")
    assert code == 2
    assert "first.h5: the analysis failed (ZeroDivisionError: float division). Remedy: report it" in err


def test_a_folder_stands_for_its_recordings(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("first", "second", "text"):
        shutil.copy(made / f"{name}.h5", tmp_path)
    code, out, _ = analyze(capsys, tmp_path, "--json")
    assert code == 1
    assert [run["run"] for run in json.loads(out)["runs"]] == ["first", "second"]
    journal = Journal(tmp_path)
    journal.write("a test", "second.h5")
    journal.write("another", "first.h5")
    code, out, err = analyze(capsys, tmp_path, "--json")
    assert code == 0
    assert [run["run"] for run in json.loads(out)["runs"]] == ["first", "second"]
    assert f"text.h5: not in the campaign's {JOURNAL}; left out" in err
    (tmp_path / "none").mkdir()
    assert analyze(capsys, tmp_path / "none")[0] == 2


def test_a_recording_counts_once(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, copied = made / "first.h5", tmp_path / "copy.h5"
    shutil.copy(first, copied)
    code, out, err = analyze(capsys, first, copied, first, "--json")
    found = json.loads(out)
    assert code == 1
    assert len(found["runs"]) == 1
    assert next(row for row in found["pooled"] if row["feature"] == "pull_off_force_N")["count"] == 1
    assert found["not_analysed"] == [{"file": str(copied), "reason": f"is a copy of {first}; it counts once"}]
    assert f"{first}: named twice; it counts once" in err


def test_equal_names_are_told_apart(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder, name in (("one", "first"), ("two", "second")):
        (tmp_path / folder).mkdir()
        shutil.copy(made / f"{name}.h5", tmp_path / folder / "run.h5")
    code, out, _ = analyze(capsys, tmp_path / "one", tmp_path / "two", "--csv", "--curves", tmp_path / "c")
    assert code == 0
    assert {"one-run", "two-run"} < {line.partition(",")[0] for line in out.splitlines()}
    assert sorted(path.name for path in (tmp_path / "c").iterdir()) == ["mean-1.csv", "one-run.csv", "two-run.csv"]
    areas = tmp_path / "areas.csv"
    areas.write_text("recording,area_mm2\none-run,0.8\nrun,0.9\n")
    _, _, err = analyze(capsys, tmp_path / "one", tmp_path / "two", "--csv", "--areas", areas)
    assert "run is not among the recordings" in err
    assert "one-run is not" not in err


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["a/x.h5", "b/y.h5"], ["x", "y"]),
        (["a/x.h5", "b/x.h5", "b/y.h5"], ["a-x", "b-x", "y"]),
        (["p/a/x.h5", "q/a/x.h5", "q/X.h5"], ["p-a-x", "q-a-x", "q-X"]),
        (["a/x.h5", "a/x.hdf5"], ["x.h5", "x.hdf5"]),
        (["a/b\nc.h5", "a/\udcff.h5"], ["b\\nc", "\\udcff"]),
        ([], []),
    ],
)
def test_names_take_as_many_folders_as_they_need(paths: list[str], names: list[str]) -> None:
    assert own_names([Path("/data") / path for path in paths]) == names


def test_where_the_data_come_from_is_told(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "r.html"
    code, out, _ = analyze(capsys, made / "second.h5", made / "leak.h5", "--report", page, "--json")
    assert code == 0
    vented, leak = json.loads(out)["runs"]
    assert vented["path"] == (made / "second.h5").as_posix()
    assert re.fullmatch("[0-9a-f]{64}", vented["sha256"])
    assert vented["emulated"] is True
    assert (vented["bench"], vented["seed"], vented["substrate"]) == ("emulated bench", 1, "sphere 60 mm")
    assert vented["initial_pressure_set_point_Pa"] is None
    assert leak["initial_pressure_set_point_Pa"] == -3000.0
    assert vented["force_calibration"] == "emulated-GSO-500-V"
    assert "numpy" in vented["recorded_with"]
    assert {vented["condition"], leak["condition"]} == {row["condition"] for row in json.loads(out)["pooled"]}
    text = page.read_text("utf-8")
    assert text.index("EMULATED: all data are from an emulated bench") < text.index("<h2>")
    for words in ("emulated bench", "emulated-GSO-500-V", "sphere 60 mm", "Leak of the chamber"):
        assert words in text
    assert "EMULATED" in analyze(capsys, made / "leak.h5")[1]


def test_a_report_of_recordings_is_the_same_twice(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pages = [tmp_path / name for name in ("1.html", "2.html")]
    for page in pages:
        analyze(capsys, made / "leak.h5", made / "text.h5", "--report", page)
    assert pages[0].read_bytes() == pages[1].read_bytes()


def test_a_name_that_looks_like_a_formula_is_shown_as_it_is(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    odd = tmp_path / "$x^{1$.h5"
    shutil.copy(made / "first.h5", odd)
    code, _, _ = analyze(capsys, odd, "--report", tmp_path / "r.html", "--pdf", tmp_path / "r.pdf")
    assert code == 0
    assert "$x^{1$" in (tmp_path / "r.html").read_text("utf-8")


def test_calibrations_have_a_form_for_programs(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = analyze(capsys, made / "zero.h5", made / "first.h5", "--json")
    found = json.loads(out)
    assert code == 0
    (zero,) = found["calibrations"]
    assert zero["protocol"] == "pressure_zero"
    assert zero["calibration"]["noise_Pa"] > 0
    assert "[pressure.zero]" in zero["bench_file"]
    assert [run["run"] for run in found["runs"]] == ["first"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--report", "{}/r.txt"], "must end in .html"),
        (["--pdf", "/dev/full"], "must end in .pdf"),
        (["--report", "{}/folder.html"], "is a folder"),
        (["--report", "{}/file/r.html"], "cannot be written"),
        (["--curves", "{}/file/c"], "cannot be written"),
        (["--afm", "{}/file"], "cannot be written"),
        (["--scheduler", "nonsense"], "no Dask scheduler answers"),
    ],
)
def test_impossible_options_are_refused(
    made: Path, tmp_path: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if "--scheduler" in words:
        pytest.importorskip("distributed")
    (tmp_path / "folder.html").mkdir()
    (tmp_path / "file").write_text("")
    code, out, err = analyze(capsys, made / "first.h5", *(word.format(tmp_path) for word in words))
    assert (code, out) == (2, "")
    assert said in err
    assert "Remedy" in err


@pytest.mark.parametrize("words", [["--jobs", "0"], ["--jobs", "-3"], ["--jobs", "two"], ["--bogus"]])
def test_bad_words_are_refused_by_the_parser(made: Path, words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["analyze", str(made / "first.h5"), *words])
    assert words[0] in capsys.readouterr().err


def test_tables_tell_what_they_left_out_and_what_they_do_not_know(
    made: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("analysis.repeats._outliers", lambda members: {"second": "F_p = far off"})
    code, out, error = analyze(capsys, made / "first.h5", made / "second.h5", "--tables")
    assert "EMULATED, no experiment: first, second" in error
    assert code == 0
    assert "| second |" in out
    assert "far off" in out
    code, out, error = analyze(capsys, made / "leak.h5", "--tables")
    assert (code, out) == (0, "")
    assert "no such tests (leak)" in error


def test_figures_say_what_they_do_not_show(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "z.png"
    files = [str(made / f"{name}.h5") for name in ("first", "leak", "text")]
    assert main(["figure", "2b", "--out", str(out), *files]) == 1
    err = capsys.readouterr().err
    assert out.exists()
    assert "not used: leak: no curve: a test of the kind leak has none" in err
    assert "text.h5: not a readable HDF5 file" in err
    assert "first" not in err
    assert main(["figure", "3a", "--out", str(out), files[0]]) == 1
    err = capsys.readouterr().err
    assert "not used: first: nothing of figure 3a shows it (d_b 60 mm, vented)" in err
    assert "no recording could be used: the models stand alone" in err
    assert main(["figure", "2b", "--out", str(out), str(made / "zero.h5")]) == 2
    assert "a calibration (pressure_zero)" in capsys.readouterr().err
    assert main(["figure", "2a", "--out", str(tmp_path / "f.txt")]) == 2
    assert ".png or .svg or .pdf" in capsys.readouterr().err


def test_what_could_not_be_analysed_sets_the_exit_code() -> None:
    assert Collection().exit_code == 0
    assert Collection(left={"a": "b"}).exit_code == 2


def rewrite(path: Path, part: str, *changes: tuple[str, str]) -> None:
    """Change the text of a scene or bench within a recording."""
    with h5py.File(path, "r+") as file:
        whole = file[f"entry/configuration/{part}"]
        text = whole.asstr()[()]
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        whole[()] = text


def test_what_was_recorded_stays_readable_when_bounds_and_rules_become_narrower(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = shutil.copy(made / "first.h5", tmp_path / "first.h5")
    rewrite(
        old, "bench", ("compression_N = 4.4", "compression_N = 44.0"), ("look_ahead_um = 50.0", "look_ahead_um = 5e6")
    )
    rewrite(old, "bench", ('title = "emulated bench"', f'title = "{"long " * 50}\\u001b[2J"'))
    rewrite(old, "scene", ("radius_mm = 8.0", "radius_mm = 1.0"), ("thickness_um = 200.0", "thickness_um = 1e6"))
    code, out, err = analyze(capsys, old, "--json")
    assert code == 0, err
    found, before = json.loads(out), json.loads(analyze(capsys, made / "first.h5", "--json")[1])
    assert found["pull_off_force_N"] == before["pull_off_force_N"]
    assert found["bench"].endswith("long \\x1b[2J")


@pytest.mark.parametrize(
    ("part", "change", "words"),
    [
        ("bench", ("compression_N = 4.4", 'compression_N = "4.4"'), "limits.compression_N = '4.4'"),
        ("bench", ("compression_N = 4.4", "compression_N = nan"), "limits.compression_N = nan"),
        ("bench", ("tension_N = 4.4", ""), "limits.tension_N is missing"),
        ("scene", ('shape = "sphere"', 'shape = "cube"'), "substrate.shape = 'cube'"),
    ],
)
def test_a_recorded_text_of_wrong_structure_names_recording_and_key(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], part: str, change: tuple[str, str], words: str
) -> None:
    spoilt = shutil.copy(made / "first.h5", tmp_path / "first.h5")
    rewrite(spoilt, part, change)
    code, _, err = analyze(capsys, spoilt)
    assert code == 2
    assert f"{spoilt}:{part}: {words}" in err
    assert "Traceback" not in err


def as_if_elsewhere(path: Path) -> None:
    """Give a recording a bench whose instruments answer at addresses, as those of ``rig emulate`` do."""
    first, second, third = (f'connection = "{address}"' for address in ("socket://h:1", "socket://h:2", "grpc://h:3"))
    emulated = 'connection = "emulated"'
    with h5py.File(path, "r+") as file:
        whole = file["entry/configuration/bench"]
        head, *rest = whole.asstr()[()].split(emulated)
        whole[()] = head + "".join(part + after for part, after in zip((first, second, third), rest, strict=True))


def test_emulated_instruments_that_are_served_are_told_from_real_ones(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = shutil.copy(made / "first.h5", tmp_path / "served.h5")
    as_if_elsewhere(path)
    rewrite(path, "run", ("emulated, direct", "NI-DAQmx 24.8.0"))
    assert not load_recording(path).bench.is_emulated
    found = json.loads(analyze(capsys, path, "--json")[1])
    assert found["emulated"] is True
    assert found["seed"] is None
    assert "served  (pull_off, EMULATED)" in analyze(capsys, path)[1]


def test_figures_of_emulated_recordings_say_so_in_picture_and_data(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [shutil.copy(made / f"{name}.h5", tmp_path) for name in ("first", "second")]
    svg, table = tmp_path / "f.svg", tmp_path / "f.csv"
    monkeypatch.setitem(SETTINGS, "svg.fonttype", "none")

    def drawn(number: str, *recordings: str) -> tuple[str, pd.DataFrame]:
        assert main(["figure", number, "--out", str(svg), *recordings]) == 0
        return svg.read_text("utf-8"), pd.read_csv(table)

    picture, data = drawn("5c", *files)
    assert ">EMULATED, no experiment<" in picture
    assert data.loc[data["source"] == "measured", "EMULATED"].eq("yes").all()
    assert data.loc[data["source"] != "measured", "EMULATED"].isna().all()
    monkeypatch.setattr("rig.measured.is_emulated", lambda recording: recording.path.stem == "first")
    assert ">partly EMULATED, no experiment<" in drawn("5c", *files)[0]
    monkeypatch.setattr("rig.measured.is_emulated", lambda recording: False)
    for picture, data in (drawn("5c", *files), drawn("5c")):
        assert "EMULATED" not in picture
        assert "EMULATED" not in data


def test_the_pictures_of_a_run_say_that_it_is_emulated(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SETTINGS, "svg.fonttype", "none")
    for name in ("first", "leak"):
        run = load_run(made / f"{name}.h5")
        for one, count in ((run, 1), (replace(run, emulated=False), 0)):
            analysis = analysis_of(one, uncertainties=False)
            assert overview_bytes(one, analysis, None, "svg").count(b"EMULATED") == count
            assert reasons(analysis, "svg").count(b"EMULATED") == count
    picture = calibrate(load_recording(made / "zero.h5")).picture
    assert picture.emulated
