"""``rig predict`` and ``rig sweep`` as a user sees them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from analysis.sweep import sweep
from model import Gas, InvalidParameter, Membrane, Parameters, Substrate, cone, predict
from rig.cli import main
from rig.commands.sweep import parse_axis
from rig.library import load_scene

ROOT = Path(__file__).parents[1]
FLAT = ROOT / "scenes" / "flat-high.toml"
SPHERE = ROOT / "scenes" / "sphere-60mm-low.toml"


def run(capsys, *words):
    code = main([str(word) for word in words])
    output = capsys.readouterr()
    return code, output.out, output.err


def scene_file(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text('[substrate]\nshape = "flat"\n' + text, encoding="utf-8")
    return path


def test_json_has_the_agreed_keys_and_numbers(capsys):
    code, out, err = run(capsys, "predict", FLAT, "--pressure-kpa", "1.0", "--json")
    answer = json.loads(out)
    assert (code, err) == (0, "")
    assert answer["model"] == "cone"
    assert answer["outcome"] == "pull-off"
    assert answer["pull_off_force_N"] == pytest.approx(0.604620, abs=6e-7)
    assert answer["pull_off_distance_m"] == pytest.approx(1.430544e-3, abs=6e-10)
    for key in ("retraction_at_pull_off_m", "zero_force_position_m", "detachment_position_m", "detachment_radius_m"):
        assert isinstance(answer[key], float)
    assert set(answer["numerical_error"]) >= {"pull_off_force_N", "pull_off_distance_m"}
    assert all(0 <= error < 1e-12 for error in answer["numerical_error"].values())
    assert answer["runtime_s"] > 0
    assert "retraction_m" not in answer


def test_profile_comes_as_equal_arrays(capsys):
    _, out, _ = run(capsys, "predict", SPHERE, "--json", "--profile", "--points", "50")
    answer = json.loads(out)
    columns = [answer[key] for key in ("retraction_m", "force_N", "pressure_Pa", "contact_radius_m")]
    assert {len(column) for column in columns} == {50}
    assert min(answer["force_N"]) == pytest.approx(-answer["pull_off_force_N"])


def test_words_name_error_and_run_time(capsys):
    code, out, _ = run(capsys, "predict", SPHERE, "--model", "cone-2017", "--profile")
    assert code == 0
    assert "(cone-2017)" in out
    assert "numerically" in out
    assert "run time" in out
    assert out.count("\t") >= 3 * 200


def test_plot_is_drawn(capsys, tmp_path):
    run(capsys, "predict", SPHERE, "--plot", tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 10_000


def test_an_ending_without_pull_off_is_an_answer(capsys, tmp_path):
    path = scene_file(tmp_path, "[membrane]\nwork_of_adhesion_J_m2 = 0.0\n")
    code, out, err = run(capsys, "predict", path, "--json", "--plot", tmp_path / "empty.png")
    answer = json.loads(out)
    assert (code, err) == (0, "")
    assert answer["outcome"].startswith("no adhesion")
    assert answer["pull_off_force_N"] is None
    assert (tmp_path / "empty.png").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--pressure-kpa", "-500"], "vacuum"),
        (["--points", "3"], "--points 3"),
    ],
)
def test_impossible_requests_are_refused(capsys, words, said):
    code, out, err = run(capsys, "predict", FLAT, *words)
    assert (code, out) == (2, "")
    assert said in err


def test_contact_stretch_of_the_membrane_is_a_choice_and_is_named(capsys, tmp_path):
    words = ("predict", SPHERE, "--model", "membrane")
    answers = {}
    for choice in ("eml", "projected"):
        code, out, _ = run(capsys, *words, "--contact-stretch", choice, "--json")
        answers[choice] = json.loads(out)
        assert code == 0
        assert answers[choice]["assumptions"]["contact stretch"] == choice
    assert answers["projected"]["pull_off_force_N"] < 0.99 * answers["eml"]["pull_off_force_N"]
    default = json.loads(run(capsys, *words, "--json")[1])
    assert default["pull_off_force_N"] == answers["eml"]["pull_off_force_N"]
    code, out, _ = run(capsys, *words, "--contact-stretch", "frictionless", "--plot", tmp_path / "plot.png")
    assert code == 0
    assert out.splitlines()[0].endswith("(membrane, contact stretch frictionless)")
    assert (tmp_path / "plot.png").stat().st_size > 10_000


@pytest.mark.parametrize("model", ["cone", "cone-2017"])
def test_contact_stretch_is_refused_where_the_model_has_none(capsys, model):
    code, out, err = run(capsys, "predict", SPHERE, "--model", model, "--contact-stretch", "projected")
    assert (code, out) == (2, "")
    assert f"--contact-stretch projected: --model {model}" in err
    assert "--model membrane" in err
    with pytest.raises(InvalidParameter, match=f"{model}.*contact stretch"):
        predict(load_scene(SPHERE)[0].parameters(), model, contact_stretch="projected")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[gripper]\nradius_mm = 7.0\n", "exceeds radius_mm"),
        ("[membrane]\nthickness_um = -1.0\n", "thickness_um = -1.0"),
        ("[membrane]\nthicknes_um = 1.0\n", "did you mean thickness_um?"),
        ("[protocol]\ninitial_pressure_kPa = -101.3\n", "initial_pressure_kPa"),
    ],
)
def test_inconsistent_scenes_are_refused_by_key(capsys, tmp_path, text, said):
    code, out, err = run(capsys, "predict", scene_file(tmp_path, text))
    assert (code, out) == (2, "")
    assert said in err


def test_soft_gripper_has_no_model_but_a_bound(capsys, tmp_path):
    path = scene_file(tmp_path, '[gripper]\nkind = "soft"\n')
    code, _, err = run(capsys, "predict", path)
    assert code != 0
    assert "no adhesion model" in err
    assert "--rigid-bound" in err
    code, out, _ = run(capsys, "predict", path, "--json", "--rigid-bound")
    assert code == 0
    assert any("bound" in warning for warning in json.loads(out)["warnings"])


def test_sweep_varies_keys_of_the_scene(capsys, tmp_path):
    out = tmp_path / "table.csv"
    code, printed, _ = run(
        capsys,
        "sweep",
        SPHERE,
        "--vary",
        "diameter_mm=20:60:3",
        "--vary",
        "protocol.initial_pressure_kPa=-1,1",
        "--out",
        out,
    )
    table = pd.read_csv(out)
    assert (code, printed) == (0, "")
    assert table["substrate.diameter_mm"].tolist() == [20, 20, 40, 40, 60, 60]
    assert table["protocol.initial_pressure_kPa"].tolist() == [-1, 1] * 3
    assert table["pull_off_distance_m"].iloc[-1] == pytest.approx(2.155749e-3, abs=6e-10)
    assert (table["pull_off_force_error_N"] < 1e-10).all()


@pytest.mark.parametrize(
    ("axis", "said"),
    [
        ("diamter_mm=1:2:3", "did you mean diameter_mm?"),
        ("diameter_mm=1:2", "KEY=START:STOP:N"),
        ("diameter_mm=a,b", "KEY=START:STOP:N"),
        ("diameter_mm=-5:10:2", "diameter_mm = -5.0"),
        ("effective_radius_mm=7:9:2", "exceeds radius_mm"),
    ],
)
def test_bad_axes_are_refused(capsys, axis, said):
    code, out, err = run(capsys, "sweep", SPHERE, "--vary", axis)
    assert (code, out) == (2, "")
    assert said in err


def test_axes_end_exactly_where_they_say():
    assert parse_axis("a=0.1:0.7:7")[1][-1] == 0.7
    assert parse_axis("a=3:9:1")[1] == [3.0]


def scenes(count):
    values = np.linspace(12e-3, 60e-3, count)
    return [Parameters(Substrate("sphere", float(d)), membrane=Membrane(), gas=Gas(1000.0)) for d in values]


def test_processes_give_the_same_bits():
    points = scenes(5000)
    alone = sweep(points)
    shared = sweep(points, processes=2)
    pd.testing.assert_frame_equal(alone, shared, check_exact=True)


def test_a_sweep_takes_every_core_unless_told_otherwise(capsys, monkeypatch):
    asked = []

    def on_processes(function, items, count, lost):
        asked.append(count)
        return map(function, items)

    monkeypatch.setattr("os.cpu_count", lambda: 3)
    monkeypatch.setattr("analysis.batch._on_processes", on_processes)
    four = ("sweep", SPHERE, "--model", "membrane", "--vary", "work_of_adhesion_J_m2=1:4:4")
    assert run(capsys, *four)[0] == 0
    assert asked == [3]
    assert run(capsys, *four, "--processes", "1")[0] == 0
    assert run(capsys, "sweep", SPHERE, "--vary", "work_of_adhesion_J_m2=1:4:4")[0] == 0
    assert asked == [3]


def test_a_cluster_gives_the_same_bits():
    distributed = pytest.importorskip("distributed")
    points = scenes(4200)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0", protocol="inproc://"
    ) as cluster:
        shared = sweep(points, scheduler=cluster.scheduler_address)
    pd.testing.assert_frame_equal(sweep(points), shared, check_exact=True)


def test_progress_sees_every_block():
    seen = []

    def progress(blocks, count):
        for block in blocks:
            seen.append((len(block), count))
            yield block

    sweep(scenes(4200), progress=progress)
    assert seen == [(4096, 2), (104, 2)]


def test_one_bad_scene_does_not_end_a_sweep():
    table = sweep([*scenes(2), Parameters(Substrate("sphere", 0.0))])
    assert table["outcome"].iloc[0] == "pull-off"
    assert table["outcome"].iloc[2].startswith("InvalidParameter")
    assert table["pull_off_force_N"].iloc[1] == pytest.approx(cone.solve(scenes(2)[1]).pull_off_force, rel=1e-12)


def test_scipy_and_matplotlib_stay_out_of_a_prediction():
    script = (
        "import sys; from rig.cli import main; main(sys.argv[1:]);"
        "sys.exit(any(name in sys.modules for name in ('scipy', 'matplotlib', 'pandas', 'mpmath')))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, "predict", str(SPHERE), "--json"], capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", ["fiber", "volume", "leak", "punch", "compliance"])
def test_protocols_without_a_model_are_refused(capsys, name):
    for words in (["predict", name], ["predict", name, "--rigid-bound"], ["sweep", name, "--vary", "radius_mm=8,9"]):
        code, out, err = run(capsys, *words)
        assert (code, out) == (1, "")
        assert f"the models do not describe the protocol {name}. Remedy" in err


def test_an_indentation_is_answered_by_jkr(capsys):
    code, out, _ = run(capsys, "predict", "indentation", "--json")
    answer = json.loads(out)
    assert (code, answer["model"]) == (0, "jkr")
    assert answer["pull_off_force_N"] == pytest.approx(1.5 * np.pi * 4.0 * 4e-3)
    assert "F_off  0.075398 N" in run(capsys, "predict", "indentation")[1]
    code, out, err = run(capsys, "predict", "indentation", "--plot", "p.png")
    assert (code, out) == (2, "")
    assert "no profile" in err
    code, out, err = run(capsys, "sweep", "indentation", "--vary", "thickness_um=100,200")
    assert (code, out) == (1, "")
    assert "rig predict" in err


def test_a_key_is_varied_once(capsys):
    code, out, err = run(capsys, "sweep", SPHERE, "--vary", "substrate.diameter_mm=15,60", "--vary", "diameter_mm=30")
    assert (code, out) == (2, "")
    assert "substrate.diameter_mm is varied twice" in err


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense"])
def test_a_scheduler_that_does_not_answer_is_named(capsys, monkeypatch, address):
    pytest.importorskip("distributed")
    monkeypatch.setattr("analysis.batch.ANSWER_SECONDS", 0.2)
    code, out, err = run(capsys, "sweep", SPHERE, "--vary", "diameter_mm=30,40", "--scheduler", address)
    assert (code, out) == (2, "")
    assert f"scheduler {address}: no Dask scheduler answers" in err
    assert "Remedy" in err


def test_outputs_make_their_folders_and_bad_ones_are_refused(capsys, tmp_path):
    table, plot = tmp_path / "new" / "t.csv", tmp_path / "other" / "p.svg"
    assert run(capsys, "sweep", SPHERE, "--vary", "diameter_mm=30,40", "--out", table)[0] == 0
    assert run(capsys, "predict", SPHERE, "--plot", plot)[0] == 0
    assert len(pd.read_csv(table)) == 2
    assert plot.read_bytes().startswith(b"<?xml")
    for words in (["--plot", tmp_path / "p.txt"], ["--plot", tmp_path / "new" / "t.csv" / "p.png"]):
        code, _, err = run(capsys, "predict", SPHERE, *words)
        assert code == 2
        assert "Remedy" in err
    with pytest.raises(SystemExit, match="2"):
        main(["sweep", str(SPHERE), "--vary", "diameter_mm=30,40", "--processes", "-2"])
    assert "--processes" in capsys.readouterr().err
