"""Scene and bench files: what is refused, and in which words."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.bench import load_bench, parse_bench
from rig.campaign import load_campaign
from rig.check import check
from rig.cli import main
from rig.errors import FileError, Refused
from rig.library import LARGEST_BYTES, find, load_scene, shipped
from rig.scene import parse_scene

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
        ("title = " + "9" * 5000, ["TOML", "Remedy"]),
        ("title = " + "[" * 5000, ["TOML", "Remedy"]),
        ("title = " + "{ a = " * 3000, ["TOML", "Remedy"]),
    ],
)
def test_a_bad_scene_names_file_key_value_and_remedy(text, words):
    with pytest.raises(FileError) as caught:
        parse_scene(text, "bad.toml")
    for word in ["bad.toml", *words]:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("load", "kind", "one"),
    [
        (load_scene, "scene", "sphere-60mm-low"),
        (load_bench, "bench", "emulated-gso25"),
        (load_campaign, "campaign", "table-s1"),
    ],
)
def test_a_file_or_the_name_of_one_that_ships(load, kind, one, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert one in shipped(kind)
    by_name = load(Path(one))
    file = tmp_path / "own.toml"
    file.write_text(find(kind, one)[0], encoding="utf-8")
    assert load(file) == by_name
    (tmp_path / one).mkdir()
    assert load(Path(one)) == by_name
    for missing in (tmp_path / "none.toml", Path("none"), Path("..") / one):
        with pytest.raises(FileError) as caught:
            load(missing)
        for words in (f"{kind} {missing}: no such file", "Remedy", *shipped(kind)):
            assert words in str(caught.value)
    with pytest.raises(FileError, match=f"{kind} .*own.*cannot be read"):
        load(Path("own\0.toml"))


def test_a_file_from_a_windows_editor_may_begin_with_a_byte_order_mark(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text(find("scene", "sphere-60mm-low")[0], encoding="utf-8-sig", newline="\r\n")
    assert load_scene(file)[0] == load_scene("sphere-60mm-low")[0]


def test_what_is_no_ordinary_file_is_refused_without_waiting_for_its_end(tmp_path):
    with pytest.raises(FileError, match="no ordinary file"):
        load_scene(tmp_path)
    if sys.platform != "win32":
        os.mkfifo(tmp_path / "pipe.toml")
        for endless in (tmp_path / "pipe.toml", Path("/dev/zero")):
            with pytest.raises(FileError, match="no ordinary file"):
                load_scene(endless)
    long = tmp_path / "long.toml"
    long.write_bytes(b"#" * (LARGEST_BYTES + 1))
    with pytest.raises(FileError, match=f"at most {LARGEST_BYTES}"):
        load_scene(long)


def test_stage_and_pump_at_one_port_are_refused():
    text, _ = find("bench", "emulated")
    for name, connection in {"stage": "COM1", "pump": "COM1", "daq": "local"}.items():
        text = text.replace(f'[{name}]\nconnection = "emulated"', f'[{name}]\nconnection = "{connection}"')
    with pytest.raises(FileError, match=r"stage\.connection and pump\.connection are both 'COM1'"):
        parse_bench(text, "b.toml")


@pytest.mark.parametrize(
    "address", ["socket://127.0.0.1:99999", "socket://[::1", f"socket://{'a' * 80}.de:1", "grpc://127.0.0.1:99999"]
)
def test_a_connection_that_is_no_address_is_refused(address):
    text, _ = find("bench", "emulated")
    part = "daq" if address.startswith("grpc") else "stage"
    for name, connection in ({"stage": "COM1", "pump": "COM2", "daq": "local"} | {part: address}).items():
        text = text.replace(f'[{name}]\nconnection = "emulated"', f'[{name}]\nconnection = "{connection}"')
    with pytest.raises(FileError) as caught:
        parse_bench(text, "b.toml")
    assert f"{part}.connection = '{address}' is no address" in str(caught.value)


@pytest.mark.parametrize(
    "words",
    [
        ["predict", "{}"],
        ["sweep", "{}", "--vary", "diameter_mm=40,60"],
        ["load-sharing", "{}", "--formulation", "plane-strain"],
    ],
    ids=lambda words: words[0],
)
def test_commands_that_predict_take_the_name_of_a_scene_that_ships(words, capsys):
    assert main([word.format("sphere-60mm-low") for word in words]) == 0
    assert capsys.readouterr().out
    assert main([word.format("sphere-61mm") for word in words]) == 2
    error = capsys.readouterr().err
    assert "scene sphere-61mm: no such file" in error
    assert "sphere-60mm-low" in error


@pytest.mark.parametrize(("bench", "pump"), [("emulated", True), ("emulated-gso25", False)])
def test_the_doctor_examines_a_bench_that_ships_with_what_it_has(bench, pump, capsys):
    assert main(["doctor", "--bench", bench, "--json"]) == 0
    seen = {finding["what"] for finding in json.loads(capsys.readouterr().out)}
    assert {"stage", "force"} <= seen
    assert ({"pump", "pressure"} <= seen) == pump


def test_every_shipped_scene_is_valid_and_runs_on_an_emulated_bench():
    usual, _ = load_bench(None)
    small_cell, _ = load_bench(Path("emulated-gso25"))
    for name in shipped("scene"):
        check(load_scene(name)[0], small_cell if "fiber" in name else usual)


def test_the_paper_rig_must_be_filled_in():
    text, _ = find("bench", "paper-rig")
    with pytest.raises(FileError, match=r"slope"):
        parse_bench(text, "paper-rig.toml")
    for key in ("slope", "relative_uncertainty", "residual"):
        text = text.replace(f"{key} = 0.0", f"{key} = 0.01")
    with pytest.raises(FileError, match=r"still to be filled in: stage.connection, pump.connection"):
        parse_bench(text, "paper-rig.toml")
    assert (
        parse_bench(text.replace("FILL-IN", "a", 1).replace("FILL-IN", "b").replace("FILL IN", "a"), "x").force.cell
        == "GSO-500"
    )


def test_a_frame_holds_a_whole_number_of_samples_and_at_least_one():
    daq = load_bench(None)[0].daq
    assert daq.frame_ms == 20.0
    assert [daq.frame_samples(rate) for rate in (1000.0, 1024.5, 10.0)] == [20, 20, 1]


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
