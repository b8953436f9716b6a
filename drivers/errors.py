"""Errors of the instruments: each names the device, what was seen, and what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class DeviceError(Exception):
    """Any failure of an instrument.

    Parameters
    ----------
    device
        The instrument as the operator knows it, e.g. ``"stage"``.
    message
        What happened, with values and units.
    remedy
        What the operator can do about it.
    """

    exit_code = 6

    def __init__(self, device: str, message: str, remedy: str = "") -> None:
        self.device = device
        self.message = message
        self.remedy = remedy
        super().__init__(f"{device}: {message}" + (f" Remedy: {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        """Keep the parts when the error crosses a process boundary."""
        return type(self), (self.device, self.message, self.remedy)


class NotConnected(DeviceError):
    """The port cannot be opened or the far end has closed it."""


@contextmanager
def opening(device: str, connection: str) -> Iterator[None]:
    """Turn what the opening of a port raises into ``NotConnected``."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise NotConnected(
            device,
            f"cannot open {connection}: {error}",
            "check cable, power and name of the port, and that no other program holds it",
        ) from error


class WrongDevice(DeviceError):
    """Something answers at the port, but it is not the instrument the bench names."""


class NoReply(DeviceError, TimeoutError):
    """The instrument did not answer in time."""


class BadReply(DeviceError):
    """The answer cannot be understood."""


class CommandRefused(DeviceError):
    """The instrument answered with an error code or text."""


class OutOfRange(DeviceError, ValueError):
    """A command would leave the range the instrument or the bench allows; nothing was sent."""


class MotionFault(DeviceError):
    """Stage or pump stopped by itself: motion error, limit switch, servo off, stall."""


class DataLost(DeviceError):
    """The DAQ dropped samples; the stream is no longer contiguous."""


class SensorFault(DeviceError):
    """A sensor reading cannot be true: open wire, supply lost, clipped."""
