"""Stage and pump with every command written to the log, so that a replay can be held against it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from drivers.errors import MotionFault
from drivers.interfaces import Identity, Pump, PumpStatus, Stage, StageStatus

Log = Callable[[str], None]


def _nothing() -> None:
    """Allow every motion."""


class CommandedStage:
    """A ``Stage`` that logs its commands.

    Parameters
    ----------
    insist
        Raises where nothing may be set in motion any more: an emergency stop may come between any two commands, and
        the stop with which a step ends would acknowledge it to the driver.
    """

    def __init__(self, stage: Stage, log: Log, insist: Callable[[], None] = _nothing) -> None:
        self._stage = stage
        self._log = log
        self._insist = insist

    @property
    def identity(self) -> Identity:
        """See ``Stage``."""
        return self._stage.identity

    @property
    def travel(self) -> tuple[float, float]:
        """See ``Stage``."""
        return self._stage.travel

    @property
    def referenced(self) -> bool:
        """See ``Stage``."""
        return self._stage.referenced

    def reference(self) -> None:
        """See ``Stage``."""
        self._log("stage: reference")
        with self._permitted():
            self._stage.reference()

    def servo(self, on: bool) -> None:
        """See ``Stage``."""
        self._log(f"stage: servo {'on' if on else 'off'}")
        self._stage.servo(on)

    def status(self) -> StageStatus:
        """See ``Stage``."""
        return self._stage.status()

    def set_speed(self, speed: float) -> None:
        """See ``Stage``."""
        self._log(f"stage: speed {speed * 1e6:.6g} um/s")
        with self._permitted():
            self._stage.set_speed(speed)

    def move_to(self, position: float) -> None:
        """See ``Stage``."""
        self._log(f"stage: move to {position * 1e3:.6f} mm")
        with self._permitted():
            self._stage.move_to(position)

    def stop(self) -> None:
        """See ``Stage``."""
        self._log("stage: stop")
        self._stage.stop()

    def emergency_stop(self) -> None:
        """See ``Stage``."""
        self._stage.emergency_stop()  # logged by the loop: this may run in any thread

    def close(self) -> None:
        """See ``Stage``."""
        self._stage.close()

    @contextmanager
    def _permitted(self) -> Iterator[None]:
        self._insist()
        try:
            yield
        except MotionFault:
            self._insist()  # it may be the emergency stop that the driver names
            raise


class CommandedPump:
    """A ``Pump`` that logs its commands; ``insist`` as for ``CommandedStage``."""

    def __init__(self, pump: Pump, log: Log, insist: Callable[[], None] = _nothing) -> None:
        self._pump = pump
        self._log = log
        self._insist = insist

    @property
    def identity(self) -> Identity:
        """See ``Pump``."""
        return self._pump.identity

    @property
    def rate_limits(self) -> tuple[float, float]:
        """See ``Pump``."""
        return self._pump.rate_limits

    def status(self) -> PumpStatus:
        """See ``Pump``."""
        return self._pump.status()

    def dispense(self, volume: float, rate: float) -> None:
        """See ``Pump``."""
        self._log(f"pump: dispense {volume * 1e6:+.6f} ml at {rate * 6e7:.6g} ml/min")
        self._insist()
        self._pump.dispense(volume, rate)

    def stop(self) -> None:
        """See ``Pump``."""
        self._log("pump: stop")
        self._pump.stop()

    def close(self) -> None:
        """See ``Pump``."""
        self._pump.close()
