"""What the rig asks of a stage, a pump and a DAQ, whoever made them.

SI units everywhere. The real drivers (``stage``, ``pump``, ``daq``), the direct back end and replay all fit these
protocols; sequences and the control loop know nothing else of an instrument.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Clock = Callable[[], float]
"""Seconds on the bench's one time base: ``time.perf_counter`` on hardware, the plant's time when it is virtual."""

Volts = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Identity:
    """What an instrument says of itself when it is asked."""

    maker: str
    model: str
    serial: str
    firmware: str


@dataclass(frozen=True, slots=True)
class StageStatus:
    """One poll of the stage.

    Attributes
    ----------
    sent, received
        Bench time just before the question and just after the answer, s.
    position
        m, rising away from the sample.
    error
        The controller's error code, read only when its error flag is up; 0 is no error.
    """

    sent: float
    received: float
    position: float
    moving: bool
    on_target: bool
    servo_on: bool
    negative_limit: bool
    positive_limit: bool
    error: int = 0


class PumpState(StrEnum):
    """What the pump's prompt says."""

    IDLE = "idle"
    INFUSING = "infusing"
    WITHDRAWING = "withdrawing"
    STALLED = "stalled"
    TARGET_REACHED = "target reached"
    AT_LIMIT = "at its travel limit"


@dataclass(frozen=True, slots=True)
class PumpStatus:
    """One poll of the pump: bench times (s), state, rate (m^3/s) and net volume infused since connection (m^3)."""

    sent: float
    received: float
    state: PumpState
    rate: float
    volume: float


class Stage(Protocol):
    """One linear axis. Positions in m, rising away from the sample."""

    @property
    def identity(self) -> Identity:
        """What the controller said on connection."""
        ...

    @property
    def travel(self) -> tuple[float, float]:
        """Lowest and highest allowed position, m: the controller's limits and the bench's, whichever is narrower."""
        ...

    @property
    def referenced(self) -> bool:
        """Whether the axis knows its absolute position (asked of the controller on every call)."""
        ...

    def reference(self) -> None:
        """Start the reference move: it may run the full travel. Only ever on the operator's explicit word."""
        ...

    def servo(self, on: bool) -> None:
        """Switch the servo."""
        ...

    def status(self) -> StageStatus:
        """Poll position and state."""
        ...

    def set_speed(self, speed: float) -> None:
        """Set the closed-loop speed, m/s."""
        ...

    def move_to(self, position: float) -> None:
        """Start or redirect a move; returns at once.

        ``OutOfRange`` if the target leaves ``travel``, unless the axis was polled further outside: it may come back.
        """
        ...

    def stop(self) -> None:
        """Halt with the controller's deceleration and clear the 'stopped' error it leaves."""
        ...

    def emergency_stop(self) -> None:
        """Write the stop byte past every lock and queue. May be called from any thread, at any time."""
        ...

    def close(self) -> None:
        """Release the port; no motion is commanded."""
        ...


class Pump(Protocol):
    """One syringe pump. Positive volumes are infused into the chamber."""

    @property
    def identity(self) -> Identity:
        """What the pump said on connection."""
        ...

    @property
    def rate_limits(self) -> tuple[float, float]:
        """Slowest and fastest rate for the syringe set, m^3/s."""
        ...

    def status(self) -> PumpStatus:
        """Poll state, rate and delivered volume."""
        ...

    def dispense(self, volume: float, rate: float) -> None:
        """Start to infuse (volume > 0) or withdraw (< 0) at ``rate`` (m^3/s, > 0); ``volume`` is the pump's target.

        The target lives in the pump, so that it stops by itself if this program dies.
        """
        ...

    def stop(self) -> None:
        """Stop at once. May be called from any thread."""
        ...

    def close(self) -> None:
        """Release the port; the pump is left stopped as it is."""
        ...


class Daq(Protocol):
    """Continuous, hardware-timed acquisition of named channels."""

    @property
    def identity(self) -> Identity:
        """Product, device name and serial."""
        ...

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the rows of ``read``: ``force`` and, if asked for, ``pressure`` and ``supply``."""
        ...

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the rows of ``read``: V, or mV/V from a bridge."""
        ...

    @property
    def rate(self) -> float:
        """The sample rate the device really uses, Hz."""
        ...

    def start(self) -> None:
        """Start the sample clock; sample 0 is the first one after this call."""
        ...

    def read(self, samples: int) -> Volts:
        """Block until ``samples`` are there; return a fresh C-contiguous array (channels, samples) of volts.

        Raises
        ------
        NoReply
            The samples did not come in time.
        DataLost
            The buffer was overwritten; samples are missing.
        NotConnected
            The device is gone.
        """
        ...

    def stop(self) -> None:
        """Stop the sample clock."""
        ...

    def close(self) -> None:
        """Release the task."""
        ...
