"""Can this scene be run on this bench? Asked before anything is opened or moves."""

from __future__ import annotations

from rig.bench import Bench
from rig.errors import Refused
from rig.scene import PullOffSection, Scene

STOPPING_MARGIN = 1.5
"""Room for the frame that is under way when a limit is passed."""


def check(scene: Scene, bench: Bench) -> None:
    """Refuse a scene the bench cannot carry out.

    Raises
    ------
    Refused
        Names every reason with value, limit and remedy.
    """
    reasons = [*_instruments(scene, bench), *_forces(scene, bench), *_pressure(scene, bench), *_speeds(scene, bench)]
    if reasons:
        raise Refused(f"scene {scene.title!r} cannot run on bench {bench.title!r}: " + "; ".join(reasons))


def _instruments(scene: Scene, bench: Bench) -> list[str]:
    if not scene.uses_pressure:
        return []
    missing = [name for name in ("pump", "pressure") if getattr(bench, name) is None]
    return [f"it needs [{name}], which the bench does not have; add the table" for name in missing]


def _forces(scene: Scene, bench: Bench) -> list[str]:
    preload = getattr(scene.protocol, "preload_N", 0.0)
    limit = min(bench.limits.compression_N, bench.force.capacity_N)
    if preload * STOPPING_MARGIN <= limit:
        return []
    return [
        f"preload_N = {preload:g} comes too near the compression limit {limit:g} N "
        f"(at most {limit / STOPPING_MARGIN:.3g} N); lower the preload or fit a larger load cell"
    ]


def _pressure(scene: Scene, bench: Bench) -> list[str]:
    protocol = scene.protocol
    pressure = protocol.initial_pressure_kPa if isinstance(protocol, PullOffSection) else None
    if pressure is None or bench.pump is None:
        return []
    low, high = bench.limits.pressure_low_kPa, bench.limits.pressure_high_kPa
    reasons = []
    if not low <= pressure <= high:
        reasons.append(f"initial_pressure_kPa = {pressure:g} lies outside the bench's {low:g} to {high:g} kPa")
    atmosphere = scene.gas.atmospheric_pressure_kPa
    needed = scene.gripper.chamber_volume_ml * abs(pressure) / (atmosphere + pressure)
    available = 0.8 * bench.pump.syringe_volume_ml
    if needed > available:
        reasons.append(
            f"reaching {pressure:g} kPa takes about {needed:.2f} ml, {available:g} ml of the syringe can be used; "
            "fit a larger syringe"
        )
    return reasons


def _speeds(scene: Scene, bench: Bench) -> list[str]:
    """The look-ahead must outlast several frames, or the stage would stutter."""
    fastest = bench.limits.look_ahead_um / 4 / (bench.daq.frame_ms * 1e-3)
    keys = ("approach_speed_um_s", "retract_speed_um_s")
    return [
        f"{key} = {speed:g} is too fast for a look-ahead of {bench.limits.look_ahead_um:g} um in frames of "
        f"{bench.daq.frame_ms:g} ms (at most {fastest:g} um/s)"
        for key in keys
        if (speed := getattr(scene.protocol, key, 0.0)) > fastest
    ]
