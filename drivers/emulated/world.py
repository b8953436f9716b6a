"""What the wire-level emulators see of the plant: one axis, one syringe, one block of samples.

The emulated controller decides what is commanded (limits, servo, errors); the plant decides what happens.
Every quantity is evaluated at the plant's present time, which only ``World.advance`` moves.
"""

from __future__ import annotations

import threading
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.emulated.faults import Faults


class Axis(Protocol):
    """The carriage of the stage. Positions in m in the controller's own direction."""

    @property
    def position(self) -> float:
        """True position now, m."""
        ...

    @property
    def commanded(self) -> float:
        """Where the trajectory generator stands now, m."""
        ...

    @property
    def target(self) -> float:
        """Where the present or last move ends, m."""
        ...

    @property
    def velocity(self) -> float:
        """Commanded velocity now, m/s."""
        ...

    @property
    def moving(self) -> bool:
        """Whether the trajectory is still running."""
        ...

    def move(self, target: float, speed: float, acceleration: float, deceleration: float) -> None:
        """Start a trapezoidal move, or redirect a running one without a jump in velocity."""
        ...

    def halt(self, deceleration: float) -> None:
        """Brake with the given deceleration (m/s^2); infinite stops dead."""
        ...


class Syringe(Protocol):
    """The pump's plunger. Volumes in m^3, positive into the chamber."""

    @property
    def volume(self) -> float:
        """Net volume displaced since the start, m^3."""
        ...

    @property
    def rate(self) -> float:
        """Present rate, m^3/s, signed; zero when still."""
        ...

    @property
    def force_on_plunger(self) -> float:
        """Force the gas puts on the plunger, N; with the pump's force setting it decides a stall."""
        ...

    def run(self, rate: float, target_volume: float | None) -> None:
        """Run at a signed rate until so much more has been displaced (a magnitude, m^3), or without end."""
        ...

    def stop(self) -> None:
        """Stop at once."""
        ...

    def set_diameter(self, diameter: float) -> None:
        """The diameter the pump was told, m; the plant knows the true one, and volumes scale accordingly."""
        ...


class World(Protocol):
    """The plant behind all emulators. Hold ``lock`` while reading several of its quantities."""

    lock: threading.RLock
    faults: Faults
    axis: Axis
    syringe: Syringe

    @property
    def time(self) -> float:
        """Plant time, s."""
        ...

    @property
    def sample(self) -> int:
        """Number of samples produced so far."""
        ...

    def advance(self, samples: int, rate: float) -> dict[str, NDArray[np.float64]]:
        """Move time on by ``samples / rate`` and return what the sensors put out at each sample instant.

        Returns
        -------
        dict
            ``force``: N at the load cell, compression positive, before its electronics;
            ``pressure``: Pa gauge at the sensor; ``supply``: V of the sensor's supply.
            Noise, gain, quantisation and clipping belong to the emulated DAQ and its channels.
        """
        ...
