"""A recording as the analysis sees it: arrays, steps, and what the sensors are known to."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analysis.run import Run, Sensors
from rig.bench import Bench
from rig.recording import Recording, load_recording, open_recording
from rig.recording_file import reading


def load_run(path: Path) -> Run:
    """Read a recording as the analysis sees it."""
    return as_run(load_recording(path))


def as_run(recording: Recording) -> Run:
    """Return the recording's arrays, steps and sensors for the analysis."""
    scene, bench = recording.scene, recording.bench
    return Run(
        name=recording.path.stem,
        protocol=scene.protocol.name,
        rate=recording.rate,
        force=recording.force,
        pressure=recording.pressure,
        height=recording.height,
        steps=recording.step_table(),
        parameters=scene.parameters(),
        sensors=sensors(bench),
        settings=_settings(recording),
        complete=recording.ending is not None and recording.ending[1] == 0,
        pump_volume=_pump_volume(recording),
        emulated=is_emulated(recording),
    )


def began(recording: Recording) -> datetime:
    """Return when the run began."""
    with open_recording(recording.path) as entry:
        return datetime.fromisoformat(entry["start_time"].asstr()[()])


def is_emulated(recording: Recording) -> bool:
    """Whether the numbers come from emulated instruments, in this program or served to it.

    Those that are served, by ``rig emulate`` say, tell it in place of their serial number.
    """
    identities = recording.info.get("identities", {})
    return recording.bench.is_emulated or any("emulated" in str(words).casefold() for words in identities.values())


def provenance(recording: Recording) -> dict[str, object]:
    """Return what a recording says of its making: bench, scene, calibrations, versions; SI units in the keys."""
    with reading(recording.path):
        return _provenance(recording)


def _provenance(recording: Recording) -> dict[str, object]:
    scene, bench, told = recording.scene, recording.bench, recording.configuration
    emulated = is_emulated(recording)
    set_point: float | None = getattr(scene.protocol, "initial_pressure_kPa", None)
    parts: dict[str, object] = {
        "emulated": emulated,
        "bench": bench.title,
        "scene": scene.title,
        "place": told.get("place", ""),
        "substrate": _substrate(recording),
        "initial_pressure_set_point_Pa": None if set_point is None else set_point * 1e3,
        "seed": int(told["seed"]) if bench.is_emulated and "seed" in told else None,
        "began": began(recording).isoformat(timespec="seconds"),
        "force_calibration": bench.force.calibration.id,
        "pressure_calibration": None,
        "pressure_zero": None,
        "recorded_with": json.loads(told.get("versions", "{}")),
    }
    if scene.uses_pressure and bench.pressure is not None:
        calibration, zero = bench.pressure.calibration, bench.pressure.zero
        parts["pressure_calibration"] = "data sheet" if calibration is None else calibration.id
        parts["pressure_zero"] = None if zero is None else f"{zero.offset_Pa:+g} Pa, {zero.time.isoformat()}"
    return parts


def _substrate(recording: Recording) -> str:
    substrate = recording.scene.substrate
    words = substrate.shape if substrate.diameter_mm is None else f"{substrate.shape} {substrate.diameter_mm:g} mm"
    return words if substrate.material == "glass" else f"{words}, {substrate.material}"


def _settings(recording: Recording) -> dict[str, float | str]:
    """Return the scene's plain values, the gripper's kind and the place, as the analysis asks for them."""
    protocol = recording.scene.protocol
    settings: dict[str, float | str] = {
        key: value for key, value in protocol.model_dump().items() if isinstance(value, int | float | str)
    }
    gripper = recording.scene.gripper
    settings["gripper"] = gripper.kind
    settings["material"] = recording.scene.substrate.material
    settings["effective_radius_uncertainty_mm"] = gripper.effective_radius_uncertainty_mm
    place = recording.configuration.get("place", "")
    if place:
        settings["sample" if protocol.name == "fiber" else "position"] = place
        places = getattr(protocol, "positions", ())
        settings["place_number"] = places.index(place) if place in places else len(places)
    return settings


def _pump_volume(recording: Recording) -> NDArray[np.float64] | None:
    """Return the volume the pump has displaced at each sample, m^3, linear between its polls."""
    if recording.pump is None or not len(recording.pump):
        return None
    samples = np.arange(recording.force.size)
    volume: NDArray[np.float64] = np.interp(samples, recording.pump["sample"], recording.pump["volume_m3"])
    return volume


def sensors(bench: Bench) -> Sensors:
    """Return the standard uncertainties of a bench's calibration chain.

    The Honeywell HSC states 0.25 % of its 1200 mbar span for accuracy and 1 % as the total error band (HSC series
    data sheet); both are read as the half-width of a rectangular distribution.
    """
    rectangular = 3**-0.5
    calibration = bench.force.calibration
    pressure = bench.pressure.calibration if bench.pressure else None
    return Sensors(
        force_gain=calibration.relative_uncertainty,
        force_linearity=calibration.residual,
        force_capacity=bench.force.capacity_N,
        pressure_gain=pressure.relative_uncertainty if pressure else 0.0025 * rectangular,
        pressure_offset=pressure.residual if pressure else 300.0 * rectangular,
        position=1e-5,
        compliance=bench.force.compliance_um_per_N * 1e-6,
        compliance_uncertainty=bench.force.compliance_uncertainty_um_per_N * 1e-6,
        pump_volume=bench.pump.volume_uncertainty_percent * 1e-2 if bench.pump else 0.0,
        creep=bench.force.creep_percent * 1e-2,
        creep_uncertainty=bench.force.creep_uncertainty_percent * 1e-2,
        creep_time=bench.force.creep_time_s,
    )
