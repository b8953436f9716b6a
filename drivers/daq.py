"""NI data acquisition on ``nidaqmx``: one continuous, hardware-timed task with the rig's channels.

The same code drives the installed NI-DAQmx runtime (``connection="local"``), NI's gRPC Device Server and the
emulated DAQ (``connection="grpc://host:port"``). Only ``drivers.errors`` leave it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np

from drivers.daq_channels import BridgeChannel, Channel, VoltageChannel, signal_channel
from drivers.daq_connection import SLOWEST_ANSWER, Deadline, connect
from drivers.daq_errors import TIMED_OUT, translated
from drivers.errors import BadReply, CommandRefused, DataLost, NoReply, NotConnected, WrongDevice
from drivers.interfaces import Identity, Volts

__all__ = ["BridgeChannel", "Channel", "NIDaq", "VoltageChannel", "signal_channel"]


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
        self._deadline = Deadline()
        self._partial = np.empty((len(self._channels), 0))
        self._running = False
        self._contiguous = True
        self._resources = ExitStack()
        self._closed = False
        try:
            with translated(connection):
                options = connect(connection, allow_remote, self._deadline, self._resources)
                self._identity = _identify(self._channels, options, expected_model, allow_simulated)
                self._task = self._create_task(options, rate, buffer_seconds)
                self._rate = float(self._task.timing.samp_clk_rate)
            if not (math.isfinite(self._rate) and self._rate > 0):
                raise BadReply("daq", f"the device reports a sample rate of {self._rate} Hz.")
        except BaseException:
            self.close()
            raise

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

    def start(self) -> None:
        """Start the sample clock; sample 0 is the first one after this call."""
        self._check_open()
        with translated():
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
        with translated():
            self._task.stop()

    def close(self) -> None:
        """Release the task; the second call does nothing, and a device that is gone has nothing left to release."""
        if self._closed:
            return
        self._closed = True
        self._running = False
        with _nothing_left_to_release(), translated():
            self._resources.close()

    def __enter__(self) -> NIDaq:
        return self

    def __exit__(self, *failure: object) -> None:
        self.close()

    def _check_open(self) -> None:
        if self._closed:
            raise NotConnected("daq", "the task has been closed.", "open the DAQ again.")

    def _create_task(self, options: Any, rate: float, buffer_seconds: float) -> Any:
        import nidaqmx
        from nidaqmx.constants import AcquisitionType
        from nidaqmx.stream_readers import AnalogMultiChannelReader

        task = nidaqmx.Task(grpc_options=options)
        self._resources.callback(task.close)
        for channel in self._channels:
            channel.add_to(task)
        samples = math.ceil(rate * buffer_seconds)
        task.timing.cfg_samp_clk_timing(rate, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=samples)
        task.in_stream.input_buf_size = math.ceil(task.timing.samp_clk_rate * buffer_seconds)
        self._reader = AnalogMultiChannelReader(task.in_stream)
        self._reader.verify_array_shape = False  # one more call per read, and the array is our own
        return task

    def _fill(self, data: Volts) -> None:
        """Read ``data.shape[1]`` samples; what came of an incomplete read is kept."""
        samples = data.shape[1]
        timeout = samples / self._rate + self._patience
        self._deadline.seconds = timeout + SLOWEST_ANSWER
        self._contiguous = False
        with translated():
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


def _identify(channels: Sequence[Channel], options: Any, expected_model: str | None, allow_simulated: bool) -> Identity:
    """Ask every device what it is and whether it has the inputs; return the first one."""
    from nidaqmx.system import System

    system = System.remote(options) if options else System.local()
    present = list(system.devices.device_names)
    models: set[str] = set()
    for channel in channels:
        name = channel.physical.split("/")[0]
        if name not in present:
            raise NotConnected(
                "daq",
                f"there is no device {name!r} (channel {channel.name!r}); present: {', '.join(present) or 'none'}.",
                "plug it in, or correct the physical channel in the bench.",
            )
        device = system.devices[name]
        models.add(device.product_type)
        _check_inputs(channel, list(device.ai_physical_chans.channel_names), device.product_type)
        if device.is_simulated and not allow_simulated:
            raise WrongDevice(
                "daq",
                f"{name} is an NI simulated device: it would show a sine, not the load cell.",
                "use the real one.",
            )
    first = system.devices[channels[0].physical.split("/")[0]]
    if expected_model is not None and expected_model not in models:
        raise WrongDevice(
            "daq",
            f"the bench names {expected_model!r}, {first.name} is {first.product_type!r}.",
            "correct the model in the bench or the device's name in NI MAX.",
        )
    version = ".".join(str(part) for part in system.driver_version)
    return Identity("National Instruments", first.product_type, f"{first.serial_num:08X}", f"NI-DAQmx {version}")


def _check_inputs(channel: Channel, inputs: list[str], product: str) -> None:
    if channel.physical not in inputs:
        raise WrongDevice(
            "daq",
            f"{product} has no analog input {channel.physical!r} (channel {channel.name!r}); it has {inputs}.",
            "correct the physical channel in the bench.",
        )


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
