"""The one way out of every run: stop the stage, stop the pump, stop the DAQ. Each action is guarded by itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from drivers.errors import DeviceError

if TYPE_CHECKING:
    from drivers.interfaces import Daq, Pump, Stage


def make_safe(stage: Stage | None, pump: Pump | None, daq: Daq | None) -> list[str]:
    """Stop everything; return what failed, in words. A device that cannot be stopped keeps no other one moving."""
    failures: list[str] = []
    if stage is not None and not _guarded("stopping the stage", stage.stop, failures):
        _guarded("emergency stop of the stage", stage.emergency_stop, failures)
    if pump is not None:
        _guarded("stopping the pump", pump.stop, failures)
    if daq is not None:
        _guarded("stopping the DAQ", daq.stop, failures)
    return failures


def release(stage: Stage | None, pump: Pump | None, daq: Daq | None) -> list[str]:
    """Close every port; return what failed, in words."""
    failures: list[str] = []
    for name, device in (("stage", stage), ("pump", pump), ("DAQ", daq)):
        if device is not None:
            _guarded(f"closing the {name}", device.close, failures)
    return failures


def _guarded(what: str, action: Callable[[], None], failures: list[str]) -> bool:
    try:
        action()
    except Exception as error:  # noqa: BLE001 - whatever a driver raises, the next device must be stopped too
        reason = error.message if isinstance(error, DeviceError) else repr(error)
        failures.append(f"{what} failed: {reason.rstrip('.')}")
        return False
    return True
