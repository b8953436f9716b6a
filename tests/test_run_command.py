"""``rig run`` from the outside: names, files beside the recording, exit codes, signals."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import SHORT, scene_text
from held_run import held

from rig.cli import main
from rig.journal import journal_of
from rig.recording import load_recording

RIG = [sys.executable, "-m", "rig"]
OVER = '[[fault]]\ndevice = "force"\nkind = "over_range"\nat_step = "approach"\nafter_samples = 100\nvalue = 4.7\n'


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "short.toml"
    path.write_text(scene_text("sphere-60mm-vented", **SHORT), encoding="utf-8")
    return path


def run(scene: Path | str, out: Path | str, *more: str) -> int:
    return main(["run", str(scene), "--direct", "--no-live", "--out", str(out), *more])


@pytest.mark.parametrize(
    "name", ["whole.png", "whole", "whole.h5.toml", f"{'x' * 252}.h5", "bad\udcff.h5", "short.toml/x.h5"]
)
def test_a_name_that_no_recording_can_have_is_one_message(scene, tmp_path, capsys, name):
    before = set(tmp_path.iterdir())
    assert run(scene, tmp_path / name) == 2
    told = capsys.readouterr().err
    assert told.startswith("rig run: recording ")
    assert told.count("\n") == told.count("Remedy") == 1
    assert set(tmp_path.iterdir()) == before


def test_names_of_repeats_are_checked_before_the_first_is_run(scene, tmp_path, capsys):
    (tmp_path / "r-short-2.h5").write_bytes(b"precious")
    assert run(scene, tmp_path / "r.h5", "--repeat", "2") == 2
    assert "r-short-2.h5: exists already" in capsys.readouterr().err
    assert not (tmp_path / "r-short-1.h5").exists()


def test_nothing_beside_the_recording_is_overwritten(tmp_path, capsys):
    for name in ("lab.toml", "lab.png", "lab-2.png"):
        (tmp_path / name).write_text("mine", encoding="utf-8")
    assert run("pressure-zero", tmp_path / "lab.h5") == 0
    assert {name: (tmp_path / name).read_text() for name in ("lab.toml", "lab.png", "lab-2.png")} == dict.fromkeys(
        ("lab.toml", "lab.png", "lab-2.png"), "mine"
    )
    told = capsys.readouterr().out
    assert f"lines      {tmp_path / 'lab-2.toml'}" in told
    assert f"picture    {tmp_path / 'lab-3.png'}" in told
    assert "[pressure.zero]" in (tmp_path / "lab-2.toml").read_text(encoding="utf-8")
    assert (tmp_path / "lab-3.png").stat().st_size > 1000


def test_a_journal_left_behind_is_named_and_no_recording_is_begun(scene, tmp_path, capsys):
    out = tmp_path / "j.h5"
    journal_of(out).write_bytes(b"of an earlier run")
    for _ in range(2):
        assert run(scene, out) == 2
        told = capsys.readouterr().err
        assert f"{journal_of(out)}" in told
        assert "remove the journal" in told
        assert not out.exists()


def test_options_that_count_refuse_what_is_no_count(scene, capsys):
    for command in (["run", str(scene)], ["emulate"]):
        with pytest.raises(SystemExit, match="2"):
            main([*command, "--seed", "-1"])
        assert "--seed: '-1' is no whole number of 0 or more" in capsys.readouterr().err


def test_a_reference_move_that_nobody_can_confirm_is_refused():
    told = subprocess.run(
        [*RIG, "reference", "--bench", "emulated"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert told.returncode == 5
    assert told.stderr.count("\n") == 1
    assert "nothing has moved" in told.stderr


def test_a_file_that_cannot_be_written_is_one_message(scene, tmp_path, capsys):
    (tmp_path / "file").write_bytes(b"")
    assert main(["predict", str(scene), "--plot", str(tmp_path / "file" / "x.png")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.skipif(os.name != "posix", reason="a pipe nobody reads ends differently on Windows")
@pytest.mark.parametrize("closed", ["stdout", "stderr", "both"])
def test_an_interlock_keeps_its_exit_code_where_nobody_reads(scene, tmp_path, closed):
    faults = tmp_path / "over.toml"
    faults.write_text(OVER, encoding="utf-8")
    reading, writing = os.pipe()
    os.close(reading)
    ends = {name: writing if closed in (name, "both") else subprocess.DEVNULL for name in ("stdout", "stderr")}
    command = [
        *RIG,
        "run",
        str(scene),
        "--direct",
        "--no-live",
        "--faults",
        str(faults),
        "--out",
        str(tmp_path / "o.h5"),
    ]
    ended = subprocess.run(command, check=False, **ends)
    os.close(writing)
    assert ended.returncode == 3
    ending = load_recording(tmp_path / "o.h5").ending
    assert ending is not None
    assert ending[1] == 3


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no such signal here")
@pytest.mark.parametrize("ignored", [False, True], ids=["window-closed", "nohup"])
def test_a_closed_terminal_ends_the_run_in_good_order(scene, tmp_path, ignored):
    out = tmp_path / "h.h5"
    words = ("run", scene, "--direct", "--no-live", "--no-picture", "--out", out)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
    try:
        with held(1, 100, *words) as process:
            process.send_signal(signal.SIGHUP)
            process.communicate("\n")
    finally:
        signal.signal(signal.SIGHUP, before)
    assert process.returncode == (0 if ignored else 130)
    ending = load_recording(out).ending
    assert ending is not None
    assert ending[1] == process.returncode
