"""Walks through a bench and says what is there, what is not, and what to do. Moves nothing."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError
from drivers.interfaces import Daq
from drivers.pressure import SUPPLY, TOTAL_ERROR_BAND
from rig.bench import EMULATED, Bench
from rig.instruments import Opened, channel_names, open_daq, open_pump, open_stage, sensor_converter
from rig.one_rig import Claim, InUse

Array = NDArray[np.float64]

_CLIENTS = ("pipython", "pyserial", "nidaqmx", "grpcio", "h5py", "numpy")
_SECONDS = 2.0


@dataclass(frozen=True)
class Finding:
    """One line of the report: what was looked at, whether it is well, what was seen and what to do."""

    what: str
    well: bool
    seen: str
    remedy: str = ""


def examine(bench: Bench) -> Iterator[Finding]:
    """Yield what is found on a real bench, one instrument after the other; none keeps another from being looked at.

    A rig that another program is using is left alone.
    """
    yield from _software()
    yield from _ports(bench)
    try:
        claim = Claim(bench, pressure=bench.pump is not None)
    except InUse as error:
        seen, _, remedy = str(error).partition(" Remedy: ")
        yield Finding("rig", False, seen, remedy)
        return
    try:
        yield from _guarded("stage", lambda: _stage(bench))
        if bench.pump is not None:
            yield from _guarded("pump", lambda: _pump(bench))
        yield from _guarded("daq", lambda: _daq(bench))
    finally:
        claim.release()


def examine_emulated(opened: Opened, bench: Bench) -> Iterator[Finding]:
    """Yield what is found on the emulated bench, through the same clients."""
    yield from _software()
    for name, identity in opened.identities().items():
        yield Finding(name, True, identity)
    low, high = opened.stage.travel
    yield Finding("stage travel", True, f"{low * 1e3:g} to {high * 1e3:g} mm")
    yield from _signals(opened.daq, bench, opened.pump is not None)


def _software() -> Iterator[Finding]:
    yield Finding("python", sys.version_info >= (3, 11), f"{platform.python_version()} on {platform.platform()}")
    for name in _CLIENTS:
        try:
            yield Finding(name, True, version(name))
        except PackageNotFoundError:
            yield Finding(name, False, "not installed", "pip install the program again")


def _ports(bench: Bench) -> Iterator[Finding]:
    from serial.tools import list_ports

    present = sorted(port.device for port in list_ports.comports())
    yield Finding("serial ports", True, ", ".join(present) or "none")
    for name, part in (("stage", bench.stage), ("pump", bench.pump)):
        port = getattr(part, "connection", "")
        if not port or port == EMULATED or "://" in port:
            continue
        yield _port(name, port, present)


def _port(name: str, port: str, present: list[str]) -> Finding:
    what = f"{name} port {port}"
    if os.name != "posix":
        known = port.upper() in (item.upper() for item in present)
        return Finding(what, known, "present" if known else "not there", "" if known else "check cable and port number")
    path = Path(port)
    if not path.exists():
        return Finding(what, False, "not there", "check cable and power; names are in /dev/serial/by-id")
    if not os.access(path, os.R_OK | os.W_OK):
        return Finding(what, False, "no permission", "add yourself to the group dialout and log in again")
    return Finding(what, True, "present, readable and writable")


def _guarded(what: str, look: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    try:
        yield from look()
    except DeviceError as error:
        yield Finding(what, False, error.message, error.remedy)


def _stage(bench: Bench) -> Iterator[Finding]:
    stage = open_stage(bench)
    try:
        yield Finding("stage", True, f"{stage.identity.model}, {stage.identity.serial}, {stage.identity.firmware}")
        low, high = stage.travel
        yield Finding("stage travel", True, f"{low * 1e3:g} to {high * 1e3:g} mm")
        status = stage.status()
        yield Finding(
            "stage state",
            True,
            f"at {status.position * 1e3:.4f} mm, servo {'on' if status.servo_on else 'off'}, "
            f"{'moving' if status.moving else 'at rest'}, answers in {(status.received - status.sent) * 1e3:.1f} ms",
        )
        if stage.referenced:
            yield Finding("stage reference", True, "referenced")
        else:
            yield Finding("stage reference", False, "not referenced", "clear the path, then run `rig reference`")
    finally:
        stage.close()


def _pump(bench: Bench) -> Iterator[Finding]:
    pump = open_pump(bench)
    try:
        slowest, fastest = pump.rate_limits
        yield Finding("pump", True, f"{pump.identity.model}, {pump.identity.serial}, {pump.identity.firmware}")
        yield Finding("pump rates", True, f"{slowest * 6e10:.3g} ul/min to {fastest * 6e7:.3g} ml/min")
        yield Finding("pump state", True, f"{pump.status().state}")
    finally:
        pump.close()


def _daq(bench: Bench) -> Iterator[Finding]:
    pressure = bench.pressure is not None
    daq = open_daq(bench, pressure)
    try:
        yield Finding("daq", True, f"{daq.identity.model}, {daq.identity.serial}, {daq.rate:g} samples/s")
        yield from _signals(daq, bench, pressure)
    finally:
        daq.close()


def _signals(daq: Daq, bench: Bench, pressure: bool) -> Iterator[Finding]:
    """Measure zero and noise of every channel for two seconds."""
    converter = sensor_converter(bench, pressure, daq.rate)
    daq.start()
    try:
        volts = daq.read(round(_SECONDS * daq.rate))
    finally:
        daq.stop()
    force, gauge = converter.convert(volts)
    rows = dict(zip(channel_names(pressure), volts, strict=True))
    yield Finding(
        "force", True, f"{force.mean():+.5f} N, noise {force.std() * 1e3:.3f} mN rms ({_volts(rows['force'])})"
    )
    if gauge is not None:
        supply = rows["supply"]
        yield Finding("supply", bool(SUPPLY[0] <= supply.mean() <= SUPPLY[1]), _volts(supply), "check the 5 V supply")
        yield _zero(gauge, rows["pressure"])
    try:
        converter.check()
    except DeviceError as error:
        yield Finding(error.device, False, error.message, error.remedy)


def _zero(gauge: Array, volts: Array) -> Finding:
    seen = f"{gauge.mean():+.1f} Pa, noise {gauge.std():.1f} Pa rms ({_volts(volts)})"
    well = bool(abs(gauge.mean()) <= TOTAL_ERROR_BAND)
    return Finding("pressure", well, seen, "open the chamber to the room; an open wire reads about -33 kPa")


def _volts(row: Array) -> str:
    return f"{row.mean():.5f} V"
