"""The parameters of a membrane-adhesion scene, in SI units and the papers' words.

Sources: EML 2020 section 4 and PNAS 2017 SI section S2 (see ``docs/physics.md``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Literal, Self

from model.errors import InvalidParameter

STANDARD_ATMOSPHERE = 101_300.0
"""P_atm of both papers, Pa."""


class GasAnchor(StrEnum):
    """What the initial pressure P_0 refers to."""

    FREE = "free"
    """P_0 holds at V = V_0, the flat, free-standing membrane (EML Eq. 6). The default."""
    START = "start"
    """P_0 holds at the start of retraction, in contact, at V(z_0, r_i)."""
    VENTED = "vented"
    """The chamber is held at P_0: no gas law."""
    MEASURED = "measured"
    """The measured P_a drives the model; see ``Gas.measured``."""


class ContactStretch(StrEnum):
    """How the membrane is stretched where it is in contact. On a flat all but ``FRICTIONLESS`` agree."""

    EML = "eml"
    """W_2 of EML Eq. 5: every point keeps its radius; stored is the energy of one mean meridional stretch."""
    PROJECTED = "projected"
    """Perfect stick, every point vertically below its place in the flat membrane."""
    UNSTRETCHED = "unstretched"
    """Every point keeps its radius, nothing is stored (SI Eq. S8)."""
    LOADING = "loading"
    """Perfect stick, every point with the stretch it had when the line passed it in vented loading without adhesion."""
    FRICTIONLESS = "frictionless"
    """The membrane slides on the substrate: its tension along the substrate is continuous at the line."""


@dataclass(frozen=True, slots=True)
class Substrate:
    """What the membrane sticks to.

    Attributes
    ----------
    shape
        ``"sphere"`` or ``"flat"``.
    diameter
        d_b, m. Sphere: its diameter. Flat: optional, a disk that may be smaller than the gripper.
    """

    shape: Literal["sphere", "flat"]
    diameter: float | None = None

    @property
    def radius(self) -> float:
        """r_b, m; infinite on a flat."""
        if self.shape == "flat":
            return math.inf
        if self.diameter is None:
            raise InvalidParameter("a sphere needs a diameter")
        return self.diameter / 2


@dataclass(frozen=True, slots=True)
class Gripper:
    """The chamber and its rim: R_0 (m), r_e (m) and V_0 (m^3)."""

    radius: float = 8e-3
    effective_radius: float = 7.3e-3
    chamber_volume: float = 7.2e-6


@dataclass(frozen=True, slots=True)
class Membrane:
    """E_m (Pa), h_0 (m) and the effective work of adhesion omega_a (J/m^2)."""

    youngs_modulus: float = 2.0e6
    thickness: float = 200e-6
    work_of_adhesion: float = 4.0


@dataclass(frozen=True, slots=True)
class Gas:
    """Chamber gas: P_0 (Pa, gauge), P_atm (Pa) and what P_0 is anchored to.

    ``measured`` is used with ``GasAnchor.MEASURED`` only: pairs (z, P_a) as two equally long tuples,
    z in m above the apex and rising, P_a in Pa gauge; interpolated linearly, constant beyond its ends.
    """

    initial_pressure: float = 0.0
    atmospheric_pressure: float = STANDARD_ATMOSPHERE
    anchor: GasAnchor = GasAnchor.FREE
    measured: tuple[tuple[float, ...], tuple[float, ...]] | None = None


@dataclass(frozen=True, slots=True)
class Parameters:
    """One complete scene for the solvers. Hashable, comparable, picklable."""

    substrate: Substrate
    gripper: Gripper = field(default_factory=Gripper)
    membrane: Membrane = field(default_factory=Membrane)
    gas: Gas = field(default_factory=Gas)

    def with_changes(
        self,
        *,
        diameter: float | None = None,
        initial_pressure: float | None = None,
        thickness: float | None = None,
        work_of_adhesion: float | None = None,
        youngs_modulus: float | None = None,
    ) -> Self:
        """Return a copy with the named quantities replaced (SI units)."""
        membrane = {
            "thickness": thickness,
            "work_of_adhesion": work_of_adhesion,
            "youngs_modulus": youngs_modulus,
        }
        changed = {name: value for name, value in membrane.items() if value is not None}
        return replace(
            self,
            substrate=self.substrate if diameter is None else replace(self.substrate, diameter=diameter),
            membrane=replace(self.membrane, **changed),
            gas=self.gas if initial_pressure is None else replace(self.gas, initial_pressure=initial_pressure),
        )
