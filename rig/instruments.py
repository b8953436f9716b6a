"""Opens what a scene needs on a bench, and nothing else: a scene without pressure imports no pump and no sensor."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from drivers.interfaces import Clock, Daq, Pump, Stage
from rig.bench import EMULATED, Bench
from rig.converter import SensorConverter
from rig.observe import Observer, StepEvent, StepPhase
from rig.safe_state import release

if TYPE_CHECKING:
    from drivers.calibration import Calibration
    from drivers.emulated.bench import EmulatedBench
    from drivers.force import LoadCell
    from drivers.pressure import HoneywellHSC
    from rig.session import Request


@dataclass
class Opened:
    """The open instruments of a run; ``converter`` makes a fresh converter for each time the loop begins."""

    stage: Stage
    pump: Pump | None
    daq: Daq
    clock: Clock
    converter: Callable[[], SensorConverter]
    virtual: bool = False
    observers: list[Observer] = field(default_factory=list)
    shut_down: Callable[[], None] = lambda: None

    def identities(self) -> dict[str, str]:
        """Return what each instrument said of itself."""
        devices: dict[str, Any] = {"stage": self.stage, "pump": self.pump, "daq": self.daq}
        return {
            name: " ".join(filter(None, (i.maker, i.model, i.serial, i.firmware)))
            for name, device in devices.items()
            if device is not None and (i := device.identity)
        }


class _StepsToFaults(Observer):
    """Tells the emulated bench which step has begun, for fault scripts."""

    def __init__(self, emulated: EmulatedBench) -> None:
        self._emulated = emulated

    def step(self, event: StepEvent) -> None:
        """See ``Observer``."""
        if event.phase is StepPhase.STARTED:
            self._emulated.step_started(event.name)


def open_instruments(request: Request) -> Opened:
    """Open stage, DAQ and, where the scene has pressure, pump and sensor.

    Raises
    ------
    DeviceError
        Names the device, what was seen and the remedy; whatever was open is closed again.
    """
    if request.bench.is_emulated:
        return _open_emulated(request)
    return _open_claimed(request.bench, request.scene.uses_pressure)


def _open_claimed(bench: Bench, pressure: bool) -> Opened:
    """Open real instruments, which no other program may have."""
    from rig.one_rig import Claim

    claim = Claim(bench, pressure=pressure)
    try:
        opened = _open_wired(bench, pressure, time.perf_counter)
    except BaseException:
        claim.release()
        raise
    opened.shut_down = claim.release
    return opened


def _open_emulated(request: Request) -> Opened:
    from rig.emulation import Hands, emulated_bench, weights

    emulated = emulated_bench(request)
    try:
        if request.wire:
            endpoints = emulated.endpoints
            connections = {"stage": endpoints.stage, "daq": endpoints.daq}
            if endpoints.pump is not None:
                connections["pump"] = endpoints.pump
            opened = _open_wired(request.bench, request.scene.uses_pressure, emulated.clock, connections)
        else:
            opened = _open_direct(request, emulated)
    except BaseException:
        emulated.close()
        raise
    opened.virtual = request.speed is None
    opened.observers += [_StepsToFaults(emulated), Hands(request.controls, emulated, weights(request.scene))]
    opened.shut_down = emulated.close
    return opened


def _open_direct(request: Request, emulated: EmulatedBench) -> Opened:
    bench, pressure = request.bench, request.scene.uses_pressure
    daq = emulated.daq(*channel_names(pressure), rate=bench.daq.rate_Hz)
    low, high = bench.stage.minimum_mm * 1e-3, bench.stage.maximum_mm * 1e-3
    pump = None
    if pressure and bench.pump is not None:
        diameter = bench.pump.syringe_diameter_mm * 1e-3
        pump = emulated.pump(syringe_diameter=diameter, force_percent=bench.pump.force_percent)
    return Opened(
        emulated.stage(minimum=low, maximum=high, inverted=bench.stage.inverted),
        pump,
        daq,
        emulated.clock,
        lambda: sensor_converter(bench, pressure, daq.rate),
    )


def _open_wired(bench: Bench, pressure: bool, clock: Clock, connections: dict[str, str] | None = None) -> Opened:
    stage: Stage | None = None
    pump: Pump | None = None
    try:
        stage = open_stage(bench, clock, connections)
        if pressure:
            pump = open_pump(bench, clock, connections)
        daq = open_daq(bench, pressure, connections)
    except BaseException:
        release(stage, pump, None)
        raise
    return Opened(stage, pump, daq, clock, lambda: sensor_converter(bench, pressure, daq.rate))


def open_stage(bench: Bench, clock: Clock = time.perf_counter, connections: dict[str, str] | None = None) -> Stage:
    """Open the bench's stage; nothing moves."""
    from drivers.stage import PIStage

    part = bench.stage
    return PIStage(
        _connection("stage", part.connection, connections),
        axis=part.axis,
        baud=part.baud,
        minimum=part.minimum_mm * 1e-3,
        maximum=part.maximum_mm * 1e-3,
        inverted=part.inverted,
        expected_model=part.model,
        reply_timeout=part.reply_timeout_ms * 1e-3,
        clock=clock,
    )


def open_pump(bench: Bench, clock: Clock = time.perf_counter, connections: dict[str, str] | None = None) -> Pump:
    """Open the bench's pump; it is stopped and given its syringe."""
    from drivers.pump import LegatoPump

    part = bench.pump
    if part is None:
        raise ValueError("the bench has no pump; check() refuses such a scene")
    return LegatoPump(
        _connection("pump", part.connection, connections),
        baud=part.baud,
        address=part.address,
        syringe_diameter=part.syringe_diameter_mm * 1e-3,
        force_percent=part.force_percent,
        expected_model=part.model,
        reply_timeout=part.reply_timeout_ms * 1e-3,
        settle=part.settle_ms * 1e-3,
        clock=clock,
    )


def open_daq(bench: Bench, pressure: bool, connections: dict[str, str] | None = None) -> Daq:
    """Open one task with the channels the scene needs; sampling has not begun."""
    from drivers.daq import NIDaq
    from drivers.daq_channels import BridgeChannel, Channel, VoltageChannel, signal_channel

    part = bench.force
    channels: list[Channel] = []
    if part.readout == "bridge":
        channels.append(
            BridgeChannel(
                "force",
                part.channel,
                minimum=-part.range_mV_V,
                maximum=part.range_mV_V,
                excitation=part.excitation_V,
                resistance=part.bridge_ohm,
            )
        )
    else:
        channels.append(VoltageChannel("force", part.channel, -part.range_V, part.range_V, part.terminal))
    if pressure and bench.pressure is not None:
        signal, supply, terminal = bench.pressure.signal_channel, bench.pressure.supply_channel, bench.pressure.terminal
        channels += [signal_channel("pressure", signal, terminal), signal_channel("supply", supply, terminal)]
    return NIDaq(
        channels,
        rate=bench.daq.rate_Hz,
        connection=_connection("daq", bench.daq.connection, connections),
        expected_model=bench.daq.model,
        allow_remote=bench.daq.allow_remote,
    )


def channel_names(pressure: bool) -> tuple[str, ...]:
    """Return the channels a scene needs, in the order of their rows."""
    return ("force", "pressure", "supply") if pressure else ("force",)


def load_cell(bench: Bench) -> LoadCell:
    """Return the bench's load cell with its calibration."""
    from drivers.force import LoadCell

    part = bench.force
    rail = part.range_mV_V if part.readout == "bridge" else part.range_V
    return LoadCell(
        part.cell,
        part.capacity_N,
        calibration_record(bench),
        minimum=-rail,
        maximum=rail,
        compression_positive=part.compression_positive,
    )


def calibration_record(bench: Bench) -> Calibration:
    """Return the load cell's calibration as a record."""
    from drivers.calibration import Calibration

    part = bench.force.calibration
    return Calibration(
        id=part.id,
        certificate=part.certificate,
        date=part.date,
        operator=part.operator,
        serial=part.serial,
        slope=part.slope,
        intercept=part.intercept,
        residual=part.residual,
        uncertainty=part.relative_uncertainty,
        temperature=part.temperature_C,
        unit="N",
        recorded_unit="mV/V" if bench.force.readout == "bridge" else "V",
    )


def sensor_converter(bench: Bench, pressure: bool, rate: float) -> SensorConverter:
    """Return what turns the bench's raw channels into SI, fresh for one run at this sample rate (Hz)."""
    return SensorConverter(load_cell(bench), _pressure_sensor(bench, rate) if pressure else None)


def _pressure_sensor(bench: Bench, rate: float) -> HoneywellHSC:
    from drivers.pressure import HoneywellHSC

    part = bench.pressure
    if part is None:
        raise ValueError("the bench has no pressure sensor; check() refuses such a scene")
    calibration = part.calibration
    return HoneywellHSC(
        rate=rate,
        zero=0.0 if part.zero is None else part.zero.offset_Pa,
        slope=1.0 if calibration is None else calibration.slope,
        intercept=0.0 if calibration is None else calibration.intercept,
    )


def _connection(device: str, named: str, connections: dict[str, str] | None) -> str:
    if connections is not None and device in connections:
        return connections[device]
    if named == EMULATED:
        raise ValueError(f"{device}: an emulated connection has no endpoint of its own")
    return named
