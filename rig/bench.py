"""Bench files: the instruments, how to reach each, their calibrations and limits."""

from __future__ import annotations

from datetime import date, datetime
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import Field

from rig.library import find
from rig.scene import Title
from rig.validation import Section, parsed, rule

EMULATED = "emulated"
"""Connection of an instrument that the program emulates itself."""

OVERLOAD = 1.2
"""What a load cell survives, in capacities."""


GIVES_MM = 1.0
"""What a load cell with its frame may give at its capacity, mm; the emulated ones give 0.06 and 0.2."""


class StageSection(Section):
    """``[stage]``: PI controller with a linear stage.

    ``lowest_contact_mm`` is where an approach without contact ends, ``minimum_mm`` unless stated.
    ``left_on`` is for an emulated one: it has kept its reference and stands at ``start_mm`` (a real one is asked).
    """

    connection: Title
    model: Title = "C-863"
    baud: Annotated[int, Field(ge=1200, le=921600)] = 115200
    axis: Title = "1"
    inverted: bool = False
    minimum_mm: float
    maximum_mm: float
    lowest_contact_mm: float | None = None
    start_mm: float | None = None
    reference_on_start: bool = False
    left_on: bool = False
    reply_timeout_ms: Annotated[float, Field(ge=20, le=5000)] = 400.0

    @rule
    def _has_travel(self) -> StageSection:
        if self.minimum_mm >= self.maximum_mm:
            raise ValueError(f"minimum_mm = {self.minimum_mm:g} must lie below maximum_mm = {self.maximum_mm:g}")
        if self.start_mm is not None and not self.minimum_mm <= self.start_mm <= self.maximum_mm:
            raise ValueError(
                f"start_mm = {self.start_mm:g} must lie within minimum_mm = {self.minimum_mm:g} and "
                f"maximum_mm = {self.maximum_mm:g}"
            )
        highest = self.maximum_mm if self.start_mm is None else self.start_mm
        if self.lowest_contact_mm is not None and not self.minimum_mm <= self.lowest_contact_mm < highest:
            raise ValueError(
                f"lowest_contact_mm = {self.lowest_contact_mm:g} must lie within minimum_mm = {self.minimum_mm:g} and "
                f"where the approach begins, {highest:g}"
            )
        return self

    @property
    def lowest_m(self) -> float:
        """Return where an approach without contact ends, m."""
        return (self.minimum_mm if self.lowest_contact_mm is None else self.lowest_contact_mm) * 1e-3

    @rule
    def _was_left_on_somewhere(self) -> StageSection:
        if self.left_on and (self.connection != EMULATED or self.start_mm is None):
            raise ValueError("left_on is for an emulated stage that has a start_mm; a real stage is asked")
        return self


class PumpSection(Section):
    """``[pump]``: KD Scientific Legato with the syringe that is in it.

    ``volume_uncertainty_percent`` is that of a volume it moves: the syringe's diameter and the mechanism together.
    """

    connection: Title
    model: Title = "Legato"
    baud: Annotated[int, Field(ge=1200, le=921600)] = 115200
    address: Annotated[int, Field(ge=0, le=99)] = 0
    syringe_diameter_mm: Annotated[float, Field(gt=0, le=50)]
    syringe_volume_ml: Annotated[float, Field(gt=0, le=200)]
    force_percent: Annotated[int, Field(ge=1, le=100)] = 50
    volume_uncertainty_percent: Annotated[float, Field(ge=0, le=20)] = 0.5
    reply_timeout_ms: Annotated[float, Field(ge=20, le=5000)] = 500.0
    settle_ms: Annotated[float, Field(ge=0, le=5000)] = 200.0


class DaqSection(Section):
    """``[daq]``: NI device, through the local runtime or a gRPC server."""

    connection: Title = "local"
    model: Title | None = None
    rate_Hz: Annotated[float, Field(ge=100, le=50_000)] = 1000.0
    frame_ms: Annotated[float, Field(ge=1, le=1000)] = 20.0
    allow_remote: bool = False

    def frame_samples(self, rate: float) -> int:
        """Return how many samples a frame holds at the device's real ``rate``, Hz."""
        return max(1, round(self.frame_ms * 1e-3 * rate))

    @property
    def frame_s(self) -> float:
        """How long a frame is, s: ``frame_ms`` in whole samples."""
        return self.frame_samples(self.rate_Hz) / self.rate_Hz


class CalibrationSection(Section):
    """A calibration record: one line, value = slope * reading + intercept, and where it comes from."""

    id: Title
    certificate: Title
    date: date
    operator: Title
    serial: Title
    slope: Annotated[float, Field(gt=0)]
    intercept: float = 0.0
    relative_uncertainty: Annotated[float, Field(gt=0, le=1)]
    residual: Annotated[float, Field(gt=0)]
    temperature_C: float = 23.0


class ForceSection(Section):
    """``[force]``: load cell. ``calibration``: N per V (amplified) or N per mV/V (bridge).

    ``at_rest_N`` is what the cell reads with the gripper hanging free.
    ``creep_percent`` of a compression is lost to the reading within ``creep_time_s``, and comes back as slowly; a time
    of zero says that it was never measured.
    """

    channel: Title
    cell: Title = "GSO-500"
    capacity_N: Annotated[float, Field(gt=0, le=1000)]
    readout: Literal["amplified", "bridge"] = "amplified"
    range_V: Annotated[float, Field(gt=0, le=20)] = 10.0
    range_mV_V: Annotated[float, Field(gt=0, le=25)] = 3.0
    terminal: Literal["default", "rse", "diff"] = "default"
    excitation_V: Annotated[float, Field(gt=0, le=10)] = 2.5
    bridge_ohm: Annotated[float, Field(gt=0)] = 350.0
    compression_positive: bool = True
    at_rest_N: float = 0.0
    compliance_um_per_N: Annotated[float, Field(ge=0)] = 0.0
    compliance_uncertainty_um_per_N: Annotated[float, Field(ge=0)] = 0.0
    creep_percent: Annotated[float, Field(ge=0, le=30)] = 0.0
    creep_uncertainty_percent: Annotated[float, Field(ge=0, le=30)] = 0.0
    creep_time_s: Annotated[float, Field(ge=0, le=3600)] = 0.0
    calibration: CalibrationSection

    @rule
    def _gives_like_a_cell(self) -> ForceSection:
        most = self.compliance_um_per_N * self.capacity_N * 1e-3
        if most > GIVES_MM:
            raise ValueError(
                f"compliance_um_per_N = {self.compliance_um_per_N:g}: the cell would give by {most:.3g} mm at its "
                f"capacity (at most {GIVES_MM:g} mm); enter um per N"
            )
        return self


class ZeroSection(Section):
    """``[pressure.zero]``: what the sensor reads open to the room; ``rig run pressure-zero`` measures it."""

    offset_Pa: Annotated[float, Field(ge=-1200, le=1200)]
    noise_Pa: Annotated[float, Field(ge=0)]
    samples: Annotated[int, Field(gt=0)]
    time: datetime
    temperature_C: float | None = None


class PressureCalibrationSection(CalibrationSection):
    """``[pressure.calibration]``: true Pa = slope * (data sheet's Pa less the zero) + intercept, against a standard."""

    slope: Annotated[float, Field(ge=0.9, le=1.1)]
    intercept: Annotated[float, Field(ge=-1200, le=1200)] = 0.0


class PressureSection(Section):
    """``[pressure]``: Honeywell HSC of +-600 mbar in any package, ratiometric, its supply on a channel of its own."""

    signal_channel: Title
    supply_channel: Title
    sensor: Annotated[str, Field(pattern=r"^HSC[A-Z]{4}600MDAA5$")] = "HSCSANN600MDAA5"
    terminal: Literal["default", "rse", "diff"] = "default"
    zero: ZeroSection | None = None
    calibration: PressureCalibrationSection | None = None

    @rule
    def _has_one_zero(self) -> PressureSection:
        if self.zero is not None and self.calibration is not None and self.calibration.intercept:
            raise ValueError(
                f"zero.offset_Pa and calibration.intercept = {self.calibration.intercept:g} both say where zero is; "
                "remove the table [pressure.zero], or set the intercept to 0"
            )
        return self


class LimitsSection(Section):
    """``[limits]``: what ends a run. Untared values."""

    compression_N: Annotated[float, Field(gt=0)]
    tension_N: Annotated[float, Field(gt=0)]
    pressure_low_kPa: Annotated[float, Field(ge=-101.3, le=0)] = -55.0
    pressure_high_kPa: Annotated[float, Field(ge=0, le=1000)] = 55.0
    look_ahead_um: Annotated[float, Field(gt=0, le=1000)] = 40.0
    lag_s: Annotated[float, Field(gt=0, le=60)] = 0.5


class RecordingSection(Section):
    """``[recording]``: how far its data are brought at every flush."""

    survives_power_cut: bool = False


class Bench(Section):
    """A whole bench file. Pump and pressure are needed by scenes with pressure only."""

    title: Title = "untitled"
    stage: StageSection
    daq: DaqSection
    force: ForceSection
    limits: LimitsSection
    pump: PumpSection | None = None
    pressure: PressureSection | None = None
    recording: RecordingSection = RecordingSection()

    @rule
    def _cell_is_protected(self) -> Bench:
        most = OVERLOAD * self.force.capacity_N
        for key in ("compression_N", "tension_N"):
            limit = getattr(self.limits, key)
            if limit > most:
                raise ValueError(
                    f"limits.{key} = {limit:g} is beyond the load cell: {self.force.cell} carries "
                    f"{self.force.capacity_N:g} N, at most {100 * OVERLOAD:g} % of it ({most:.3g} N) is allowed"
                )
        return self

    @rule
    def _is_emulated_as_a_whole(self) -> Bench:
        parts = {"stage": self.stage, "daq": self.daq, "pump": self.pump}
        emulated = {name: part.connection == EMULATED for name, part in parts.items() if part is not None}
        if len(set(emulated.values())) > 1:
            names = {kind: ", ".join(n for n, e in emulated.items() if e is kind) for kind in (True, False)}
            raise ValueError(
                f'connection = "{EMULATED}" of {names[True]}, but not of {names[False]}: the emulated ones share one '
                "world; emulate all or none"
            )
        return self

    @rule
    def _can_be_reached(self) -> Bench:
        for name, part in (("stage", self.stage), ("pump", self.pump), ("daq", self.daq)):
            if part is None or "://" not in part.connection:
                continue
            address = part.connection.partition("://")[2].partition(" ")[0]
            try:
                parts = urlsplit(f"//{address}")
                (parts.hostname or "").encode("idna")
                _ = parts.port
            except ValueError as error:
                raise ValueError(f"{name}.connection = {part.connection!r} is no address: {error}") from error
        return self

    @rule
    def _is_filled_in(self) -> Bench:
        texts = {
            "stage.connection": self.stage.connection,
            "pump.connection": self.pump.connection if self.pump else "",
            **{f"force.calibration.{key}": str(value) for key, value in self.force.calibration},
        }
        empty = [key for key, text in texts.items() if "FILL" in text]
        if empty:
            raise ValueError(f"still to be filled in: {', '.join(empty)}")
        return self

    @rule
    def _has_a_port_each(self) -> Bench:
        if self.pump is not None and self.stage.connection == self.pump.connection != EMULATED:
            raise ValueError(
                f"stage.connection and pump.connection are both {self.stage.connection!r}; each has a port of its own"
            )
        return self

    @property
    def is_emulated(self) -> bool:
        """Whether the program emulates the instruments itself."""
        return self.stage.connection == EMULATED


def load_bench(path: Path | None) -> tuple[Bench, str]:
    """Return a bench and its text: a file, one that ships by its name, or the emulated bench for ``None``.

    Raises
    ------
    FileError
        Names the file, the key, the value and the allowed range.
    """
    text, source = find("bench", "emulated" if path is None else path)
    return parse_bench(text, source), text


def parse_bench(text: str, source: str, *, recorded: bool = False) -> Bench:
    """Check the text of a bench file; ``source`` names it in messages, ``recorded`` leaves out what is for a new run.

    Raises
    ------
    FileError
        Names the file, the key, the value and the allowed range.
    """
    return parsed(Bench, "bench", text, source, recorded=recorded)
