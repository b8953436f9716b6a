"""What NI-DAQmx, its Python package and gRPC raise, in the rig's own errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from drivers.errors import BadReply, CommandRefused, DataLost, DeviceError, NoReply, NotConnected

TIMED_OUT = -200284
SAMPLES_LOST = frozenset({-200279, -200222, -200613, -200361, -200010, -209829, -200019})
DEVICE_GONE = frozenset({-88709, -88710, -200045, -201003, -50405, -200088})
NO_SUCH_DEVICE = frozenset({-200170, -200220})
RESERVED = frozenset({-50103, -200022})


@contextmanager
def translated(connection: str = "") -> Iterator[None]:
    """Turn whatever nidaqmx raises into the rig's errors."""
    from nidaqmx.errors import DaqError, DaqNotFoundError, DaqWarning, Error, RpcError

    try:
        yield
    except DeviceError:
        raise
    except DaqError as error:
        raise daqmx_error(error.error_code, str(error)) from error
    except RpcError as error:
        raise rpc_error(error, connection) from error
    except DaqNotFoundError as error:
        raise NotConnected(
            "daq",
            "the NI-DAQmx runtime is not installed on this computer.",
            "install NI-DAQmx (ni.com/downloads), or leave the bench out to use the emulated one.",
        ) from error
    except Error as error:
        raise NotConnected("daq", f"{error}", "install a current NI-DAQmx runtime (ni.com/downloads).") from error
    except (
        ValueError,
        TypeError,
        LookupError,
        AssertionError,
        ArithmeticError,
        UnboundLocalError,
        DaqWarning,
    ) as error:
        # A warning is raised only where warnings are made errors.
        # UnboundLocalError: nidaqmx 1.7.0 has no answer to a failed call whose error code is 0 or a warning's.
        raise BadReply(
            "daq", f"nidaqmx could not make sense of an answer ({type(error).__name__}: {error})."
        ) from error


def daqmx_error(code: int, text: str) -> DeviceError:
    """Return the rig's error for a DAQmx error code."""
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


def rpc_error(error: Any, connection: str) -> DeviceError:
    """Return the rig's error for a failed call to a gRPC server."""
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
