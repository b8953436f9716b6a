"""Scene files: one TOML file says what is tested and how.

Keys carry their units; values leave this module in SI. What a scene does not name is neither opened nor computed.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from model.parameters import Gas, GasAnchor, Gripper, Membrane, Parameters, Substrate
from rig.validation import Section, parsed, rule

PRINTABLE = r"^[^\x00-\x1f\x7f-\x9f]*$"
"""Control characters would act on the terminal that shows the text."""

Title = Annotated[str, Field(max_length=200, pattern=PRINTABLE)]


FINEST_ML = 1e-5
"""The smallest stroke that is worth moving; the pump itself takes a tenth of it."""


class SubstrateSection(Section):
    """``[substrate]``."""

    shape: Literal["sphere", "flat"]
    diameter_mm: Annotated[float, Field(ge=0.1, le=1e7)] | None = None
    material: Annotated[Title, Field(min_length=1)] = "glass"

    @rule
    def _sphere_has_a_diameter(self) -> SubstrateSection:
        if self.shape == "sphere" and self.diameter_mm is None:
            raise ValueError("a sphere needs diameter_mm")
        return self


class GripperSection(Section):
    """``[gripper]``."""

    kind: Literal["rigid", "soft", "punch"] = "rigid"
    radius_mm: Annotated[float, Field(gt=0, le=1e3)] = 8.0
    effective_radius_mm: Annotated[float, Field(gt=0, le=1e3)] = 7.3
    effective_radius_uncertainty_mm: Annotated[float, Field(ge=0, le=1e3)] = 0.1
    chamber_volume_ml: Annotated[float, Field(gt=0, le=1e9)] = 7.2

    @rule
    def _contact_fits_the_rim(self) -> GripperSection:
        if self.effective_radius_mm > self.radius_mm:
            raise ValueError(
                f"effective_radius_mm = {self.effective_radius_mm:g} exceeds radius_mm = {self.radius_mm:g}; "
                "the contact cannot be wider than the gripper"
            )
        if self.effective_radius_uncertainty_mm > self.effective_radius_mm / 2:
            raise ValueError(
                f"effective_radius_uncertainty_mm = {self.effective_radius_uncertainty_mm:g} exceeds half of "
                f"effective_radius_mm = {self.effective_radius_mm:g}"
            )
        return self


class MembraneSection(Section):
    """``[membrane]``."""

    youngs_modulus_MPa: Annotated[float, Field(ge=1e-4, le=1e5)] = 2.0
    thickness_um: Annotated[float, Field(ge=0.1, le=1e4)] = 200.0
    work_of_adhesion_J_m2: Annotated[float, Field(ge=0, le=1e4)] = 4.0


class GasSection(Section):
    """``[gas]``: how the model reads P_0."""

    anchor: Literal["free", "start", "vented"] = "free"
    atmospheric_pressure_kPa: Annotated[float, Field(gt=0, le=200)] = 101.3


class ContactSection(Section):
    """What every test that touches a sample has in common."""

    preload_N: Annotated[float, Field(gt=0, le=50)] = 0.5
    approach_speed_um_s: Annotated[float, Field(gt=0, le=1000)] = 100.0
    retract_speed_um_s: Annotated[float, Field(gt=0, le=1000)] = 10.0
    preload_dwell_s: Annotated[float, Field(ge=0, le=86400)] = 30.0
    tare_s: Annotated[float, Field(ge=0.2, le=600)] = 2.0
    contact_force_mN: Annotated[float, Field(gt=0, le=1000)] = 10.0


class PullOffSection(ContactSection):
    """``[protocol]`` of a pull-off test. Without ``initial_pressure_kPa`` the chamber is vented: no pump, no sensor."""

    name: Literal["pull_off"] = "pull_off"
    initial_pressure_kPa: Annotated[float, Field(gt=-101.3, le=1000)] | None = None
    pressure_tolerance_kPa: Annotated[float, Field(gt=0, le=10)] = 0.05
    contact_area_mm2: Annotated[float, Field(gt=0)] | None = None
    contact_area_uncertainty_mm2: Annotated[float, Field(ge=0)] | None = None


class IndentationSection(ContactSection):
    """``[protocol]`` of the JKR test (PNAS SI S4): a glass sphere on the film, one recording a position."""

    name: Literal["indentation"]
    preload_N: Annotated[float, Field(gt=0, le=50)] = 0.1
    retract_speed_um_s: Annotated[float, Field(gt=0, le=1000)] = 50.0
    contact_force_mN: Annotated[float, Field(gt=0, le=1000)] = 3.0
    indenter_radius_mm: Annotated[float, Field(gt=0, le=1000)] = 4.0
    indenter_radius_uncertainty_mm: Annotated[float, Field(ge=0, le=1000)] = 0.02
    contact_area_mm2: Annotated[float, Field(gt=0)] | None = None
    contact_area_uncertainty_mm2: Annotated[float, Field(ge=0)] | None = None
    positions: Annotated[tuple[Title, ...], Field(min_length=1, strict=False)] = (
        "top",
        "center",
        "bottom",
        "left",
        "right",
    )


class FiberSection(ContactSection):
    """``[protocol]`` of the test of a few fibres (PNAS SI S5): three samples, five repeats of each."""

    name: Literal["fiber"]
    preload_N: Annotated[float, Field(gt=0, le=50)] = 1e-3
    approach_speed_um_s: Annotated[float, Field(gt=0, le=1000)] = 20.0
    retract_speed_um_s: Annotated[float, Field(gt=0, le=1000)] = 2.0
    preload_dwell_s: Annotated[float, Field(ge=0, le=86400)] = 5.0
    contact_force_mN: Annotated[float, Field(gt=0, le=1000)] = 0.15
    fibers: Annotated[int, Field(ge=1)] = 3
    real_area_um2: Annotated[float, Field(gt=0)] | None = None
    real_area_uncertainty_um2: Annotated[float, Field(ge=0)] | None = None
    projected_area_um2: Annotated[float, Field(gt=0)] | None = None
    projected_area_uncertainty_um2: Annotated[float, Field(ge=0)] | None = None
    positions: Annotated[tuple[Title, ...], Field(min_length=1, strict=False)] = ("SPL#1", "SPL#2", "SPL#3")
    repeats: Annotated[int, Field(ge=1, le=1000)] = 5


class PunchSection(ContactSection):
    """``[protocol]`` of the pull-off of fibres on a rigid punch (EML Fig. 3e)."""

    name: Literal["punch"]
    contact_area_mm2: Annotated[float, Field(gt=0)] | None = None
    contact_area_uncertainty_mm2: Annotated[float, Field(ge=0)] | None = None


class VolumeSection(Section):
    """``[protocol]`` of the volume test: pump strokes against pressure give V_0; the chamber closed by a plate."""

    name: Literal["volume"]
    strokes_ml: Annotated[tuple[float, ...], Field(min_length=2, strict=False)] = (-0.1, -0.1, 0.2, 0.1, -0.1)
    settle_s: Annotated[float, Field(ge=0.5, le=3600)] = 3.0

    @rule
    def _every_stroke_moves(self) -> VolumeSection:
        if any(abs(stroke) < FINEST_ML for stroke in self.strokes_ml):
            raise ValueError(
                f"strokes_ml = {list(self.strokes_ml)}: every stroke must move at least {FINEST_ML:g} ml; leave out "
                "those that do not"
            )
        return self


class LeakSection(Section):
    """``[protocol]`` of the leak test: bring the closed chamber to a pressure and watch it."""

    name: Literal["leak"]
    initial_pressure_kPa: Annotated[float, Field(gt=-101.3, le=1000)] = -3.0
    pressure_tolerance_kPa: Annotated[float, Field(gt=0, le=10)] = 0.1
    hold_s: Annotated[float, Field(gt=0, le=86400)] = 120.0


class ComplianceSection(ContactSection):
    """``[protocol]`` of the compliance calibration: press a rigid stop and back away."""

    name: Literal["compliance"]
    preload_N: Annotated[float, Field(gt=0, le=50)] = 1.0
    approach_speed_um_s: Annotated[float, Field(gt=0, le=1000)] = 20.0
    retract_speed_um_s: Annotated[float, Field(gt=0, le=1000)] = 2.0
    unload_um: Annotated[float, Field(gt=0, le=1000)] = 60.0


class DeadWeightsSection(Section):
    """``[protocol]`` of the load cell calibration: masses hung one after the other, up and down."""

    name: Literal["dead_weights"]
    masses_g: Annotated[tuple[Annotated[float, Field(ge=0)], ...], Field(min_length=2, strict=False)] = (
        0.0,
        20.0,
        50.0,
        100.0,
        200.0,
    )
    mass_tolerance_percent: Annotated[float, Field(ge=0, le=10)] = 0.05
    gravity_m_s2: Annotated[float, Field(ge=9.7, le=9.9)] = 9.80665
    rest_s: Annotated[float, Field(ge=0.5, le=600)] = 2.0


class PressureZeroSection(Section):
    """``[protocol]`` of the pressure sensor's zero: port open to the room."""

    name: Literal["pressure_zero"]
    rest_s: Annotated[float, Field(ge=0.5, le=600)] = 2.0


def name_of(table: Any) -> Any:
    """Return which protocol a table is of."""
    return table.get("name") if isinstance(table, dict) else getattr(table, "name", None)


ProtocolSection = Annotated[
    Annotated[PullOffSection, Tag("pull_off")]
    | Annotated[IndentationSection, Tag("indentation")]
    | Annotated[FiberSection, Tag("fiber")]
    | Annotated[PunchSection, Tag("punch")]
    | Annotated[VolumeSection, Tag("volume")]
    | Annotated[LeakSection, Tag("leak")]
    | Annotated[ComplianceSection, Tag("compliance")]
    | Annotated[DeadWeightsSection, Tag("dead_weights")]
    | Annotated[PressureZeroSection, Tag("pressure_zero")],
    Discriminator(name_of),
]

WITH_CHAMBER = frozenset({"volume", "leak", "pressure_zero"})
"""Protocols that always need pump and pressure sensor."""


class Scene(Section):
    """A whole scene file."""

    title: Title = "untitled"
    substrate: SubstrateSection
    gripper: GripperSection = GripperSection()
    membrane: MembraneSection = MembraneSection()
    gas: GasSection = GasSection()
    protocol: ProtocolSection = PullOffSection()

    @property
    def uses_pressure(self) -> bool:
        """Whether the scene needs the pump and the pressure sensor."""
        return self.protocol.name in WITH_CHAMBER or getattr(self.protocol, "initial_pressure_kPa", None) is not None

    @model_validator(mode="before")
    @classmethod
    def _pull_off_is_the_usual_protocol(cls, content: Any) -> Any:
        """A ``[protocol]`` that names none is a pull-off test."""
        protocol = content.get("protocol") if isinstance(content, dict) else None
        if isinstance(protocol, dict) and "name" not in protocol:
            return {**content, "protocol": {"name": "pull_off", **protocol}}
        return content

    def parameters(self, pressure_kPa: float | None = None) -> Parameters:
        """Return the model's parameters, SI; ``pressure_kPa`` replaces the scene's P_0.

        A scene without pressure is vented to the room.
        """
        scene_pressure: float | None = getattr(self.protocol, "initial_pressure_kPa", None)
        pressure = scene_pressure if pressure_kPa is None else pressure_kPa
        diameter = self.substrate.diameter_mm
        return Parameters(
            substrate=Substrate(self.substrate.shape, None if diameter is None else diameter * 1e-3),
            gripper=Gripper(
                radius=self.gripper.radius_mm * 1e-3,
                effective_radius=self.gripper.effective_radius_mm * 1e-3,
                chamber_volume=self.gripper.chamber_volume_ml * 1e-6,
            ),
            membrane=Membrane(
                youngs_modulus=self.membrane.youngs_modulus_MPa * 1e6,
                thickness=self.membrane.thickness_um * 1e-6,
                work_of_adhesion=self.membrane.work_of_adhesion_J_m2,
            ),
            gas=Gas(
                initial_pressure=0.0 if pressure is None else pressure * 1e3,
                atmospheric_pressure=self.gas.atmospheric_pressure_kPa * 1e3,
                anchor=GasAnchor.VENTED if pressure is None else GasAnchor(self.gas.anchor),
            ),
        )


def parse_scene(text: str, source: str, *, recorded: bool = False) -> Scene:
    """Check the text of a scene file; ``source`` names it in messages, ``recorded`` leaves out what is for a new run.

    Raises
    ------
    FileError
        Names the file, the key, the value and the allowed range.
    """
    return parsed(Scene, "scene", text, source, recorded=recorded)
