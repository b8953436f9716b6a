"""From the plant's newtons, pascals and volts to the numbers an NI device delivers: sensors, amplifier, converter.

Free of any wire: the emulated DAQ and the direct back end share it, so that both deliver the same bits. Noise belongs
to a channel and is drawn sample by sample, so that the way reads are cut into frames changes nothing.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date

import numpy as np
from numpy.typing import NDArray

from drivers.calibration import Calibration
from drivers.daq_channels import BridgeChannel, Channel
from drivers.emulated.faults import Faults
from drivers.emulated.noise import NoiseStream

Array = NDArray[np.float64]

FAULTS: Mapping[str, Mapping[str, str]] = {
    "force": {
        "over_range": "the cell carries `value` newtons whatever the plant does",
        "open_wire": "the amplifier runs to its positive rail",
        "noise": "the noise is `value` times as large",
    },
    "pressure": {
        "open_wire": "the input sits at the device's open-input voltage (1.398 V, a believable -330 mbar)",
        "clipped": "the output sits at its upper clip limit (lower with a negative `value`)",
        "supply_lost": "the sensor is without power while the supply channel still reads it: 0 V",
        "noise": "the noise is `value` times as large",
    },
    "supply": {
        "lost": "supply and sensor output fall to 0 V",
        "sag": "the supply falls to `value` volts",
        "open_wire": "the wire that measures the supply is open",
    },
}

OPEN_INPUT = 1.398  # V; NI USB-6008/6009 user guide: an open input sits on a 30.9 k / 39.2 k divider of 2.5 V


class Refusal(Exception):
    """NI-DAQmx refuses: a negative error code, and on reads how many samples came before it."""

    def __init__(self, code: int, message: str, samples: int | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.samples = samples


@dataclass(frozen=True, slots=True)
class Cell:
    """The load cell as it is, a little off its certificate.

    Attributes
    ----------
    capacity
        N.
    sensitivity
        Of cell and amplifier on the certificate, V/N; ``bridge_sensitivity`` without amplifier, mV/V per N.
    gain_error, linearity
        Relative error of the sensitivity, and bow of the curve relative to capacity (zero at 0 and at capacity).
    zero
        Output without load, as a part of the output at capacity.
    noise
        N, rms.
    """

    name: str = "GSO-1K"
    capacity: float = 9.80665
    sensitivity: float = 0.8
    bridge_sensitivity: float = 0.15
    gain_error: float = 6e-4
    linearity: float = 2e-4
    zero: float = 0.004
    noise: float = 4e-4

    def calibration(self, recorded_unit: str = "V") -> Calibration:
        """Return the certificate: what the rig is told about this cell."""
        sensitivity = self.sensitivity if recorded_unit == "V" else self.bridge_sensitivity
        return Calibration(
            id=f"emulated-{self.name}-{recorded_unit.replace('/', '-per-')}",
            certificate="emulated bench",
            date=date(2024, 1, 15),
            operator="emulated bench",
            serial="E0001",
            slope=1 / sensitivity,
            intercept=0.0,
            residual=2e-4 * self.capacity,
            uncertainty=1e-3,
            temperature=22.0,
            recorded_unit=recorded_unit,
        )

    def output(self, force: Array, bridge: bool) -> Array:
        """Return the noise-free signal (V, or mV/V) for a force (N)."""
        sensitivity = (self.bridge_sensitivity if bridge else self.sensitivity) * (1 + self.gain_error)
        straight, bow = sensitivity * (1 + self.linearity), sensitivity * self.linearity / self.capacity
        return force * (straight - bow * np.abs(force)) + sensitivity * self.zero * self.capacity


@dataclass(frozen=True, slots=True)
class PressureSensor:
    """A Honeywell HSC with its small errors: 10 to 90 % of the supply, clipped at 2.5 and 97.5 %.

    Attributes
    ----------
    full_scale
        Pa on either side of zero.
    offset, gain_error
        Relative to the span of 80 % of the supply, and to the sensitivity.
    noise
        rms, as a part of the supply.
    update_rate
        The output is renewed so often, Hz.
    """

    full_scale: float = 60e3
    offset: float = 8e-4
    gain_error: float = 5e-4
    noise: float = 5e-5
    update_rate: float = 1000.0
    clip: tuple[float, float] = (0.025, 0.975)

    def output(self, pressure: Array, supply: Array, noise: Array) -> Array:
        """Return V for a gauge pressure (Pa), the supply (V) and standard normal noise."""
        part = pressure * (0.4 * (1 + self.gain_error) / self.full_scale)
        part += self.noise * noise + (0.5 + 0.8 * self.offset)
        return supply * np.fmin(np.fmax(part, self.clip[0]), self.clip[1])


@dataclass(frozen=True, slots=True)
class Module:
    """One NI device or C Series module.

    Attributes
    ----------
    inputs
        Number of analog inputs.
    ranges
        Half spans it can be set to: V, or mV/V for a bridge module.
    bits, overrange
        Resolution, and by how much the codes reach beyond the range.
    noise
        rms, as a part of the range.
    filter_samples
        Samples by which a delta-sigma converter's filter delays the signal.
    """

    name: str
    product: str
    serial: int
    inputs: int
    ranges: tuple[float, ...]
    bits: int
    noise: float
    overrange: float = 1.05
    bridge: bool = False
    filter_samples: int = 0

    def range_for(self, minimum: float, maximum: float) -> float:
        """Return the narrowest range that holds both limits."""
        wanted = max(abs(minimum), abs(maximum))
        for half_span in sorted(self.ranges):
            if wanted <= half_span:
                return half_span
        raise Refusal(-200077, f"Requested value is not supported: {self.product} measures up to +-{max(self.ranges)}.")


@dataclass(frozen=True, slots=True)
class Input:
    """One virtual channel: an input, its range, and DAQmx's scaling of what it measures (V or mV/V)."""

    physical: str
    minimum: float
    maximum: float
    bridge: bool = False
    gain: float = 1.0
    offset: float = 0.0

    @property
    def limits(self) -> tuple[float, float]:
        """The range asked for, before scaling: V or mV/V."""
        low, high = (self.minimum - self.offset) / self.gain, (self.maximum - self.offset) / self.gain
        return min(low, high), max(low, high)

    @classmethod
    def of(cls, channel: Channel) -> Input:
        """Return what a driver's channel asks of the device."""
        return cls(channel.physical, channel.minimum, channel.maximum, isinstance(channel, BridgeChannel))


@dataclass(frozen=True)
class Device:
    """NI hardware on one sample clock, and what is wired to its inputs (physical channel to sensor)."""

    modules: tuple[Module, ...]
    wiring: Mapping[str, str]
    timebase: float = 20e6
    fastest: float = 250e3
    simulated: bool = False
    cell: Cell = field(default_factory=Cell)
    sensor: PressureSensor = field(default_factory=PressureSensor)

    def module(self, name: str) -> Module:
        """Return the module of a device name or a physical channel."""
        for module in self.modules:
            if module.name == name.split("/", maxsplit=1)[0]:
                return module
        raise Refusal(-200220, f"Device identifier is invalid: {name.split('/', maxsplit=1)[0]}.")

    def inputs(self, name: str) -> list[str]:
        """Return the physical channels of one module."""
        return [f"{name}/ai{i}" for i in range(self.module(name).inputs)]

    def check(self, wanted: Input) -> None:
        """Refuse a channel this hardware cannot have."""
        module = self.module(wanted.physical)
        if wanted.physical not in self.inputs(module.name):
            raise Refusal(-200170, f"Physical channel specified does not exist on this device: {wanted.physical}.")
        if wanted.bridge != module.bridge:
            raise Refusal(
                -200431, f"Selected physical channel does not support the measurement type: {wanted.physical}."
            )
        if not wanted.minimum < wanted.maximum:
            raise Refusal(-200082, f"Minimum {wanted.minimum} is not less than maximum {wanted.maximum}.")
        module.range_for(*wanted.limits)

    def coerce_rate(self, rate: float, channels: int) -> float:
        """Return the next higher sample rate the hardware has (Hz).

        A divided timebase; with a delta-sigma module 50 kS/s / n, n = 1...31 (NI 9237 operating instructions).
        """
        delta_sigma = any(module.filter_samples for module in self.modules)
        highest = 50e3 if delta_sigma else self.fastest / max(channels, 1)
        if not 0 < rate <= highest:
            raise Refusal(-200077, f"Requested sample rate {rate} Hz is not supported; the highest is {highest} Hz.")
        if delta_sigma:
            return 50e3 / min(_divisor(50e3, rate), 31)
        return self.timebase / _divisor(self.timebase, rate)


def _divisor(timebase: float, rate: float) -> int:
    """Return the largest divisor that is not slower than asked; a rate the timebase has divides it exactly."""
    return int(timebase / rate * (1 + 1e-12))


def usb_6211(name: str = "Dev1", **changes: object) -> Device:
    """Return an NI USB-6211: 16 bit, multiplexed, four ranges; load cell on ai0, HSC on ai1, its supply on ai2."""
    module = Module(name, "USB-6211", 0x01A2B3C4, 16, (0.2, 1.0, 5.0, 10.0), 16, 2.4e-5)
    wiring = {f"{name}/ai0": "force", f"{name}/ai1": "pressure", f"{name}/ai2": "supply"}
    return Device((module,), wiring, **changes)  # type: ignore[arg-type]


def usb_6009(name: str = "Dev1", **changes: object) -> Device:
    """Return an NI USB-6009: 14 bit, noisy, 48 kS/s in all."""
    module = Module(name, "USB-6009", 0x0155AA00, 8, (1.0, 2.0, 2.5, 4.0, 5.0, 10.0, 20.0), 14, 5e-4, overrange=1.0)
    wiring = {f"{name}/ai0": "force", f"{name}/ai1": "pressure", f"{name}/ai2": "supply"}
    return Device((module,), wiring, timebase=24e6, fastest=48e3, **changes)  # type: ignore[arg-type]


def compact_daq(name: str = "cDAQ1", **changes: object) -> Device:
    """Return a cDAQ chassis: NI 9237 in slot 1 with the bare bridge, NI 9205 in slot 2 with the HSC and its supply."""
    bridge = Module(f"{name}Mod1", "NI 9237", 0x0192_3700, 4, (25.0,), 24, 2e-6, 1.0, bridge=True, filter_samples=40)
    voltage = Module(f"{name}Mod2", "NI 9205", 0x0192_0500, 32, (0.2, 1.0, 5.0, 10.0), 16, 2.4e-5)
    wiring = {f"{name}Mod1/ai0": "force", f"{name}Mod2/ai0": "pressure", f"{name}Mod2/ai1": "supply"}
    return Device((bridge, voltage), wiring, **changes)  # type: ignore[arg-type]


class Electronics:
    """The inputs of one started task.

    Parameters
    ----------
    device, inputs, rate
        The hardware, its channels in the order of the rows, and the coerced sample rate, Hz.
    seed, run
        Noise depends on both; ``run`` counts the starts, so that a second run is not a copy of the first.
    start
        The plant's sample count at the start.
    """

    def __init__(
        self,
        device: Device,
        inputs: Sequence[Input],
        rate: float,
        *,
        seed: int = 0,
        run: int = 0,
        faults: Faults | None = None,
        start: int = 0,
    ) -> None:
        self._faults = Faults() if faults is None else faults
        self._start = self._next = start
        self._rows = [_Row(device, wanted, rate, self._faults) for wanted in inputs]
        column = np.array([[row.noise, row.step, *row.codes, row.gain, row.offset] for row in self._rows]).T[..., None]
        noise, self._step, self._lowest, self._highest, self._gain, self._offset = column
        self._scaled = bool(np.any(self._gain != 1) or np.any(self._offset != 0))
        stream = zlib.crc32(repr((seed, run, [wanted.physical for wanted in inputs])).encode())
        self._noise = NoiseStream(stream, (*noise[:, 0].tolist(), *[1.0] * len(inputs)))

    def begin(self, sample: int) -> None:
        """The first sample to come is this one of the plant; needed where the plant moves while a task is set up."""
        self._start = self._next = sample

    @property
    def channels(self) -> int:
        """Number of rows ``digitise`` returns."""
        return len(self._rows)

    def digitise(self, truth: Mapping[str, Array]) -> Array:
        """Return what the device delivers (channels, n) for the plant's next n samples."""
        start, stop = self._next, self._next + truth["force"].size
        noise = self._noise.take(start - self._start, stop - self._start)
        channels = len(self._rows)
        volts = noise[:channels].copy()  # the converter's own; the rest is for the sensors
        for i, row in enumerate(self._rows):
            volts[i] += row.signal(truth, start, noise[channels + i])
        volts /= self._step
        np.rint(volts, out=volts)
        np.fmax(volts, self._lowest, out=volts)
        np.fmin(volts, self._highest, out=volts)
        volts *= self._step
        if self._scaled:
            volts *= self._gain
            volts += self._offset
        self._next = stop
        return volts


class _Row:
    """One input: its sensor, its wire and the settings of its converter."""

    def __init__(self, device: Device, wanted: Input, rate: float, faults: Faults) -> None:
        module = device.module(wanted.physical)
        half_span = module.range_for(*wanted.limits)
        self.noise = module.noise * half_span
        self.step = 2 * half_span * module.overrange / 2**module.bits
        self.codes = (-(2.0 ** (module.bits - 1)), 2.0 ** (module.bits - 1) - 1)
        self.gain, self.offset = wanted.gain, wanted.offset
        self._device, self._bridge, self._faults = device, wanted.bridge, faults
        self._sense = {"force": self._force, "pressure": self._pressure, "supply": self._supply}.get(
            device.wiring.get(wanted.physical, ""), self._open
        )
        self._delay = _Delay(module.filter_samples)
        self._staircase = _Staircase(rate, device.sensor.update_rate)

    def signal(self, truth: Mapping[str, Array], start: int, noise: Array) -> Array:
        """Return what arrives at the converter, V or mV/V."""
        return self._delay(self._sense(truth, start, noise))

    def _force(self, truth: Mapping[str, Array], start: int, noise: Array) -> Array:
        cell = self._device.cell
        force = self._changed("force", "over_range", start, truth["force"])
        signal = cell.output(force + cell.noise * self._louder("force", start, noise), self._bridge)
        for part, _ in self._during("force", "open_wire", start, force.size):
            signal[part] = np.inf
        return signal

    def _pressure(self, truth: Mapping[str, Array], start: int, noise: Array) -> Array:
        sensor, supply = self._device.sensor, self._true_supply(truth, start)
        signal = sensor.output(truth["pressure"], supply, self._louder("pressure", start, noise))
        for part, value in self._during("pressure", "clipped", start, noise.size):
            signal[part] = supply[part] * sensor.clip[0 if value < 0 else 1]
        for part, _ in self._during("pressure", "supply_lost", start, noise.size):
            signal[part] = 0.0
        signal = self._staircase(signal, start)
        for part, _ in self._during("pressure", "open_wire", start, noise.size):
            signal[part] = OPEN_INPUT
        return signal

    def _supply(self, truth: Mapping[str, Array], start: int, noise: Array) -> Array:
        supply = self._true_supply(truth, start)
        if faults := self._during("supply", "open_wire", start, noise.size):
            supply = supply.copy()
            for part, _ in faults:
                supply[part] = OPEN_INPUT
        return supply

    def _open(self, truth: Mapping[str, Array], start: int, noise: Array) -> Array:
        return np.full(noise.size, OPEN_INPUT)

    def _true_supply(self, truth: Mapping[str, Array], start: int) -> Array:
        supply = self._changed("supply", "sag", start, truth["supply"])
        if faults := self._during("supply", "lost", start, supply.size):
            supply = supply.copy()
            for part, _ in faults:
                supply[part] = 0.0
        return supply

    def _changed(self, device: str, kind: str, start: int, values: Array) -> Array:
        """Return the values, or those the fault script puts in their place."""
        if faults := self._during(device, kind, start, values.size):
            values = values.copy()
            for part, value in faults:
                values[part] = value
        return values

    def _louder(self, device: str, start: int, noise: Array) -> Array:
        if faults := self._during(device, "noise", start, noise.size):
            noise = noise.copy()
            for part, value in faults:
                noise[part] *= value
        return noise

    def _during(self, device: str, kind: str, start: int, samples: int) -> list[tuple[slice, float]]:
        if not self._faults.scheduled:
            return []
        spans = self._faults.during(device, kind, start, start + samples)
        return [(slice(first - start, last - start), fault.value) for first, last, fault in spans]


class _Delay:
    """Whole samples of delay; before the start the input stood at its first value."""

    def __init__(self, samples: int) -> None:
        self._samples = samples
        self._line: Array | None = None

    def __call__(self, signal: Array) -> Array:
        if not self._samples or not signal.size:
            return signal
        line = np.full(self._samples, signal[0]) if self._line is None else self._line
        joined = np.concatenate((line, signal))
        self._line = joined[signal.size :]
        return joined[: signal.size]


class _Staircase:
    """A sensor that renews its output more slowly than it is sampled repeats its last value."""

    def __init__(self, rate: float, update_rate: float) -> None:
        self._ratio = update_rate / rate
        self._last: float | None = None

    def __call__(self, signal: Array, start: int) -> Array:
        if self._ratio >= 1 or not signal.size:
            return signal
        update = np.floor(np.arange(start - 1, start + signal.size) * self._ratio)
        renewed = np.diff(update) > 0
        if self._last is None:
            renewed[0] = True
            self._last = 0.0
        # Position of the last renewal, -1 where it lies before this block.
        position = np.maximum.accumulate(np.where(renewed, np.arange(signal.size), -1))
        held = np.where(position >= 0, signal[position], self._last)
        self._last = float(held[-1])
        return held
