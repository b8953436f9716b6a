"""A live prediction: what is shown over the measurement, sent to consoles, and kept in the recording."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NINETY = 1.6449
"""Half the width of a normal 90 % interval, in standard deviations."""


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

    def to_json(self) -> str:
        """Return the form a recording keeps: one line, six digits of every curve."""
        held = {
            name: [float(f"{number:.6g}") for number in value] if isinstance(value, np.ndarray) else value
            for name, value in asdict(self).items()
        }
        return json.dumps(held, separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> LivePrediction:
        """Read what ``to_json`` wrote.

        Raises
        ------
        ValueError, KeyError, TypeError
            The text is something else.
        """
        held: dict[str, Any] = json.loads(text)
        for field in fields(cls):
            if isinstance(held[field.name], list):
                held[field.name] = np.array(held[field.name], dtype=np.float64)
        for name in ("pull_off_force", "pull_off_distance", "work_of_adhesion", "force_zero"):
            held[name] = Estimate(**held[name])
        return cls(**held)
