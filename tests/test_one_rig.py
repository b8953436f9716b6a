"""One rig, one program; nothing listens or connects beyond this computer unasked; a file runs and writes nothing."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import h5py
import pytest
from dead_man import bench_file, emulators

from drivers.emulated.bench import EmulatedBench
from drivers.emulated.truth import Truth
from drivers.errors import DeviceError, NotConnected
from rig.bench import load_bench, parse_bench
from rig.doctor import Finding, examine
from rig.errors import FileError
from rig.instruments import open_pump, open_stage
from rig.one_rig import Claim, InUse, same
from rig.recording import load_recording
from rig.session import run_scene

HOLD = "import sys; from rig.bench import load_bench; from pathlib import Path; from rig.one_rig import Claim; \
claim = Claim(load_bench(Path(sys.argv[1]))[0], pressure=True); print('held', flush=True); sys.stdin.read()"


@pytest.fixture
def wired(tmp_path, monkeypatch):
    """A bench of real connections, and a runtime directory of its own."""
    monkeypatch.setenv("RIG_RUNTIME_DIRECTORY", str(tmp_path / "runtime"))
    return bench_file(tmp_path, {"stage": "socket://127.0.0.1:9", "pump": "/dev/ttyNONE0", "daq": "local"})


def test_a_second_program_is_refused_and_told_who_has_the_rig(wired):
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(wired)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(InUse, match=rf"daq: .*process {other.pid}\).*Remedy"):
            Claim(load_bench(wired)[0], pressure=True)
        other.kill()
    Claim(load_bench(wired)[0], pressure=True).release()  # the lock has died with its holder


def test_a_claim_that_fails_holds_nothing(wired):
    bench = load_bench(wired)[0]
    assert bench.pump is not None
    other_stage = bench.model_copy(update={"stage": bench.stage.model_copy(update={"connection": "/dev/ttyNONE1"})})
    first = Claim(bench, pressure=True)
    with pytest.raises(InUse):
        Claim(other_stage, pressure=True)
    first.release()
    Claim(other_stage, pressure=True).release()


def test_a_run_that_finds_the_rig_taken_opens_nothing(wired, request_for):
    bench = load_bench(wired)[0]
    claim = Claim(bench, pressure=False)
    request = request_for(bench=bench)
    with pytest.raises(InUse):
        run_scene(request)
    assert not request.out.exists()
    claim.release()
    with pytest.raises(DeviceError):  # nobody is there; but the lock is free again
        run_scene(request)
    Claim(bench, pressure=True).release()


def test_the_doctor_leaves_a_rig_alone_that_is_in_use(wired, monkeypatch):
    bench = load_bench(wired)[0]
    for device in ("stage", "pump", "daq"):
        monkeypatch.setattr(f"rig.doctor._{device}", lambda bench, name=device: iter([Finding(name, True, "opened")]))
    claim = Claim(bench, pressure=False)
    found = list(examine(bench))
    assert not any(finding.seen == "opened" for finding in found)
    assert (found[-1].what, found[-1].well) == ("rig", False)
    assert f"process {os.getpid()}" in found[-1].seen
    assert "end it first" in found[-1].remedy
    claim.release()
    assert [finding.what for finding in examine(bench) if finding.seen == "opened"] == ["stage", "pump", "daq"]
    Claim(bench, pressure=True).release()  # the doctor has let go of it


def test_two_names_of_one_connection_are_one(tmp_path):
    device = tmp_path / "ttyUSB0"
    device.touch()
    link = tmp_path / "by-id"
    link.symlink_to(device)
    assert same(str(link)) == same(str(device))
    assert same("COM3") == same("com3")
    assert same("socket://LOCALHOST:5") == same("socket://127.0.0.1:5") != same("socket://127.0.0.1:6")


def test_an_emulator_serves_one_host_at_a_time(tmp_path):
    with emulators() as (ends, _, _finish):
        bench = load_bench(bench_file(tmp_path, ends))[0]
        stage, pump = open_stage(bench), open_pump(bench)
        for opening in (open_stage, open_pump):
            with pytest.raises(DeviceError):
                opening(bench)
        stage.close()
        pump.close()


def test_the_emulators_listen_on_loopback_only():
    import psutil

    with EmulatedBench(Truth.pull_off()) as bench:
        assert bench.endpoints
        listening = [c for c in psutil.Process().net_connections("inet") if c.status == psutil.CONN_LISTEN]
    assert len(listening) >= 3
    assert {connection.laddr.ip.removeprefix("::ffff:") for connection in listening} <= {"127.0.0.1", "::1"}


def test_a_device_server_on_another_machine_must_be_allowed():
    from drivers.daq import NIDaq, VoltageChannel

    with pytest.raises(NotConnected, match="allow"):
        NIDaq([VoltageChannel("force", "Dev1/ai0")], rate=1000.0, connection="grpc://192.0.2.1:31763")


@pytest.mark.parametrize(
    "connection", ["spy:///dev/null?file={out}", "alt://x", "loop://", "hwgrep://.*", "rfc2217://x:1"]
)
@pytest.mark.parametrize("opening", [open_stage, open_pump])
def test_a_connection_is_a_port_and_no_handler_that_could_write(connection, opening, tmp_path):
    out = tmp_path / "spied.txt"
    text = load_bench(None)[1].replace('"emulated"', f'"{connection.format(out=out)}"', 3)
    with pytest.raises((FileError, NotConnected)):
        opening(parse_bench(text, "bench.toml"))
    assert not out.exists()


def test_a_recording_cannot_read_other_files(request_for, tmp_path):
    request = request_for()
    run_scene(request)
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["x"] = [42.0]
    with h5py.File(request.out, "r+") as file:
        del file["entry/predictions"]
        file["entry/predictions"] = h5py.ExternalLink(str(secret), "/x")
    with pytest.raises(FileError, match="lies outside"):
        load_recording(request.out)


def test_a_title_is_no_path(request_for, tmp_path):
    request = request_for()
    scene = request.scene.model_copy(update={"title": "../../../etc/passwd $(touch x)"})
    request = dataclasses.replace(request, scene=scene)
    before = set(Path(tmp_path).rglob("*"))
    ending = run_scene(request)
    assert ending.exit_code == 0
    assert set(Path(tmp_path).rglob("*")) - before == {request.out}
    assert not os.path.exists("x")
