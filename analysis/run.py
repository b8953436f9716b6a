"""One run as the analysis sees it: arrays on the DAQ's time grid, the step table and what is known of the sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from model.parameters import Parameters

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the sequence: samples ``start`` (inclusive) to ``stop`` (exclusive), and how it ended."""

    name: str
    start: int
    stop: int
    outcome: str = "done"


@dataclass(frozen=True, slots=True)
class Sensors:
    """Standard uncertainties (1 sigma) of the calibration chain; noise and drift are measured from the data.

    Attributes
    ----------
    force_gain, pressure_gain
        Relative standard uncertainty of the sensitivity.
    force_linearity, pressure_offset
        Standard uncertainty in N and Pa.
    force_capacity
        Of the load cell, N; 0: not known. What its calibration line is out by grows with the load from zero; nine
        tenths of it are there at one per cent of the capacity, about the smallest weight of a calibration.
    position
        Standard uncertainty of the stage's position scale, relative.
    pump_volume
        Standard uncertainty of the volume the pump displaces (syringe diameter), relative.
    compliance, compliance_uncertainty
        C of load cell, fixture and frame, m/N. A compressed load train lets the gripper stay behind the stage:
        true separation = height + F C (height rises away from the sample, F is positive in compression).
    creep, creep_uncertainty, creep_time
        Share of a compression that the load train loses to the reading little by little, its standard uncertainty,
        and the time constant, s. A time of zero: never measured, each run is searched for it (``analysis.creep``).
    """

    force_gain: float = 0.0
    force_linearity: float = 0.0
    force_capacity: float = 0.0
    pressure_gain: float = 0.0
    pressure_offset: float = 0.0
    position: float = 0.0
    compliance: float = 0.0
    compliance_uncertainty: float = 0.0
    pump_volume: float = 0.0
    creep: float = 0.0
    creep_uncertainty: float = 0.0
    creep_time: float = 0.0


@dataclass(frozen=True)
class Run:
    """A recorded run.

    Attributes
    ----------
    name
        Name of the recording.
    protocol
        ``"pull_off"``, ``"indentation"``, ...
    rate
        Sample rate, Hz; sample i was taken at i / rate.
    force
        (n,), N, untared, compression positive.
    pressure
        (n,), Pa gauge, or ``None``.
    height
        (n,), m, stage position interpolated onto the samples, rising away from the sample.
    steps
        In order. Names: reference, tare, approach, preload, dwell, pressurize, retract, pull-off, return.
    parameters
        The scene's parameters (nominal, as the overlay uses them), or ``None`` where the scene has no model.
    settings
        Scene values the analysis may need, e.g. ``preload_N``, ``indenter_radius_mm``; keys as in the scene file.
    complete
        Whether the sequence reached its end.
    pump_volume
        (n,), m^3, net volume the pump has displaced into the chamber, or ``None``.
    emulated
        Whether the instruments were: no experiment. Every picture says so.
    """

    name: str
    protocol: str
    rate: float
    force: Array
    pressure: Array | None
    height: Array
    steps: tuple[Step, ...]
    parameters: Parameters | None = None
    sensors: Sensors = field(default_factory=Sensors)
    settings: Mapping[str, float | str] = field(default_factory=dict)
    complete: bool = True
    pump_volume: Array | None = None
    emulated: bool = False

    @property
    def time(self) -> Array:
        """Sample times, s."""
        return np.arange(self.force.size) / self.rate

    def step(self, name: str) -> Step | None:
        """Return the last step of this name, or ``None``."""
        return next((step for step in reversed(self.steps) if step.name == name), None)
