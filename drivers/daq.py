"""NI data acquisition on ``nidaqmx``: one continuous, hardware-timed task with the rig's channels.

The same code drives the installed NI-DAQmx runtime (``connection="local"``), NI's gRPC Device Server and the
emulated DAQ (``connection="grpc://host:port"``). Only ``drivers.errors`` leave it.
"""

from __future__ import annotations

import ipaddress
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, Literal
from urllib.parse import urlsplit

import numpy as np

from drivers.errors import BadReply, CommandRefused, DataLost, DeviceError, NoReply, NotConnected, WrongDevice
from drivers.interfaces import Identity, Volts

Terminal = Literal["default", "rse", "diff"]

NAMES = ("force", "pressure", "supply")

TIMED_OUT = -200284
SAMPLES_LOST = frozenset({-200279, -200222, -200613, -200361, -200010, -209829, -200019})
DEVICE_GONE = frozenset({-88709, -88710, -200045, -201003, -50405, -200088})
NO_SUCH_DEVICE = frozenset({-200170, -200220})
RESERVED = frozenset({-50103, -200022})

_SLOWEST_ANSWER = 5.0  # s; deadline of a call over gRPC that does not wait for samples
_FILTER_DELAYS: dict[str, Callable[[float], float]] = {
    # NI 9237 operating instructions: input delay of the delta-sigma filter.
    "NI 9237": lambda rate: (40 + 5 / 512) / rate + 4.5e-6,
}


@dataclass(frozen=True, slots=True)
class VoltageChannel:
    """An amplified signal, recorded in V.

    Attributes
    ----------
    name
        ``"force"``, ``"pressure"`` or ``"supply"``.
    physical
        The input as NI-DAQmx knows it, e.g. ``"Dev1/ai0"``.
    minimum, maximum
        Range asked for, V; the device takes its next wider one.
    terminal
        How the input is wired: referenced single-ended, differential, or the device's default.
    """

    name: str
    physical: str
    minimum: float = -10.0
    maximum: float = 10.0
    terminal: Terminal = "default"

    def __post_init__(self) -> None:
        _check_channel(self)
        if self.terminal not in ("default", "rse", "diff"):
            raise ValueError(f"channel {self.name!r}: terminal {self.terminal!r} is none of default, rse, diff")

    @property
    def unit(self) -> str:
        """Unit of the samples."""
        return "V"

    def add_to(self, task: Any) -> None:
        """Create the DAQmx virtual channel."""
        from nidaqmx.constants import TerminalConfiguration, VoltageUnits

        terminals = {
            "default": TerminalConfiguration.DEFAULT,
            "rse": TerminalConfiguration.RSE,
            "diff": TerminalConfiguration.DIFF,
        }
        task.ai_channels.add_ai_voltage_chan(
            self.physical,
            name_to_assign_to_channel=self.name,
            terminal_config=terminals[self.terminal],
            min_val=self.minimum,
            max_val=self.maximum,
            units=VoltageUnits.VOLTS,
        )


@dataclass(frozen=True, slots=True)
class BridgeChannel:
    """A load cell wired straight to a bridge module (NI 9237), recorded in mV/V.

    DAQmx's two-point force channel is given the identity (0 mV/V is 0, 1 mV/V is 1), so that the raw stream holds
    what the bridge put out and the calibration record alone decides about newtons.

    Attributes
    ----------
    minimum, maximum
        Range asked for, mV/V.
    excitation
        Internal bridge excitation, V. The NI 9237 delivers 150 mW in all: 5 V is the most for one 350 ohm cell.
    resistance
        Nominal bridge resistance, ohm.
    """

    name: str
    physical: str
    minimum: float = -25.0
    maximum: float = 25.0
    excitation: float = 5.0
    resistance: float = 350.0

    def __post_init__(self) -> None:
        _check_channel(self)
        if not self.excitation > 0 or not self.resistance > 0:
            raise ValueError(f"channel {self.name!r}: excitation (V) and resistance (ohm) must be positive")

    @property
    def unit(self) -> str:
        """Unit of the samples."""
        return "mV/V"

    def add_to(self, task: Any) -> None:
        """Create the DAQmx virtual channel; every argument is given, since DAQmx's defaults are pounds."""
        from nidaqmx.constants import (
            BridgeConfiguration,
            BridgeElectricalUnits,
            BridgePhysicalUnits,
            ExcitationSource,
            ForceUnits,
        )

        task.ai_channels.add_ai_force_bridge_two_point_lin_chan(
            self.physical,
            name_to_assign_to_channel=self.name,
            min_val=self.minimum,
            max_val=self.maximum,
            units=ForceUnits.NEWTONS,
            bridge_config=BridgeConfiguration.FULL_BRIDGE,
            voltage_excit_source=ExcitationSource.INTERNAL,
            voltage_excit_val=self.excitation,
            nominal_bridge_resistance=self.resistance,
            first_electrical_val=0.0,
            second_electrical_val=1.0,
            electrical_units=BridgeElectricalUnits.MILLIVOLTS_PER_VOLT,
            first_physical_val=0.0,
            second_physical_val=1.0,
            physical_units=BridgePhysicalUnits.NEWTONS,
            custom_scale_name="",
        )


Channel = VoltageChannel | BridgeChannel


class NIDaq:
    """The rig's channels on one DAQmx task.

    Parameters
    ----------
    channels
        Inputs in the order of the rows of ``read``.
    rate
        Sample rate asked for, Hz; ``rate`` afterwards tells what the device really uses.
    connection
        ``"local"`` for the installed NI-DAQmx runtime, ``"grpc://host:port"`` for a gRPC device server.
    buffer_seconds
        Host buffer: how long a reader may fall behind before samples are lost.
    expected_model
        Product type the bench names, e.g. ``"USB-6211"``; anything else is refused.
    patience
        Seconds a read may last beyond the time its samples need.
    allow_remote
        Whether a server on another machine may be used.
    allow_simulated
        Whether NI's simulated devices (a sine, no physics) are accepted.

    Raises
    ------
    NotConnected
        No runtime, no server, no such device, or another program holds it.
    WrongDevice
        The device is not the expected product, lacks a channel, or is simulated.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        *,
        rate: float,
        connection: str = "local",
        buffer_seconds: float = 10.0,
        expected_model: str | None = None,
        patience: float = 0.5,
        allow_remote: bool = False,
        allow_simulated: bool = False,
    ) -> None:
        self._channels = tuple(channels)
        _check_arguments(self._channels, rate, buffer_seconds, patience)
        self._patience = patience
        self._calls = _Calls()
        self._partial = np.empty((len(self._channels), 0))
        self._running = False
        self._contiguous = True
        self._resources = ExitStack()
        self._closed = False
        try:
            with _translated(connection):
                options = self._connect(connection, allow_remote)
                self._identity, models = _identify(self._channels, options, expected_model, allow_simulated)
                self._task = self._create_task(options, rate, buffer_seconds)
                self._rate = float(self._task.timing.samp_clk_rate)
        except BaseException:
            self._resources.close()
            raise
        if not math.isfinite(self._rate) or self._rate <= 0:
            self.close()
            raise BadReply("daq", f"the device reports a sample rate of {self._rate} Hz.")
        self._delays = {name: _FILTER_DELAYS.get(model, _no_delay)(self._rate) for name, model in models.items()}

    @property
    def identity(self) -> Identity:
        """Product, serial and driver version."""
        return self._identity

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the rows of ``read``."""
        return tuple(channel.name for channel in self._channels)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the rows of ``read``: V, or mV/V for a bridge channel."""
        return tuple(channel.unit for channel in self._channels)

    @property
    def rate(self) -> float:
        """The sample rate the device really uses, Hz."""
        return self._rate

    @property
    def delays(self) -> dict[str, float]:
        """By how much each channel lags behind the true signal, s (the delta-sigma filter of a bridge module)."""
        return dict(self._delays)

    def start(self) -> None:
        """Start the sample clock; sample 0 is the first one after this call."""
        self._check_open()
        with _translated():
            self._task.start()
        self._running = self._contiguous = True
        self._partial = self._partial[:, :0]

    def read(self, samples: int) -> Volts:
        """Block until ``samples`` are there; return a fresh C-contiguous array (channels, samples).

        Samples that came before a time-out are kept for the next read; after any other failure the stream has a gap,
        and reading goes on only after ``stop`` and ``start``.

        Raises
        ------
        NoReply
            The samples did not come in time; the message tells how many did.
        DataLost
            The device's or the host's buffer overflowed, or an earlier read failed; stop and start again.
        NotConnected
            The device, the server or the runtime is gone.
        BadReply
            The answer cannot be understood.
        """
        self._check_open()
        if not self._running:
            raise CommandRefused("daq", "the sample clock is not running.", "start the DAQ first.")
        if not self._contiguous:
            raise DataLost("daq", "an earlier read failed, and its samples with it.", "stop and start the DAQ again.")
        data = np.full((len(self._channels), samples), np.nan)
        kept = min(self._partial.shape[1], samples)
        if not kept:
            self._fill(data)
            return data
        data[:, :kept] = self._partial[:, :kept]
        if kept < samples:
            missing = np.full((len(self._channels), samples - kept), np.nan)
            self._fill(missing)
            data[:, kept:] = missing
        self._partial = self._partial[:, kept:]
        return data

    def stop(self) -> None:
        """Stop the sample clock; does nothing when it is stopped."""
        if self._closed or not self._running:
            return
        self._running = False
        with _translated():
            self._task.stop()

    def close(self) -> None:
        """Release the task; the second call does nothing, and a device that is gone has nothing left to release."""
        if self._closed:
            return
        self._closed = True
        self._running = False
        with _nothing_left_to_release(), _translated():
            self._resources.close()

    def __enter__(self) -> NIDaq:
        return self

    def __exit__(self, *failure: object) -> None:
        self.close()

    def _check_open(self) -> None:
        if self._closed:
            raise NotConnected("daq", "the task has been closed.", "open the DAQ again.")

    def _connect(self, connection: str, allow_remote: bool) -> Any:
        """Return nidaqmx's ``grpc_options``; ``None`` is the local runtime."""
        if connection == "local":
            return None
        target = _target(connection, allow_remote)
        try:
            import grpc
            from nidaqmx import GrpcSessionOptions
        except ModuleNotFoundError as error:
            raise NotConnected("daq", f"{error}.", "pip install 'nidaqmx[grpc]'.") from error
        channel = grpc.insecure_channel(target, options=_GRPC_OPTIONS)
        self._resources.callback(channel.close)
        return GrpcSessionOptions(_Bounded(channel, self._calls), "")

    def _create_task(self, options: Any, rate: float, buffer_seconds: float) -> Any:
        import nidaqmx
        from nidaqmx.constants import AcquisitionType

        task = nidaqmx.Task(grpc_options=options)
        self._resources.callback(task.close)
        for channel in self._channels:
            channel.add_to(task)
        samples = math.ceil(rate * buffer_seconds)
        task.timing.cfg_samp_clk_timing(rate, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=samples)
        task.in_stream.input_buf_size = math.ceil(task.timing.samp_clk_rate * buffer_seconds)
        from nidaqmx.stream_readers import AnalogMultiChannelReader

        self._reader = AnalogMultiChannelReader(task.in_stream)
        self._reader.verify_array_shape = False  # one more call per read, and the array is our own
        return task

    def _fill(self, data: Volts) -> None:
        """Read ``data.shape[1]`` samples; what came of an incomplete read is kept."""
        samples = data.shape[1]
        timeout = samples / self._rate + self._patience
        self._calls.deadline = timeout + _SLOWEST_ANSWER
        self._contiguous = False
        with _translated():
            count = self._read_or_keep(data, timeout)
        if count != samples or not np.isfinite(data).all():
            raise BadReply("daq", f"asked for {samples} samples per channel, {count} came, not all of them numbers.")
        self._contiguous = True

    def _read_or_keep(self, data: Volts, timeout: float) -> int:
        from nidaqmx.errors import DaqReadError

        try:
            return int(self._reader.read_many_sample(data, data.shape[1], timeout))
        except DaqReadError as error:
            if error.error_code != TIMED_OUT:
                raise
            count = error.samps_per_chan_read
            came = data[:, : max(count, 0)]
            if not np.isfinite(came).all():
                raise BadReply("daq", f"the device says {count} samples came, but some are not numbers.") from error
            self._partial = np.concatenate((self._partial, came), axis=1)
            self._contiguous = True
            raise NoReply(
                "daq",
                f"{count} of {data.shape[1]} samples came within {timeout:.2f} s.",
                "check the USB cable and the device's power; is another program loading this computer?",
            ) from error


_GRPC_OPTIONS = (
    ("grpc.max_receive_message_length", -1),
    ("grpc.enable_http_proxy", 0),
    ("grpc.use_local_subchannel_pool", 1),
)


class _Calls:
    """The deadline of the calls on one channel, s."""

    deadline = _SLOWEST_ANSWER


class _Bounded:
    """A gRPC channel whose calls all end: nidaqmx sets no deadline, so a hung server would hang the rig."""

    def __init__(self, channel: Any, calls: _Calls) -> None:
        self._channel = channel
        self._calls = calls

    def unary_unary(self, *arguments: Any, **options: Any) -> Callable[..., Any]:
        """Like ``grpc.Channel.unary_unary``."""
        call = self._channel.unary_unary(*arguments, **options)
        calls = self._calls
        return lambda request, metadata=None: call(request, timeout=calls.deadline, metadata=metadata)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._channel, name)


def _target(connection: str, allow_remote: bool) -> str:
    try:
        parts = urlsplit(connection)
        scheme, host, port = parts.scheme, parts.hostname, parts.port
    except ValueError:
        scheme, host, port = "", None, None
    if scheme != "grpc" or not host or not port:
        raise NotConnected("daq", f"connection {connection!r} is not understood.", 'use "local" or "grpc://host:port".')
    if not allow_remote and not _is_loopback(host):
        raise NotConnected(
            "daq",
            f"{host} is not this computer; anyone on the network could read and drive the rig's DAQ.",
            "use a loopback address, or allow remote instruments in the bench.",
        )
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _identify(
    channels: Sequence[Channel], options: Any, expected_model: str | None, allow_simulated: bool
) -> tuple[Identity, dict[str, str]]:
    """Ask every device what it is and whether it has the inputs; return the first one and each channel's product."""
    from nidaqmx.system import System

    system = System.remote(options) if options else System.local()
    present = list(system.devices.device_names)
    models: dict[str, str] = {}
    for channel in channels:
        name = channel.physical.split("/")[0]
        if name not in present:
            raise NotConnected(
                "daq",
                f"there is no device {name!r} (channel {channel.name!r}); present: {', '.join(present) or 'none'}.",
                "plug it in, or correct the physical channel in the bench.",
            )
        device = system.devices[name]
        models[channel.name] = device.product_type
        _check_inputs(channel, list(device.ai_physical_chans.channel_names), device.product_type)
        if device.is_simulated and not allow_simulated:
            raise WrongDevice(
                "daq",
                f"{name} is an NI simulated device: it would show a sine, not the load cell.",
                "use the real one.",
            )
    first = system.devices[channels[0].physical.split("/")[0]]
    if expected_model is not None and expected_model not in models.values():
        raise WrongDevice(
            "daq",
            f"the bench names {expected_model!r}, {first.name} is {first.product_type!r}.",
            "correct the model in the bench or the device's name in NI MAX.",
        )
    version = ".".join(str(part) for part in system.driver_version)
    identity = Identity("National Instruments", first.product_type, f"{first.serial_num:08X}", f"NI-DAQmx {version}")
    return identity, models


def _check_inputs(channel: Channel, inputs: list[str], product: str) -> None:
    if channel.physical not in inputs:
        raise WrongDevice(
            "daq",
            f"{product} has no analog input {channel.physical!r} (channel {channel.name!r}); it has {inputs}.",
            "correct the physical channel in the bench.",
        )


def _no_delay(_rate: float) -> float:
    return 0.0


def _check_channel(channel: Channel) -> None:
    if channel.name not in NAMES:
        raise ValueError(f"channel {channel.name!r} is none of {', '.join(NAMES)}")
    if "/" not in channel.physical:
        raise ValueError(f"channel {channel.name!r}: {channel.physical!r} is not of the form 'Dev1/ai0'")
    if not channel.minimum < channel.maximum:
        raise ValueError(f"channel {channel.name!r}: minimum {channel.minimum} is not below maximum {channel.maximum}")


def _check_arguments(channels: Sequence[Channel], rate: float, buffer_seconds: float, patience: float) -> None:
    names = [channel.name for channel in channels]
    if not names or len(set(names)) != len(names):
        raise ValueError(f"the DAQ needs at least one channel and each name once, not {names}")
    for name, value in (("rate", rate), ("buffer_seconds", buffer_seconds), ("patience", patience)):
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be a positive number, not {value}")


@contextmanager
def _nothing_left_to_release() -> Iterator[None]:
    """A task on a device that is gone went with it."""
    try:
        yield
    except NotConnected:
        return


@contextmanager
def _translated(connection: str = "") -> Iterator[None]:
    """Turn whatever nidaqmx raises into the rig's errors."""
    from nidaqmx.errors import DaqError, DaqNotFoundError, Error, RpcError

    try:
        yield
    except DeviceError:
        raise
    except DaqError as error:
        raise _daqmx_error(error.error_code, str(error)) from error
    except RpcError as error:
        raise _rpc_error(error, connection) from error
    except DaqNotFoundError as error:
        raise NotConnected(
            "daq",
            "the NI-DAQmx runtime is not installed on this computer.",
            "install NI-DAQmx (ni.com/downloads), or leave the bench out to use the emulated one.",
        ) from error
    except Error as error:
        raise NotConnected("daq", f"{error}", "install a current NI-DAQmx runtime (ni.com/downloads).") from error
    except (ValueError, TypeError, LookupError, AssertionError, ArithmeticError) as error:
        raise BadReply(
            "daq", f"nidaqmx could not make sense of an answer ({type(error).__name__}: {error})."
        ) from error


def _daqmx_error(code: int, text: str) -> DeviceError:
    message = f"NI-DAQmx error {code}: {' '.join(text.split())}"
    if code == TIMED_OUT:
        return NoReply("daq", message, "check the USB cable and the device's power.")
    if code in SAMPLES_LOST:
        return DataLost("daq", message, "start again; read more often or enlarge buffer_seconds if it recurs.")
    if code in DEVICE_GONE:
        return NotConnected("daq", message, "check the USB cable and the device's power, then open the DAQ again.")
    if code in NO_SUCH_DEVICE:
        return NotConnected("daq", message, "correct the physical channels in the bench.")
    if code in RESERVED:
        return NotConnected("daq", message, "close the other program that uses this device.")
    return CommandRefused("daq", message, "check the channels' ranges and the rate in the bench.")


def _rpc_error(error: Any, connection: str) -> DeviceError:
    import grpc

    where = f" at {connection}" if connection else ""
    message = f"gRPC server{where}: {' '.join(str(error).split())}"
    code = error.rpc_code
    if code in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED):
        return NotConnected("daq", message, "start the server (`rig emulate` or NI gRPC Device Server).")
    if code == grpc.StatusCode.DEADLINE_EXCEEDED:
        return NoReply("daq", message, "restart the server.")
    if code in (grpc.StatusCode.INTERNAL, grpc.StatusCode.UNKNOWN, grpc.StatusCode.DATA_LOSS):
        return BadReply("daq", message, "restart the server.")
    return CommandRefused("daq", message, "use a current NI gRPC Device Server.")
