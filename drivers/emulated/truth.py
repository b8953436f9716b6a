"""The truth of the emulated world: what the plant is made of, and what no overlay is ever told."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal, Self

import numpy as np

from drivers.emulated.chamber import Chamber
from drivers.emulated.fibers import FewFibers, RigidPunch
from drivers.emulated.indentation import Indentation
from drivers.emulated.membrane import AdhesiveMembrane
from drivers.emulated.soft import SoftGripper
from drivers.emulated.specimens import ClosedChamber, Specimen


@dataclass(frozen=True, slots=True)
class Train:
    """The load train: stage, load cell and frame.

    Attributes
    ----------
    stiffness
        Of cell and frame in series with the specimen, N/m.
    contact_position
        Stage position where the gripper's rim plane meets the apex of the specimen, unloaded, m.
    start_position
        Stage position at power-up, m.
    servo_lag
        Time constant with which the carriage follows its trajectory, s.
    relaxing, relaxation_time
        Fraction of a compression that relaxes at rest, and its time constant, s.
    """

    stiffness: float = 84e3
    contact_position: float = 20e-3
    start_position: float = 22e-3
    servo_lag: float = 3e-3
    relaxing: float = 0.06
    relaxation_time: float = 9.0


@dataclass(frozen=True, slots=True)
class Disturbance:
    """What the sensors see besides the test: vibration (rms) and slow drift of force, pressure and supply.

    ``*_drift`` is per second, ``*_wander`` the amplitude of slow waves.
    """

    force_noise: float = 1e-4
    force_drift: float = 4e-6
    force_wander: float = 4e-4
    pressure_noise: float = 1.5
    pressure_drift: float = 2e-3
    pressure_wander: float = 2.0
    supply: float = 5.012
    supply_noise: float = 2e-4
    supply_wander: float = 5e-4


@dataclass(frozen=True, slots=True)
class Truth:
    """One emulated world. Every field is truth: nothing here is read by a model, a scene or a bench."""

    specimen: Specimen = field(default_factory=AdhesiveMembrane)
    chamber: Chamber = field(default_factory=Chamber)
    train: Train = field(default_factory=Train)
    disturbance: Disturbance = field(default_factory=Disturbance)

    @classmethod
    def pull_off(
        cls,
        shape: Literal["sphere", "flat"] = "sphere",
        diameter: float | None = 60e-3,
        *,
        radius: float = 8e-3,
        effective_radius: float = 7.3e-3,
        chamber_volume: float = 7.2e-6,
        vented: bool = False,
        seed: int = 0,
    ) -> Self:
        """Return a world with this geometry; the specimen itself varies with the seed as specimens do.

        Only geometry is taken: the adhesion, stiffness and thickness that a scene assumes belong to its model.

        Parameters
        ----------
        shape, diameter
            Substrate: a sphere of diameter d_b, or a flat, or a flat disk of that diameter (m).
        radius, effective_radius
            R_0 and r_e, m; misalignment makes the true contact a little smaller.
        chamber_volume
            V_0, m^3.
        vented
            Chamber open to the room.
        seed
            Chooses the specimen.
        """
        draw = np.random.default_rng([seed, 0x5EED]).normal
        nominal = AdhesiveMembrane()
        specimen = replace(
            nominal,
            substrate_diameter=diameter if shape == "sphere" else None,
            disk_diameter=diameter if shape == "flat" else None,
            radius=radius,
            effective_radius=min(effective_radius * (1 - 0.012 * abs(draw())), 0.99 * radius),
            youngs_modulus=nominal.youngs_modulus * (1 + 0.02 * draw()),
            thickness=nominal.thickness * (1 + 0.02 * draw()),
            line=nominal.line.varied(draw(), draw()),
            tilt=abs(1.0e-3 + 0.5e-3 * draw()),
        )
        chamber = Chamber(
            volume=chamber_volume * (1 + 0.004 * draw()),
            vented=vented,
            syringe_diameter=14.43e-3 * (1 + 0.001 * draw()),
        )
        train = Train(contact_position=20e-3 + 20e-6 * draw(), stiffness=84e3 * (1 + 0.02 * draw()))
        return cls(specimen, chamber, train)

    @classmethod
    def indentation(cls, *, seed: int = 0) -> Self:
        """Return the film on its glass plate under a 4 mm sphere, as in PNAS SI S4; another spot for every seed."""
        draw = np.random.default_rng([seed, 0x1DE7]).normal
        nominal = Indentation()
        spot = replace(nominal, modulus=nominal.modulus * (1 + 0.03 * draw()), line=nominal.line.varied(draw(), draw()))
        return cls(spot, Chamber(vented=True), Train(contact_position=20e-3 + 20e-6 * draw()))

    @classmethod
    def fibers(cls, *, seed: int = 0) -> Self:
        """Return three single fibres as in PNAS SI S5, under the soft load cell such forces need."""
        draw = np.random.default_rng([seed, 0xF1BE]).normal
        nominal = FewFibers()
        sample = replace(nominal, strengths=tuple(strength * (1 + 0.08 * draw()) for strength in nominal.strengths))
        train = Train(stiffness=1.2e3, contact_position=20e-3 + 20e-6 * draw())
        return cls(sample, Chamber(vented=True), train, Disturbance(4e-6, 5e-8, 4e-6))

    @classmethod
    def punch(cls, *, radius: float = 7.3e-3, seed: int = 0) -> Self:
        """Return fibres on a rigid punch above flat glass, as in EML 2020 Fig. 3e."""
        draw = np.random.default_rng([seed, 0xFA2B]).normal
        nominal = RigidPunch()
        punch = replace(
            nominal,
            radius=radius,
            strength=nominal.strength * (1 + 0.04 * draw()),
            tilt=nominal.tilt * (1 + 0.1 * draw()),
        )
        return cls(punch, Chamber(vented=True), Train(contact_position=20e-3 + 20e-6 * draw()))

    @classmethod
    def soft(
        cls, diameter: float | None = None, *, rubber: bool = False, chamber_volume: float = 7.2e-6, seed: int = 0
    ) -> Self:
        """Return the soft gripper on a glass sphere of this diameter (m), on flat glass or on a flat rubber film.

        Empirical, after Table S2.
        """
        draw = np.random.default_rng([seed, 0x50F7]).normal
        gripper = SoftGripper(math.inf if diameter is None else diameter, factor=1 + 0.03 * draw(), rubber=rubber)
        chamber = Chamber(volume=chamber_volume * (1 + 0.004 * draw()))
        return cls(gripper, chamber, Train(contact_position=20e-3 + 20e-6 * draw()))

    @classmethod
    def closed(cls, *, chamber_volume: float = 7.2e-6, leak_time: float = 3000.0, seed: int = 0) -> Self:
        """Return the chamber closed by a plate, for leak and volume tests."""
        draw = np.random.default_rng([seed, 0xC105]).normal
        return cls(ClosedChamber(), Chamber(chamber_volume * (1 + 0.004 * draw()), leak_time=leak_time))
