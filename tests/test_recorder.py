"""The recording on disk: what readers find, and what a dead program leaves."""

from __future__ import annotations

import os
import subprocess
import sys
from unittest.mock import patch

import h5py
import numpy as np
import pytest
from held_run import held
from hypothesis import given
from hypothesis import strategies as st

from rig.errors import BeingWritten, FileError
from rig.journal import journal_of
from rig.layout import EVENTS, pieces
from rig.library import find
from rig.observe import Observer
from rig.recorder import Recorder
from rig.recording import load_recording, open_recording
from rig.recovery import recover
from rig.seal import seal
from rig.session import run_scene


def test_h5py_and_pandas_open_a_recording_without_us(request_for):
    import pandas as pd

    request = request_for("sphere-60mm-low")
    run_scene(request)
    with h5py.File(request.out) as file:
        entry = file[file.attrs["default"]]
        data = entry[entry.attrs["default"]]
        assert entry.attrs["NX_class"] == "NXentry"
        assert data.attrs["NX_class"] == "NXdata"
        signal, axis = data[data.attrs["signal"]], data[data.attrs["axes"]]
        assert signal.shape == axis.shape
        assert signal.attrs["units"] == "N"
        assert data["pressure"].attrs["units"] == "Pa"
        table = pd.DataFrame(entry["raw/stage"][:])
        assert (table.received_s >= table.sent_s).all()
        assert entry["configuration/scene"].asstr()[()] == request.scene_text


def test_the_raw_values_of_each_instrument_carry_their_own_unit(request_for):
    request = request_for("sphere-60mm-low")
    with patch("drivers.emulated.direct.DirectDaq.units", ("mV/V", "V", "V")):
        run_scene(request)
    with h5py.File(request.out) as file:
        volts = file["entry/raw/volts"]
        assert volts.attrs["units"] == "mV/V, V"
        assert dict(zip(volts.attrs["channels"], volts.attrs["channel_units"], strict=True)) == {
            "force": "mV/V",
            "pressure": "V",
            "supply": "V",
        }
    with h5py.File(request.out, "r+") as file:
        del file["entry/raw/volts"].attrs["channel_units"]  # as recorded before there was such a thing
    assert load_recording(request.out).units == ("V", "V", "V")


def test_a_killed_writer_loses_nothing_it_acknowledged(tmp_path):
    path = tmp_path / "killed.h5"
    words = ("run", "sphere-60mm-vented", "--direct", "--no-live", "--out", path)
    with held(1, 200, *words) as writer:
        with h5py.File(path, "r", swmr=True, libver="latest") as file:
            with_data = file["entry/data/force"].shape[0]
            volts = file["entry/raw/volts"][:with_data]
        assert with_data == 201 * 20
        with pytest.raises(BeingWritten, match="Remedy: wait"):
            recover(path)
        writer.kill()
    with pytest.raises(OSError, match="already open"):
        h5py.File(path, "r")
    recording = load_recording(path)
    with h5py.File(path, "r") as file:  # a plain open works now
        assert file["entry/data/force"].shape[0] == recording.force.size == with_data
    assert np.array_equal(recording.volts.T, volts)
    assert recording.ending == ("the program died; recovered", -9)


@pytest.mark.parametrize("journalled", [False, True])
def test_two_programs_may_repair_one_recording_at_the_same_time(tmp_path, monkeypatch, journalled):
    bench, _ = find("bench", "emulated")
    (tmp_path / "bench.toml").write_text(
        f"{bench}\n[recording]\nsurvives_power_cut = {str(journalled).lower()}\n", "utf-8"
    )
    path = tmp_path / "killed.h5"
    words = ("run", "sphere-60mm-vented", "--bench", tmp_path / "bench.toml", "--direct", "--no-live", "--out", path)
    with held(1, 200, *words) as writer:
        writer.kill()
    assert journal_of(path).exists() == journalled
    whole = []

    def the_other_is_done_first(fresh):
        if not whole:
            subprocess.run([sys.executable, "-m", "rig", "recover", str(path)], check=True)
            whole.append(load_recording(path))
        seal(fresh)

    monkeypatch.setattr("rig.recovery.seal", the_other_is_done_first)
    assert recover(path).repaired
    assert np.array_equal(load_recording(path).force, whole[0].force)
    assert {file.name for file in tmp_path.iterdir()} == {"bench.toml", "killed.h5"}


@pytest.mark.parametrize("content", [b"", b"not hdf5", b"\x89HDF\r\n\x1a\n" + b"\0" * 100])
def test_what_is_no_recording_is_one_clear_error(tmp_path, content):
    path = tmp_path / "odd.h5"
    path.write_bytes(content)
    with pytest.raises(FileError, match=r"odd\.h5"):
        load_recording(path)
    assert path.read_bytes() == content


def test_foreign_hdf5_is_refused(tmp_path):
    path = tmp_path / "foreign.h5"
    with h5py.File(path, "w") as file:
        file["x"] = [1, 2]
    with pytest.raises(FileError, match="not a recording"), open_recording(path):
        pass


def test_a_bit_flip_never_crashes_the_reader(request_for, monkeypatch):
    monkeypatch.setattr("rig.seal.PROBE_SECONDS", 3.0)
    monkeypatch.setattr("rig.seal.SLEEP_SECONDS", 1.0)
    request = request_for()
    run_scene(request)
    whole = request.out.read_bytes()
    generator = np.random.default_rng(3)
    for position in generator.integers(0, len(whole), 8):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << int(generator.integers(8))
        request.out.write_bytes(damaged)
        try:
            load_recording(request.out)
        except FileError as error:
            assert "run.h5" in str(error)
    for length in generator.integers(0, len(whole), 4):
        request.out.write_bytes(whole[:length])
        with pytest.raises(FileError):
            load_recording(request.out)


LIMITED = """
import resource, sys
import h5py, numpy
from rig import recorder
from rig.cli import main
limit, recorder.LEAST_ROOM = int(sys.argv[1]), int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
sys.exit(main(["run", "sphere-60mm-vented", "--direct", "--no-live", "--no-picture", "--out", sys.argv[3]]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of a file's size to set")
@pytest.mark.parametrize(("limit", "least"), [(512, 16 << 20), (512, -(1 << 30)), (20_000, -(1 << 30))])
def test_no_room_at_the_start_is_one_message_and_no_crash(tmp_path, limit, least):
    words = [sys.executable, "-c", LIMITED, str(limit), str(least), str(tmp_path / "x.h5")]
    told = subprocess.run(words, capture_output=True, text=True, check=False)
    assert told.returncode == 2, told.stderr
    assert told.stderr.count("\n") == told.stderr.count("Remedy") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of a file's size to set")
def test_a_run_ends_before_its_file_is_as_large_as_it_may_be(tmp_path):
    limit, least = 1_000_000, 800_000
    words = [sys.executable, "-c", LIMITED, str(limit), str(least), str(tmp_path / "x.h5")]
    told = subprocess.run(words, capture_output=True, text=True, check=False)
    assert told.returncode == 2, told.stderr
    with h5py.File(tmp_path / "x.h5") as file:
        assert file["entry/ending"][0]["exit_code"] == 2


@pytest.mark.parametrize("journalled", [False, True])
def test_a_file_system_without_locks_is_refused_and_nothing_is_left(request_for, tmp_path, journalled):
    request = request_for()
    recording = request.bench.recording.model_copy(update={"survives_power_cut": journalled})
    request.bench = request.bench.model_copy(update={"recording": recording})
    opened = h5py.File

    def file(name, mode, **options):
        if mode == "r+":
            raise OSError(37, "No locks available")
        return opened(name, mode, **options)

    with patch("rig.recorder.h5py.File", file), pytest.raises(FileError, match=r"cannot be created .*No locks"):
        run_scene(request)
    assert not list(tmp_path.iterdir())


class _Once(Observer):
    """Does something once, some frames into the run."""

    def __init__(self, act):
        self._act, self._frames = act, 0

    def frame(self, frame):
        self._frames += 1
        if self._frames == 100:
            self._act()


def test_a_recording_whose_name_and_next_name_are_taken_is_written_under_a_third(request_for):
    request = request_for()
    out = request.out

    def take():
        for path in (out, out.with_name("run-rescued.h5")):
            path.unlink(missing_ok=True)
            path.write_bytes(b"another's")

    request.observers = [_Once(take)]
    ending = run_scene(request)
    assert ending.exit_code == 2
    rescued = out.with_name("run-rescued-2.h5")
    assert str(rescued) in ending.reason
    assert request.out == rescued
    assert load_recording(rescued).force.size == ending.samples
    assert out.read_bytes() == out.with_name("run-rescued.h5").read_bytes() == b"another's"


@pytest.mark.skipif(sys.platform == "win32", reason="a folder in use cannot be removed there")
def test_a_recording_whose_folder_becomes_a_file_is_written_beside_it(request_for, tmp_path):
    folder = tmp_path / "folder"
    request = request_for(out=folder / "run.h5")

    def replace():
        (folder / "run.h5").unlink()
        folder.rmdir()
        folder.write_bytes(b"a file")

    request.observers = [_Once(replace)]
    ending = run_scene(request)
    assert ending.exit_code == 2
    assert str(tmp_path / "run.h5") in ending.reason
    assert load_recording(tmp_path / "run.h5").force.size == ending.samples


def test_a_failed_write_tells_what_is_acknowledged(request_for):
    request = request_for()
    recorders = []

    def recorder(*arguments, **options):
        recorders.append(Recorder(*arguments, **options))
        return recorders[0]

    def fail():
        held = os.open(request.out, os.O_RDONLY)
        os.dup2(held, recorders[0]._file.id.get_vfd_handle())
        os.close(held)

    request.observers = [_Once(fail)]
    with patch("rig.session.Recorder", recorder):
        ending = run_scene(request)
    assert ending.exit_code == 2
    assert f"after {ending.samples} samples" in ending.reason
    assert ending.samples == recorders[0].acknowledged <= load_recording(request.out).force.size


def test_the_whole_traceback_of_a_defect_is_in_the_recording(request_for):
    def deep(depth):
        if depth:
            deep(depth - 1)
        raise ZeroDivisionError("the cause, at the end – in Umlauten: äöü")

    request = request_for(referenced=True)
    with patch("rig.converter.SensorConverter.check", lambda _: deep(20)):
        ending = run_scene(request)
    assert ending.exit_code == 70
    told = [row["text"].decode() for row in load_recording(request.out).events if row["kind"] == b"fault"]
    assert len(told) > 2
    assert "".join(told).endswith("ZeroDivisionError: the cause, at the end – in Umlauten: äöü\n")


@given(st.text())
def test_a_long_line_of_the_log_is_kept_whole(text):
    rows = list(pieces(text))
    assert all(len(row.encode()) <= EVENTS["text"].itemsize for row in rows)
    assert "".join(rows) == text.encode(errors="backslashreplace").decode()
