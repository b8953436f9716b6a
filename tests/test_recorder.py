"""The recording on disk: what readers find, and what a dead program leaves."""

from __future__ import annotations

import subprocess
import sys
import time
from unittest.mock import patch

import h5py
import numpy as np
import pytest

from rig.errors import BeingWritten, FileError
from rig.recording import load_recording, open_recording
from rig.recovery import recover
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
    with subprocess.Popen(
        [sys.executable, "-m", "rig", "run", "sphere-60mm-vented", "--direct", "--out", str(path), "--no-live"],
        stderr=subprocess.PIPE,
        text=True,
    ) as writer:
        while not path.exists():
            time.sleep(0.01)
        with_data = 0
        while with_data < 2000:
            time.sleep(0.05)
            with h5py.File(path, "r", swmr=True, libver="latest") as file:
                with_data = file["entry/data/force"].shape[0] if "entry" in file else 0
                volts = file["entry/raw/volts"][: with_data - 20] if with_data else None
        with pytest.raises(BeingWritten, match="Remedy: wait"):
            recover(path)
        writer.kill()
        writer.communicate()
    with pytest.raises(OSError, match="already open"):
        h5py.File(path, "r")
    recording = load_recording(path)
    with h5py.File(path, "r") as file:  # a plain open works now
        assert file["entry/data/force"].shape[0] == recording.force.size >= with_data - 20
    assert np.array_equal(recording.volts.T[: with_data - 20], volts)
    assert recording.ending == ("the program died; recovered", -9)


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


def test_a_bit_flip_never_crashes_the_reader(request_for):
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
