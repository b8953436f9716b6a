"""Scene and bench files: what is refused, and in which words."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.bench import load_bench, parse_bench
from rig.check import check
from rig.errors import FileError, Refused
from rig.library import find_scene
from rig.scene import load_scene, parse_scene

SPHERE = '[substrate]\nshape = "sphere"\ndiameter_mm = 60.0\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[substrate]\nshape = 'sphere'\ndiameter_m = 0.06\n", ["diameter_m", "did you mean diameter_mm"]),
        ("[substrate]\nshape = 'sphere'\n", ["diameter_mm"]),
        ("[substrate]\nshape = 'cube'\n", ["shape", "cube", "sphere"]),
        (SPHERE + "[gripper]\neffective_radius_mm = 9.0\n", ["effective_radius_mm", "9", "radius_mm = 8"]),
        (SPHERE + "[protocol]\npreload_N = -1\n", ["preload_N", "-1", "greater than 0"]),
        (SPHERE + "[protocol]\npreload_N = '1 N'\n", ["preload_N", "1 N"]),
        (SPHERE + "[protocol]\npreload_N = nan\n", ["preload_N", "nan"]),
        (SPHERE + "[protocol]\ninitial_pressure_kPa = -102\n", ["initial_pressure_kPa", "-102"]),
        (SPHERE + "[membrane]\nthickness_um = 0\n", ["thickness_um"]),
        ("shape = ", ["TOML"]),
        ("", ["substrate"]),
    ],
)
def test_a_bad_scene_names_file_key_value_and_remedy(text, words):
    with pytest.raises(FileError) as caught:
        parse_scene(text, "bad.toml")
    for word in ["bad.toml", *words]:
        assert word in str(caught.value)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(FileError, match="no such file"):
        load_scene(tmp_path / "none.toml")
    with pytest.raises(FileError, match="no such file"):
        load_bench(tmp_path / "none.toml")
    with pytest.raises(FileError, match="sphere-60mm-low"):
        find_scene("no-such-scene")


def test_every_shipped_scene_is_valid_and_runs_on_an_emulated_bench():
    from importlib.resources import files

    usual, _ = load_bench(None)
    small_cell, _ = load_bench(Path("emulated-gso25"))
    for item in files("scenes").iterdir():
        if item.name.endswith(".toml"):
            check(parse_scene(item.read_text("utf-8"), item.name), small_cell if "fiber" in item.name else usual)


def test_the_paper_rig_must_be_filled_in():
    from importlib.resources import files

    text = files("benches").joinpath("paper-rig.toml").read_text("utf-8")
    with pytest.raises(FileError, match=r"slope"):
        parse_bench(text, "paper-rig.toml")
    for key in ("slope", "relative_uncertainty", "residual"):
        text = text.replace(f"{key} = 0.0", f"{key} = 0.01")
    with pytest.raises(FileError, match=r"still to be filled in: stage.connection, pump.connection"):
        parse_bench(text, "paper-rig.toml")
    assert parse_bench(text.replace("FILL-IN", "a").replace("FILL IN", "a"), "x").force.cell == "GSO-500"


def test_limits_beyond_the_load_cell_are_refused():
    _, text = load_bench(None)
    with pytest.raises(FileError, match="120 %"):
        parse_bench(text.replace("tension_N = 4.4", "tension_N = 30.0"), "b.toml")


def test_a_scene_the_bench_cannot_carry_out_is_refused():
    bench, _ = load_bench(None)
    scene = parse_scene(SPHERE + "[protocol]\ninitial_pressure_kPa = -60.0\npreload_N = 3.5\n", "s.toml")
    with pytest.raises(Refused) as caught:
        check(scene, bench)
    for word in ("initial_pressure_kPa = -60", "preload_N = 3.5", "-55"):
        assert word in str(caught.value)


@given(st.text(max_size=300))
def test_any_text_is_a_scene_or_one_clear_error(text):
    for parse in (parse_scene, parse_bench):
        try:
            parse(text, "fuzz.toml")
        except FileError as error:
            assert "fuzz.toml" in str(error)


def test_only_an_emulated_stage_can_be_said_to_have_been_left_on():
    _, emulated = load_bench(None)
    left_on = emulated.replace("start_mm = 22.0", "start_mm = 20.1\nleft_on = true")
    assert parse_bench(left_on, "bench.toml").stage.left_on
    real = left_on.replace('[stage]\nconnection = "emulated"', '[stage]\nconnection = "/dev/ttyUSB0"')
    with pytest.raises(FileError, match=r"bench\.toml.*left_on is for an emulated stage"):
        parse_bench(real, "bench.toml")
