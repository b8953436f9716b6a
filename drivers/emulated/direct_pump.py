"""The syringe pump without a wire: the driver's own port is a buffer in memory, at whose end the emulated pump sits.

A module of its own, so that a scene without pressure imports no pump.
"""

from __future__ import annotations

from typing import Any

from drivers.emulated.pump import EmulatedLegato
from drivers.emulated.server import Line, Unplugged
from drivers.interfaces import Clock
from drivers.pump import LegatoPump


class MemoryPort:
    """What ``drivers.pump`` needs of a serial port. Nothing is waited for: a reply is there at once or not at all."""

    def __init__(self, legato: EmulatedLegato) -> None:
        self._received = bytearray()
        try:
            self._session = legato.connect(Line(self._received.extend))
        except Unplugged as error:
            raise ConnectionError("the cable is out") from error

    def write(self, data: bytes) -> None:
        """Let the pump act on the bytes."""
        try:
            self._session.receive(data)
        except Unplugged as error:
            raise ConnectionError("the cable is out") from error

    @property
    def in_waiting(self) -> int:
        """How many bytes wait to be read."""
        return len(self._received)

    def read(self, size: int = 1) -> bytes:
        """Take as many bytes, or all there are."""
        taken = bytes(self._received[:size])
        del self._received[:size]
        return taken

    def read_until(self, expected: bytes = b"\n", size: int | None = None) -> bytes:
        """Take the bytes up to and with ``expected``, or all there are."""
        found = self._received.find(expected)
        stop = len(self._received) if found < 0 else found + len(expected)
        return self.read(stop if size is None else min(stop, size))

    def close(self) -> None:
        """Nothing to release."""


class DirectPump(LegatoPump):
    """The pump of an emulated bench; fits ``drivers.interfaces.Pump``.

    Parameters
    ----------
    legato
        The emulated pump.
    clock
        The bench's time base.
    syringe_diameter, force_percent
        As for ``drivers.pump.LegatoPump``.
    """

    def __init__(
        self, legato: EmulatedLegato, *, clock: Clock, syringe_diameter: float = 14.43e-3, force_percent: int = 50
    ) -> None:
        self._legato = legato
        super().__init__(
            "memory", syringe_diameter=syringe_diameter, force_percent=force_percent, settle=0.0, clock=clock
        )

    def _open(self, baud: int) -> Any:
        del baud
        return MemoryPort(self._legato)
