"""Live prediction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value and the ends of its 90 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class LivePrediction:
    """What the model says of the rest of a test, from the frames so far. SI units, compression positive.

    Attributes
    ----------
    frame, sample
        Number of the last frame it used, and the index one past that frame's last sample.
    model
        Name of the model.
    retraction, force, force_low, force_high
        (m,), the curve against z_r (m) with its 90 % band, N, tared.
    pressure, pressure_low, pressure_high
        (m,), Pa gauge, with its 90 % band, or ``None`` where the scene has no pressure.
    pull_off_force, pull_off_distance
        F_p (N, a magnitude) and D_p (m).
    work_of_adhesion
        The effective one, J/m^2.
    force_zero
        What the load cell reads at no force, N.
    zero_height
        Stage position at z_r = 0, m.
    inside
        Whether the measured force has stayed inside the band announced before it came.
    note
        In words, when it has not.
    progress
        z_r at the last frame over the predicted D_p.
    numerical_error
        Of the model, by feature.
    runtime_s
        Wall time of the prediction, s.
    """

    frame: int
    sample: int
    model: str
    retraction: Array
    force: Array
    force_low: Array
    force_high: Array
    pressure: Array | None
    pressure_low: Array | None
    pressure_high: Array | None
    pull_off_force: Estimate
    pull_off_distance: Estimate
    work_of_adhesion: Estimate
    force_zero: Estimate
    zero_height: float
    inside: bool
    note: str
    progress: float
    numerical_error: Mapping[str, float]
    runtime_s: float
