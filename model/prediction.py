"""The result every solver of the model returns: the retraction profile, its features, their error and their cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]


class Outcome(StrEnum):
    """How a prediction ended. Everything but ``PULL_OFF`` carries no feature values."""

    PULL_OFF = "pull-off"
    NO_EQUILIBRIUM = "no equilibrium: the membrane is drawn off by suction"
    BLOWN_OFF = "no equilibrium: the stretch of the inflated membrane peels it off by itself"
    SELF_CONTACT = "self-contact: the peeled membrane folds back onto the substrate"
    NEVER_IN_CONTACT = "never in contact"
    NO_ADHESION = "no adhesion: the force never becomes tensile"
    CHAMBER_CLOSED = "the chamber volume vanishes before retraction begins"


@dataclass(frozen=True, slots=True)
class Jump:
    """The contact line jumps at constant z (m) from one stable radius (m) to the next."""

    position: float
    radius_before: float
    radius_after: float
    force_before: float
    force_after: float


@dataclass(frozen=True)
class Prediction:
    """What a model says about one pull-off test. SI units, compression positive, features ``nan`` where undefined.

    Attributes
    ----------
    model
        ``"cone"``, ``"cone-2017"`` or ``"membrane"``.
    outcome
        Why the profile ends; features are defined for ``Outcome.PULL_OFF`` only.
    assumptions
        Named choices that shape the result: gas anchor, contact stretch, tension field, ...
    pull_off_force
        F_p, N, a magnitude.
    pull_off_distance
        D_p, m: z at detachment minus z at the zero of force.
    retraction_at_pull_off
        z_r at F_p, m.
    zero_force_position
        z where F_r changes from compression to tension, m above the apex.
    onset_position
        z where the contact line first leaves r_i, m.
    detachment_position, detachment_radius
        z and r of the last stable contact, m.
    adhesion_energy
        Integral of the tensile force over z_r up to detachment, J.
    position, retraction, force, pressure, contact_radius
        The profile, arrays of equal length: z (m), z_r (m), F_r (N), P_a (Pa gauge), r (m).
    stable
        For each point whether it is a stable equilibrium under displacement control.
    numerical_error
        Absolute error estimate of each feature, same units as the feature.
    runtime_s
        Wall time of the solution, s.
    evaluations
        Counts of evaluated terms, by name; terms a scene does not need are absent or zero.
    """

    model: str
    outcome: Outcome
    assumptions: Mapping[str, str]
    pull_off_force: float = np.nan
    pull_off_distance: float = np.nan
    retraction_at_pull_off: float = np.nan
    zero_force_position: float = np.nan
    onset_position: float = np.nan
    detachment_position: float = np.nan
    detachment_radius: float = np.nan
    adhesion_energy: float = np.nan
    position: Array = field(default_factory=lambda: np.empty(0))
    retraction: Array = field(default_factory=lambda: np.empty(0))
    force: Array = field(default_factory=lambda: np.empty(0))
    pressure: Array = field(default_factory=lambda: np.empty(0))
    contact_radius: Array = field(default_factory=lambda: np.empty(0))
    stable: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))
    jumps: tuple[Jump, ...] = ()
    numerical_error: Mapping[str, float] = field(default_factory=dict)
    runtime_s: float = np.nan
    evaluations: Mapping[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """The model, with what it assumes of the contact where that was a choice."""
        if self.model != "membrane":
            return self.model
        return f"{self.model}, contact stretch {self.assumptions['contact stretch']}"

    def frame(self) -> pd.DataFrame:
        """Return the profile as a DataFrame with units in the column names."""
        import pandas as pd

        return pd.DataFrame(
            {
                "position_m": self.position,
                "retraction_m": self.retraction,
                "force_N": self.force,
                "pressure_Pa": self.pressure,
                "contact_radius_m": self.contact_radius,
                "stable": self.stable,
            }
        )
