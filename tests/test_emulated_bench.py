"""The assembled emulated bench, and the command that serves it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from drivers.emulated.bench import EmulatedBench
from drivers.emulated.faults import Fault
from drivers.emulated.server import Line
from drivers.emulated.truth import Truth
from rig.errors import FileError
from rig.fault_script import known_faults, load_faults

PATIENCE = 60.0
"""Seconds for what comes: a busy computer is no fault."""


def imported_by(program: str) -> set[str]:
    """The modules a fresh interpreter has after running a program."""
    code = f"{program}\nimport sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_a_bench_without_pressure_imports_and_serves_no_pump():
    program = """
from drivers.emulated.bench import EmulatedBench
from drivers.emulated.truth import Truth
with EmulatedBench(Truth.pull_off(), pressure=False) as bench:
    assert bench.endpoints.pump is None
    assert (bench.plant.advance(10, 1000.0)["pressure"] ** 2).mean() < 100
with EmulatedBench(Truth.pull_off(), pressure=False, wire=False) as bench:
    bench.stage(), bench.daq("force")
"""
    assert not {name for name in imported_by(program) if "pump" in name}


def test_a_direct_bench_imports_no_wire():
    program = """
from drivers.emulated.bench import EmulatedBench
from drivers.emulated.truth import Truth
with EmulatedBench(Truth.pull_off(), wire=False) as bench:
    bench.stage(), bench.daq("force")
"""
    assert not {"grpc", "nidaqmx", "pipython"} & imported_by(program)


def test_virtual_time_keeps_to_one_core_and_gives_the_others_back():
    def cores() -> set[int]:
        return os.sched_getaffinity(0) if sys.platform == "linux" else {0}

    before = cores()
    with EmulatedBench(Truth.pull_off()) as bench:
        assert bench.endpoints.daq
        assert len(cores()) == 1
    assert cores() == before
    with EmulatedBench(Truth.pull_off(), speed=1.0) as bench:
        assert bench.endpoints.daq
        assert cores() == before


def test_wires_and_direct_devices_exclude_each_other():
    with EmulatedBench(Truth.pull_off()) as bench, pytest.raises(RuntimeError, match="endpoints"):
        bench.stage()
    with EmulatedBench(Truth.pull_off(), wire=False) as bench, pytest.raises(RuntimeError, match="no wires"):
        bench.endpoints  # noqa: B018
    bench = EmulatedBench(Truth.pull_off(), wire=False, pressure=False)
    with bench, pytest.raises(RuntimeError, match="no pump"):
        bench.pump()


def test_closing_frees_the_ports_and_may_be_repeated():
    import psutil

    def listening() -> set[int]:
        return {end.laddr.port for end in psutil.Process().net_connections("inet") if end.status == psutil.CONN_LISTEN}

    bench = EmulatedBench(Truth.pull_off())
    ports = {int(end.rpartition(":")[2]) for end in (bench.endpoints.stage, bench.endpoints.pump, bench.endpoints.daq)}
    assert ports <= listening()
    assert bench.endpoints is bench.endpoints
    bench.close()
    bench.close()
    assert not ports & listening()


def test_virtual_time_is_the_plants_and_real_time_runs_by_itself():
    with EmulatedBench(Truth.pull_off(), wire=False) as bench:
        assert bench.virtual
        daq = bench.daq("force")
        daq.start()
        daq.read(500)
        assert bench.clock() == pytest.approx(0.5)
    with EmulatedBench(Truth.pull_off(), wire=False, speed=50.0) as bench:
        assert not bench.virtual
        daq = bench.daq("force", buffer_seconds=10_000.0, patience=PATIENCE)
        daq.start()
        assert daq.read(1000).shape == (1, 1000)
        reached = bench.plant.time
        deadline = time.monotonic() + 200
        while bench.plant.time < reached + 0.5 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert bench.plant.time > reached + 0.4
        daq.stop()


def test_steps_reach_the_fault_script():
    with EmulatedBench(Truth.pull_off(), wire=False) as bench:
        bench.faults.add(Fault("stage", "silent", at_step="retract"))
        bench.step_started("dwell")
        assert bench.faults.active("stage", "silent") is None
        bench.step_started("retract")
        assert bench.faults.active("stage", "silent") is not None


# rig emulate


def emulate(*options: str) -> subprocess.Popen[str]:
    words = [sys.executable, "-m", "rig", "emulate", *options]
    group = subprocess.CREATE_NEW_PROCESS_GROUP if sys.platform == "win32" else 0
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, creationflags=group)


def interrupt(process: subprocess.Popen[str]) -> tuple[str, str, int]:
    process.send_signal(signal.CTRL_BREAK_EVENT if sys.platform == "win32" else signal.SIGINT)
    out, err = process.communicate()
    return out, err, process.returncode


@pytest.mark.parametrize("terminals", [False] if sys.platform == "win32" else [False, True])
def test_emulate_prints_one_line_serves_and_ends_on_ctrl_c(terminals):
    from drivers.daq import NIDaq
    from drivers.daq_channels import VoltageChannel
    from drivers.pump import LegatoPump
    from drivers.stage import PIStage

    process = emulate("--seed", "3", "--speed", "10", *(["--pty"] if terminals else []))
    assert process.stdout is not None
    ends = json.loads(process.stdout.readline())
    expected = {"stage", "pump", "daq"} | ({"stage_pty", "pump_pty"} if terminals else set())
    assert set(ends) == expected
    stage = PIStage(ends["stage_pty" if terminals else "stage"], reply_timeout=PATIENCE)
    pump = LegatoPump(
        ends["pump_pty" if terminals else "pump"], syringe_diameter=14.43e-3, force_percent=50, reply_timeout=PATIENCE
    )
    daq = NIDaq(
        [VoltageChannel("force", "Dev1/ai0")],
        rate=1000.0,
        connection=f"grpc://{ends['daq']}",
        buffer_seconds=10_000.0,
        patience=PATIENCE,
    )
    try:
        assert not stage.referenced
        assert not stage.status().servo_on
        assert pump.status().volume == 0.0
        daq.start()
        assert daq.read(100).shape == (1, 100)
    finally:
        for device in (daq, pump, stage):
            device.close()
    out, err, code = interrupt(process)
    assert (out, err, code) == ("", "", 0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--speed", "0"), ["--speed", "above 0"]),
        (("--faults", "nowhere.toml"), ["nowhere.toml", "no such file"]),
        (("--scene", "no-such-scene"), ["no-such-scene", "Remedy"]),
    ],
)
def test_emulate_explains_what_is_wrong(options, words):
    process = emulate(*options)
    out, err = process.communicate()
    assert process.returncode == 2
    assert out == ""
    assert len(err.splitlines()) == 1
    for word in words:
        assert word in err


# Fault scripts


def script(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "faults.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_fault_script_is_read(tmp_path):
    faults = load_faults(
        script(
            tmp_path,
            """
            [[fault]]
            device = "force"
            kind = "over_range"
            at_sample = 100
            for_samples = 10
            value = 4.5

            [[fault]]
            device = "stage"
            kind = "blocked"
            at_step = "retract"
            after_samples = 50
            """,
        )
    )
    faults.advance(105)
    assert faults.active("force", "over_range") == Fault(
        "force", "over_range", at_sample=100, for_samples=10, value=4.5
    )
    faults.step_started("retract")
    faults.advance(156)
    assert faults.active("stage", "blocked") is not None
    assert faults.active("force", "over_range") is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[fault]", ["not valid TOML"]),
        ("[fault]\ndevice = 'stage'", ["fault", "list"]),
        ("speed = 1", ["unknown key speed"]),
        ("[[fault]]\ndevice = 'stage'", ["fault.0.kind", "missing"]),
        ("[[fault]]\ndevice = 'laser'\nkind = 'silent'", ["'laser'", "stage", "pump", "daq"]),
        ("[[fault]]\ndevice = 'stage'\nkind = 'melted'", ["'melted'", "blocked"]),
        ("[[fault]]\ndevice = 'stage'\nkind = 'blocked'\nwhen = 3", ["unknown key fault.0.when", "at_sample"]),
        ("[[fault]]\ndevice = 'stage'\nkind = 'blocked'\nat_sample = 'soon'", ["at_sample", "'soon'"]),
        (
            "[[fault]]\ndevice = 'stage'\nkind = 'blocked'\nat_sample = -4",
            ["at_sample = -4", "greater than or equal to 0"],
        ),
        ("[[fault]]\ndevice = 'stage'\nkind = 'blocked'\nat_sample = 4\nat_step = 'x'", ["both"]),
    ],
)
def test_a_bad_fault_script_is_explained(tmp_path, text, words):
    path = script(tmp_path, text)
    with pytest.raises(FileError) as caught:
        load_faults(path)
    for word in (str(path), *words):
        assert word in str(caught.value)


def test_every_device_has_faults_with_a_meaning():
    known = known_faults()
    assert set(known) == {"stage", "pump", "daq", "force", "pressure", "supply"}
    assert all(meaning for kinds in known.values() for meaning in kinds.values())


def test_nothing_is_written_on_a_line_that_has_been_closed():
    """The number of a closed terminal may be another file's by then."""
    writing, written = threading.Event(), []

    def slow(data: bytes) -> None:
        writing.set()
        time.sleep(0.1)
        written.append(data)

    line = Line(slow)
    line.send(b"late", 1e-3)
    assert writing.wait(PATIENCE)
    line.close()
    assert written == [b"late"]
