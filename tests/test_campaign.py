"""Campaigns: one order for one seed, nothing measured twice, nothing lost."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
from conftest import scene_text
from held_run import held

from rig.campaign import JOURNAL, Journal, load_campaign, single
from rig.cli import main
from rig.errors import FileError
from rig.recording import load_recording
from rig.scene import parse_scene

FILE = """
title = "small"
order = "{order}"
seed = {seed}
repeats = 3

[[test]]
scene = "zero.toml"

[[test]]
scene = "weights.toml"
repeats = 2
"""


@pytest.fixture
def campaign(tmp_path) -> Path:
    """Return a campaign of five short recordings."""
    (tmp_path / "zero.toml").write_text(scene_text("pressure-zero", rest_s=0.5), "utf-8")
    (tmp_path / "weights.toml").write_text(scene_text("dead-weights", rest_s=0.5, masses_g=[0.0, 50.0]), "utf-8")
    path = tmp_path / "small.toml"
    path.write_text(FILE.format(order="random", seed=4), "utf-8")
    return path


def keys(path):
    return [test.key for test in load_campaign(path)[1]]


def run(path, folder):
    return main(["campaign", str(path), "--direct", "--out", str(folder)])


def journal(folder):
    return [json.loads(line) for line in (folder / JOURNAL).read_text("utf-8").splitlines()]


@pytest.mark.parametrize(("name", "substrates"), [("table-s1", 4), ("table-s2", 5)])
def test_the_tables_are_two_pressures_on_every_substrate_five_times(name, substrates):
    campaign, tests = load_campaign(Path(__file__).parents[1] / "campaigns" / f"{name}.toml")
    conditions = {
        (t.scene.substrate.material, t.scene.substrate.diameter_mm, t.scene.protocol.initial_pressure_kPa)
        for t in tests
    }
    assert campaign.repeats == 5
    assert len(conditions) == 2 * substrates
    assert len(tests) == len({test.key for test in tests}) == 10 * substrates
    for test in tests:
        assert f"initial_pressure_kPa = {test.scene.protocol.initial_pressure_kPa!r}" in test.scene_text
        assert f" at {test.scene.protocol.initial_pressure_kPa:+g} kPa" in test.scene.title


def test_random_order_belongs_to_the_seed(tmp_path, campaign):
    first = keys(campaign)
    assert keys(campaign) == first
    orders = set()
    for seed in range(6):
        campaign.write_text(FILE.format(order="random", seed=seed), "utf-8")
        orders.add(tuple(keys(campaign)))
    campaign.write_text(FILE.format(order="given", seed=4), "utf-8")
    assert len(orders) > 1
    assert all(sorted(order) == sorted(keys(campaign)) for order in orders)


def test_places_and_repeats_of_a_scene_have_seeds_and_prompts_of_their_own(tmp_path):
    (tmp_path / "c.toml").write_text('title = "c"\n[[test]]\nscene = "fiber"\nprompt = "Mount the fibres."\n', "utf-8")
    _, tests = load_campaign(tmp_path / "c.toml")
    assert len(tests) == len({test.seed for test in tests}) == 15
    assert {test.place for test in tests} == {"SPL#1", "SPL#2", "SPL#3"}
    assert tests[0].prompt == "Mount the fibres. Bring the probe over SPL#1."
    assert len({test.setup for test in tests}) == 3


def test_no_two_tests_of_a_campaign_share_their_noise(tmp_path):
    (tmp_path / "zero.toml").write_text(scene_text("pressure-zero", rest_s=0.5), "utf-8")
    path = tmp_path / "c.toml"
    text = 'title = "c"\nrepeats = 2\n[[test]]\nscene = "zero.toml"\n[[test]]\nscene = "zero.toml"\n'
    path.write_text(text, "utf-8")
    assert run(path, tmp_path / "out") == 0
    force = {load_recording(file).volts[:100].tobytes() for file in (tmp_path / "out").glob("*.h5")}
    assert len(force) == 4
    before = {test.key: test.seed for test in load_campaign(path)[1]}
    path.write_text(text.replace("repeats = 2", "repeats = 3"), "utf-8")
    assert before.items() <= {test.key: test.seed for test in load_campaign(path)[1]}.items()
    path.write_text("seed = 1\n" + text, "utf-8")
    assert not set(before.values()) & {test.seed for test in load_campaign(path)[1]}


def test_a_finished_campaign_is_not_measured_again(tmp_path, campaign, capsys):
    folder = tmp_path / "out"
    assert run(campaign, folder) == 0
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert run(campaign, folder) == 0
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    assert "5 tests, 5 done" in capsys.readouterr().err


def test_a_campaign_killed_half_way_is_taken_up_where_it_stopped(tmp_path, campaign):
    folder = tmp_path / "out"
    with held(3, 5, "campaign", campaign, "--direct", "--out", folder) as process:
        process.kill()
    done = [entry["key"] for entry in journal(folder)]
    whole = {name: (folder / name).read_bytes() for name in (entry["recording"] for entry in journal(folder))}
    assert len(done) == 2
    assert run(campaign, folder) == 0
    entries = journal(folder)
    assert [entry["key"] for entry in entries][: len(done)] == done
    assert sorted(entry["key"] for entry in entries) == sorted(keys(campaign))
    for name, content in whole.items():
        assert (folder / name).read_bytes() == content
    for entry in entries:
        assert load_recording(folder / entry["recording"]).ending == ("done", 0)


def test_a_torn_last_line_counts_as_unwritten(tmp_path):
    found = Journal(tmp_path)
    found.write("a", "a.h5")
    found.write("b", "b.h5")
    path = tmp_path / JOURNAL
    path.write_bytes(path.read_bytes()[:-9])
    assert found.done() == {"a": "a.h5"}
    found.write("c", "c.h5")
    assert found.done() == {"a": "a.h5", "c": "c.h5"}
    assert all(json.loads(line) for line in path.read_text("utf-8").splitlines())


def test_a_line_torn_anywhere_is_never_taken_for_an_entry(tmp_path):
    found = Journal(tmp_path)
    found.write("first", "first.h5")
    found.write("second", "second.h5")
    path = tmp_path / JOURNAL
    content = path.read_bytes()
    first = content.index(b"\n") + 1
    for length in range(first, len(content) - 2):
        path.write_bytes(content[:length])
        assert found.done() == {"first": "first.h5"}


def test_a_damaged_line_in_the_middle_is_told_with_its_number(tmp_path):
    (tmp_path / JOURNAL).write_text('{"key": "a", "recording": "a.h5"}\nrubbish\n{"key": "b"}\n', "utf-8")
    with pytest.raises(FileError, match=r"line 2: no entry .* Remedy"):
        Journal(tmp_path).done()


def test_a_whole_recording_without_an_entry_is_adopted_and_a_broken_one_is_kept(tmp_path, campaign, capsys):
    folder = tmp_path / "out"
    assert run(campaign, folder) == 0
    path = folder / JOURNAL
    entries = journal(folder)
    lost, broken = entries[1], entries[3]
    path.write_text("".join(json.dumps(e) + "\n" for e in entries if e not in (lost, broken)), "utf-8")
    (folder / broken["recording"]).write_bytes(b"half a recording")
    content = (folder / lost["recording"]).read_bytes()
    capsys.readouterr()
    assert run(campaign, folder) == 0
    assert "1 of them found whole without an entry" in capsys.readouterr().err
    recordings = {entry["key"]: entry["recording"] for entry in journal(folder)}
    assert recordings[lost["key"]] == lost["recording"]
    assert (folder / lost["recording"]).read_bytes() == content
    assert recordings[broken["key"]] == broken["recording"].replace(".h5", "~2.h5")
    assert (folder / broken["recording"]).read_bytes() == b"half a recording"


@pytest.mark.skipif(os.name != "posix", reason="sends a signal to a process")
def test_ctrl_c_ends_a_campaign_and_leaves_it_to_be_taken_up(tmp_path, campaign):
    folder = tmp_path / "out"
    with held(2, 5, "campaign", campaign, "--direct", "--out", folder) as process:
        process.send_signal(signal.SIGINT)
        _, error = process.communicate("\n")
    assert process.returncode == 130
    assert len(journal(folder)) == 1
    assert "Traceback" not in error
    assert run(campaign, folder) == 0
    assert sorted(entry["key"] for entry in journal(folder)) == sorted(keys(campaign))


def test_a_scene_changed_after_its_test_is_refused(tmp_path, campaign, capsys):
    folder = tmp_path / "out"
    assert run(campaign, folder) == 0
    scene = tmp_path / "zero.toml"
    scene.write_text(scene.read_text("utf-8").replace("rest_s = 0.5", "rest_s = 0.75"), "utf-8")
    assert run(campaign, folder) != 0
    error = capsys.readouterr().err
    assert "measured with another scene" in error
    assert "--out" in error


def test_a_recording_of_another_scene_is_not_adopted(tmp_path, campaign):
    folder = tmp_path / "out"
    assert run(campaign, folder) == 0
    (folder / JOURNAL).unlink()
    scene = tmp_path / "zero.toml"
    scene.write_text(scene.read_text("utf-8").replace("rest_s = 0.5", "rest_s = 0.75"), "utf-8")
    assert run(campaign, folder) == 0
    recordings = {entry["key"]: entry["recording"] for entry in journal(folder)}
    assert all(("~2" in name) == ("zero" in key) for key, name in recordings.items())


@pytest.mark.parametrize(
    "protocol",
    ["  [ protocol ]  # as mounted\n  {keys}", "[protocol]\n{keys}", "protocol.{keys}", "protocol = {{ {keys} }}", ""],
)
def test_the_pressure_of_a_test_is_in_its_scene_whatever_the_scene_looks_like(tmp_path, protocol):
    head = 'title = "initial_pressure_kPa = 1"\n{}\n[substrate]\nshape = "flat" # glass\n{}\n'
    text = protocol.format(keys="initial_pressure_kPa = -3.2")
    (tmp_path / "s.toml").write_text(head.format("", text) if "[" in text else head.format(text, ""), "utf-8")
    (tmp_path / "c.toml").write_text(
        'title = "c"\n[[test]]\nscene = "s.toml"\nname = "glass"\ninitial_pressures_kPa = [-1.5, 0.5]\n', "utf-8"
    )
    _, tests = load_campaign(tmp_path / "c.toml")
    assert [test.scene.protocol.initial_pressure_kPa for test in tests] == [-1.5, 0.5]
    assert [test.key for test in tests] == ["01-glass_-1.5kPa-1", "01-glass_+0.5kPa-1"]
    assert [test.scene.title for test in tests] == ["glass at -1.5 kPa", "glass at +0.5 kPa"]
    assert all(parse_scene(test.scene_text, "again") == test.scene and "# glass" in test.scene_text for test in tests)


def test_more_repeats_measure_nothing_twice(tmp_path):
    (tmp_path / "zero.toml").write_text(scene_text("pressure-zero", rest_s=0.5), "utf-8")
    path, folder = tmp_path / "c.toml", tmp_path / "out"
    for repeats in (1, 3, 2):
        path.write_text(f'title = "c"\n[[test]]\nscene = "zero.toml"\nrepeats = {repeats}\n', "utf-8")
        assert run(path, folder) == 0
    assert [entry["key"] for entry in journal(folder)] == ["01-zero-1", "01-zero-2", "01-zero-3"]


def test_places_whose_recordings_would_have_one_name_are_refused(tmp_path):
    scene = scene_text("indentation", positions=["a!", "b", "a?"])
    (tmp_path / "s.toml").write_text(scene, "utf-8")
    (tmp_path / "c.toml").write_text('title = "c"\n[[test]]\nscene = "s.toml"\n', "utf-8")
    with pytest.raises(FileError, match=r"'a!' and 'a\?' would both be recorded as 01-s-a_-1\. Remedy"):
        load_campaign(tmp_path / "c.toml")
    with pytest.raises(FileError, match="would both be recorded"):
        single(parse_scene(scene, "s"), scene, "s", 1, 0)


@pytest.mark.parametrize("name", ["../other.h5", "/etc/passwd", "folder/one.h5", ""])
def test_a_journal_names_files_of_its_folder_only(tmp_path, campaign, name):
    folder = tmp_path / "out"
    folder.mkdir()
    lines = [json.dumps({"key": "01-zero-1", "recording": name}), json.dumps({"key": "x", "recording": "x.h5"})]
    (folder / JOURNAL).write_text("\n".join(lines) + "\n", "utf-8")
    with pytest.raises(FileError, match="line 1: no entry"):
        Journal(folder).done()
