"""Whose recording it is: a live one is never replaced, a dead one is repaired, wherever it is looked at from."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest
from held_run import held

from rig import writer
from rig.campaign import Journal
from rig.cli import main
from rig.collection import Collection, _list_files
from rig.errors import BeingWritten, FileError
from rig.journal import journal_of
from rig.library import find
from rig.recording import load_recording
from rig.recovery import recover

Live = tuple[subprocess.Popen[str], Path]


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look from another computer, or from a container of this one."""
    monkeypatch.setattr(writer, "_computer", lambda: ["elsewhere"])


@pytest.fixture(params=["plain", "journalled"])
def live(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Live]:
    """Hold a run in its 200th frame."""
    bench = tmp_path / "bench.toml"
    text, _ = find("bench", "emulated")
    journalled = "true" if request.param == "journalled" else "false"
    bench.write_text(f"{text}\n[recording]\nsurvives_power_cut = {journalled}\n", encoding="utf-8")
    path = tmp_path / "live.h5"
    words = ("run", "sphere-60mm-vented", "--bench", bench, "--direct", "--no-live", "--no-picture", "--out", path)
    with held(1, 200, *words) as process:
        yield process, path


def age(path: Path, seconds: float) -> None:
    """Make a recording look as if it had last been written so long ago."""
    for file in filter(Path.exists, (path, journal_of(path))):
        os.utime(file, (time.time() - seconds,) * 2)


@pytest.mark.usefixtures("elsewhere")
def test_a_live_recording_is_read_from_elsewhere_and_not_replaced(live: Live) -> None:
    process, path = live
    before = path.stat().st_ino
    with pytest.raises(BeingWritten, match="wait a minute"):
        recover(path)
    assert load_recording(path).force.size == 201 * 20
    assert path.stat().st_ino == before
    process.communicate("\n")
    assert process.returncode == 0
    ending = load_recording(path).ending
    assert ending is not None
    assert ending[1] == 0


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("seconds", [3600.0, -3600.0], ids=["an-hour-ago", "by-a-clock-an-hour-fast"])
def test_a_dead_recording_is_repaired_elsewhere(live: Live, seconds: float) -> None:
    process, path = live
    process.kill()
    process.wait()
    assert load_recording(path).force.size == 201 * 20  # just copied, say: read as it stands
    with pytest.raises(BeingWritten):
        recover(path)
    age(path, seconds)
    assert recover(path).repaired
    assert load_recording(path).ending == ("the program died; recovered", -9)
    assert not journal_of(path).exists()


def test_a_dead_recording_is_repaired_at_once_where_it_was_written(live: Live) -> None:
    process, path = live
    process.kill()
    process.wait()
    assert recover(path).repaired


def test_a_recording_from_before_writers_were_kept_is_repaired(live: Live) -> None:
    process, path = live
    process.kill()
    process.wait()
    journal_of(path).unlink(missing_ok=True)
    recover(path)
    with h5py.File(path, "r+", libver="latest") as file:
        del file["entry/configuration/writer"]
        file["entry/configuration/process_started"] = "1.5"
        file.swmr_mode = True
        file.flush()
        marked = path.read_bytes()
    path.write_bytes(marked)
    with pytest.raises(BeingWritten):
        recover(path)
    assert main(["recover", "--force", str(path)]) == 0
    path.write_bytes(marked)
    age(path, 61.0)
    assert recover(path).repaired


def test_a_process_lives_until_it_has_ended_whatever_the_clock_says(monkeypatch: pytest.MonkeyPatch) -> None:
    script = "from rig.writer import this_process; print(this_process(), flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        told = process.stdout.readline()
        assert writer.lives(told)
        with monkeypatch.context() as patch:
            clock = time.time
            patch.setattr(time, "time", lambda: clock() + 3600.0)
            if sys.platform == "linux":
                boot = __import__("psutil").boot_time()
                patch.setattr("psutil._pslinux.boot_time", lambda: boot + 5.0)
            assert writer.lives(told)
        process.kill()
        if sys.platform == "linux":
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
            assert writer.lives(told) is False  # ended, and nobody has asked for its exit code yet
    assert writer.lives(told) is False


@pytest.mark.parametrize("change", ["started", "process"])
def test_another_process_is_not_the_writer(change: str) -> None:
    told = json.loads(writer.this_process())
    told[change] = told[change] + 1 if change == "started" else 2**31 - 1
    assert writer.lives(json.dumps(told)) is False


@pytest.mark.parametrize(
    "odd", [None, "", "x", "[]", "5", "{}", '{"computer": 1}', '{"computer": null, "process": []}']
)
def test_of_an_unknown_writer_nothing_is_known(odd: str | None) -> None:
    assert writer.lives(odd) is None


@pytest.mark.parametrize("live", ["journalled"], indirect=True)
def test_a_link_to_a_recording_leads_to_its_journal_too(live: Live, tmp_path: Path) -> None:
    process, path = live
    process.kill()
    process.wait()
    path.write_bytes(path.read_bytes()[:5000])  # a power cut
    link = tmp_path / "folder" / "latest.h5"
    link.parent.mkdir()
    try:
        link.symlink_to(path)
    except OSError:
        pytest.skip("links need a right on Windows")
    assert load_recording(link).force.size == 201 * 20
    assert link.is_symlink()
    assert not journal_of(path).exists()


@pytest.mark.parametrize("live", ["journalled"], indirect=True)
def test_a_recording_of_which_only_the_journal_is_left_is_written_anew(live: Live, tmp_path: Path) -> None:
    process, path = live
    process.kill()
    process.wait()
    path.unlink()
    assert Journal(tmp_path).free_name(path.stem) == tmp_path / "live~2.h5"
    found = Collection()
    _list_files(found, [tmp_path])
    assert found.files == [path]
    assert load_recording(path).force.size == 201 * 20


def test_a_journal_that_holds_nothing_is_no_recording(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with pytest.raises(FileError, match="no such file"):
        recover(path)
    journal_of(path).write_bytes(b"")
    with pytest.raises(FileError, match="only its journal"):
        load_recording(path)
    assert not path.exists()
