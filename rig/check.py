"""Can this scene be run on this bench? Asked before anything is opened or moves."""

from __future__ import annotations

import math
from itertools import accumulate

from rig.bench import OVERLOAD, Bench, PumpSection
from rig.errors import Refused
from rig.scene import (
    ComplianceSection,
    ContactSection,
    DeadWeightsSection,
    LeakSection,
    PullOffSection,
    Scene,
    VolumeSection,
)
from sequences.reference import Parking
from sequences.step import steady_speed

STOPPING_MARGIN = 1.5
"""Room for the frame that is under way when a limit is passed."""

PARK_SPEED = 500e-6
"""m/s."""

RESOLUTION = 10.0
"""A preload is worth setting if it is so many times what the load cell is known to."""

REACTION_S = 0.05
"""From the end of a frame to the stop byte at the stage: 99 of 100 measured were faster (docs/reliability.md)."""

STIFFEST_UM_PER_N = 10.0
"""What a load train is taken to give at least while nobody has measured it: stiffer than a cell that bends, its bracket
and the stage should be (100 N/mm; the emulated one gives 12 um/N). Whoever knows better enters it in the bench.
"""

TOUCH = 0.1
"""Change of force that ends the way to the starting height, in capacities: nothing should be in that way."""

AT_REST = 0.02
"""How far a tare may lie from the force at rest, in capacities: drift and creep, no contact worth the name."""

TARE_FRAMES = 4
"""Frames a tare needs at least, or it could not tell noise and drift."""


def check(scene: Scene, bench: Bench) -> None:
    """Refuse a scene the bench cannot carry out.

    Raises
    ------
    Refused
        Names every reason with value, limit and remedy.
    """
    found = reasons(scene, bench)
    if found:
        raise Refused(f"scene {scene.title!r} cannot run on bench {bench.title!r}: " + "; ".join(found))


def reasons(scene: Scene, bench: Bench) -> list[str]:
    """Return why the bench cannot carry out the scene, each with value, limit and remedy; empty if it can."""
    parts = (
        _instruments,
        _material,
        _forces,
        _contact,
        _resolution,
        _tension,
        _pressure,
        _strokes,
        _tare,
        _speeds,
        _overruns,
        _retraction,
    )
    return [reason for part in parts for reason in part(scene, bench)]


def usable_ml(pump: PumpSection) -> float:
    """Return how much of the syringe can be used, ml: its ends are left alone."""
    return 0.8 * pump.syringe_volume_ml


def needed_ml(scene: Scene, pressure_kPa: float) -> float:
    """Return what the pump has to move for a pressure in the scene's chamber, ml (Boyle)."""
    return scene.gripper.chamber_volume_ml * abs(pressure_kPa) / (scene.gas.atmospheric_pressure_kPa + pressure_kPa)


def _instruments(scene: Scene, bench: Bench) -> list[str]:
    if not scene.uses_pressure:
        return []
    missing = [name for name in ("pump", "pressure") if getattr(bench, name) is None]
    return [f"it needs [{name}], which the bench does not have; add the table" for name in missing]


def _material(scene: Scene, bench: Bench) -> list[str]:
    """Emulated substrates are of glass; the rubber film is known with the soft gripper alone (Table S2)."""
    from rig.emulation import is_rubber_film

    material = scene.substrate.material
    known = material.casefold() == "glass" or (is_rubber_film(scene) and scene.gripper.kind == "soft")
    if known or not bench.is_emulated:
        return []
    return [
        f"substrate material {material!r} is none of which the emulated bench knows the adhesion; choose glass, or "
        "for the soft gripper a flat rubber film"
    ]


def _forces(scene: Scene, bench: Bench) -> list[str]:
    preload = getattr(scene.protocol, "preload_N", 0.0)
    limit = min(bench.limits.compression_N, bench.force.capacity_N) - pressing_at_rest(bench)
    if preload * STOPPING_MARGIN <= limit:
        return []
    return [
        f"preload_N = {preload:g} comes too near the compression limit {limit:g} N "
        f"(at most {limit / STOPPING_MARGIN:.3g} N); lower the preload or fit a larger load cell"
    ]


def _contact(scene: Scene, bench: Bench) -> list[str]:
    """The stage goes at full speed up to the contact force."""
    protocol = scene.protocol
    if not isinstance(protocol, ContactSection) or protocol.contact_force_mN <= protocol.preload_N / 2 * 1e3:
        return []
    return [
        f"contact_force_mN = {protocol.contact_force_mN:g} is more than half of preload_N = {protocol.preload_N:g}: "
        f"the approach would pass the preload; make it at most {protocol.preload_N / 2 * 1e3:g}"
    ]


def _resolution(scene: Scene, bench: Bench) -> list[str]:
    """A force the load cell does not resolve can neither be reached nor measured."""
    protocol = scene.protocol
    known = bench.force.calibration.residual
    if not isinstance(protocol, ContactSection) or protocol.preload_N >= RESOLUTION * known:
        return []
    return [
        f"preload_N = {protocol.preload_N:g} is less than {RESOLUTION:g} times what the load cell {bench.force.cell} "
        f"is known to (residual = {known:g} N); fit a smaller load cell and name its bench file "
        "(emulated: --bench emulated-gso25)"
    ]


def _tension(scene: Scene, bench: Bench) -> list[str]:
    """Forces that are known before: hung weights, and the soft gripper's from the published table."""
    limit = min(bench.limits.tension_N, bench.force.capacity_N) - max(0.0, -bench.force.at_rest_N)
    protocol = scene.protocol
    if isinstance(protocol, DeadWeightsSection):
        heaviest = max(protocol.masses_g) * 1e-3 * protocol.gravity_m_s2
        if heaviest <= limit:
            return []
        return [
            f"masses_g: {max(protocol.masses_g):g} g pull with {heaviest:.3g} N, the tension limit is {limit:g} N; "
            "leave the heavy ones out, or raise tension_N as far as the load cell allows"
        ]
    expected = _published_force(scene)
    if expected is None or expected <= limit:
        return []
    return [
        f"the soft gripper is known to pull with about {expected:.2f} N (PNAS SI Table S2), the tension limit is "
        f"{limit:g} N; raise tension_N as far as the load cell allows, or choose a pressure nearer to zero"
    ]


def _published_force(scene: Scene) -> float | None:
    """Pull-off force of the soft gripper, N, a straight line between the pressures of Table S2; else ``None``."""
    protocol = scene.protocol
    if scene.gripper.kind != "soft" or not isinstance(protocol, PullOffSection):
        return None
    from drivers.emulated.soft import SoftGripper
    from rig.emulation import is_rubber_film

    diameter = scene.substrate.diameter_mm if scene.substrate.shape == "sphere" else None
    gripper = SoftGripper(math.inf if diameter is None else diameter * 1e-3, rubber=is_rubber_film(scene))
    return gripper.pull_off_force((protocol.initial_pressure_kPa or 0.0) * 1e3)


def _strokes(scene: Scene, bench: Bench) -> list[str]:
    """The pump's strokes must stay within the syringe and the pressure limits."""
    protocol = scene.protocol
    if not isinstance(protocol, VolumeSection) or bench.pump is None:
        return []
    pumped = list(accumulate(protocol.strokes_ml))
    found = []
    reach, available = max(0.0, *pumped) - min(0.0, *pumped), usable_ml(bench.pump)
    if reach > available:
        found.append(f"strokes_ml: they span {reach:g} ml, {available:g} ml of the syringe can be used; shorten them")
    volume, atmosphere = scene.gripper.chamber_volume_ml, scene.gas.atmospheric_pressure_kPa
    low, high = bench.limits.pressure_low_kPa, bench.limits.pressure_high_kPa
    for amount in pumped:
        pressure = atmosphere * amount / (volume - amount) if amount < volume else float("inf")
        if not low <= pressure <= high:
            found.append(
                f"strokes_ml: {amount:+g} ml in the chamber make about {pressure:+.3g} kPa, the bench allows {low:g} "
                f"to {high:g} kPa; shorten the strokes"
            )
    return found


def _pressure(scene: Scene, bench: Bench) -> list[str]:
    protocol = scene.protocol
    pressure = protocol.initial_pressure_kPa if isinstance(protocol, PullOffSection | LeakSection) else None
    if pressure is None or bench.pump is None:
        return []
    low, high = bench.limits.pressure_low_kPa, bench.limits.pressure_high_kPa
    found = []
    if not low <= pressure <= high:
        found.append(
            f"initial_pressure_kPa = {pressure:g} lies outside the bench's {low:g} to {high:g} kPa; choose one within"
        )
    needed, available = needed_ml(scene, pressure), usable_ml(bench.pump)
    if needed > available:
        found.append(
            f"reaching {pressure:g} kPa takes about {needed:.2f} ml, {available:g} ml of the syringe can be used; "
            "fit a larger syringe"
        )
    return found


def _tare(scene: Scene, bench: Bench) -> list[str]:
    least = TARE_FRAMES * bench.daq.frame_s
    protocol = scene.protocol
    if not isinstance(protocol, ContactSection) or protocol.tare_s >= least:
        return []
    return [
        f"tare_s = {protocol.tare_s:g} is less than {TARE_FRAMES} frames of {bench.daq.frame_s * 1e3:g} ms; make it at "
        f"least {least:g} s or shorten frame_ms"
    ]


def _speeds(scene: Scene, bench: Bench) -> list[str]:
    """The look-ahead must outlast several frames, or the stage would stutter."""
    fastest = steady_speed(bench.limits.look_ahead_um, bench.daq.frame_s)
    keys = ("approach_speed_um_s", "retract_speed_um_s")
    return [
        f"{key} = {speed:g} is too fast for a look-ahead of {bench.limits.look_ahead_um:g} um in frames of "
        f"{bench.daq.frame_s * 1e3:g} ms (at most {fastest:g} um/s); lower it, shorten frame_ms or raise look_ahead_um"
        for key in keys
        if (speed := getattr(scene.protocol, key, 0.0)) > fastest
    ]


def _overruns(scene: Scene, bench: Bench) -> list[str]:
    """What the stage may travel too far, against a rigid stop, must not overload the cell.

    A limit that is passed stops it a frame and the reaction later; data that come late, as late as the bench allows,
    stop it so much after the preload; and if this program dies just before the preload, it goes on for the look-ahead.
    """
    protocol = scene.protocol
    if not isinstance(protocol, ContactSection):
        return []
    if bench.force.compliance_um_per_N == 0.0 and not isinstance(protocol, ComplianceSection):
        return [
            "force.compliance_um_per_N of the bench is 0: nobody knows how fast the force rises on contact; "
            "run the scene `compliance` and enter its result"
        ]
    limits, preload = bench.limits, protocol.preload_N + pressing_at_rest(bench)
    # compression_positive may be wrong: the larger limit may be the one that stops the approach
    key = max("compression_N", "tension_N", key=lambda name: float(getattr(limits, name)))
    found = _too_fast(
        "approach_speed_um_s",
        protocol.approach_speed_um_s,
        bench,
        {
            f"lower {key} or shorten frame_ms": return_speed(bench) * 1e6,
            "lower preload_N or shorten lag_s": room_um(bench, preload) / (reaction_s(bench) + limits.lag_s),
        },
    )
    furthest = room_um(bench, preload)
    if limits.look_ahead_um > furthest:
        found.append(
            f"look_ahead_um = {limits.look_ahead_um:g} would overload the load cell if this computer died at the "
            f"preload ({_stiffness(bench)}; at most {furthest:.3g} um); shorten it"
        )
    return found


def _retraction(scene: Scene, bench: Bench) -> list[str]:
    """The tension limit must stop the stage in time, even if the specimen were bonded rigidly."""
    protocol = scene.protocol
    if not isinstance(protocol, ContactSection):
        return []
    most = room_um(bench, bench.limits.tension_N) / reaction_s(bench)
    remedies = {"lower tension_N or shorten frame_ms": most}
    return _too_fast("retract_speed_um_s", protocol.retract_speed_um_s, bench, remedies)


def _too_fast(key: str, speed: float, bench: Bench, fastest: dict[str, float]) -> list[str]:
    """Return a reason for every speed (um/s) that is passed; its remedy names it."""
    return [
        f"{key} = {speed:g} can overload the load cell ({_stiffness(bench)}; at most {most:.3g} um/s); make it slower, "
        f"{remedy}"
        for remedy, most in fastest.items()
        if speed > most
    ]


def _stiffness(bench: Bench) -> str:
    known = bench.force.compliance_um_per_N
    words = f"1 N in {known or STIFFEST_UM_PER_N:g} um"
    return f"its force changes by {words}" if known else f"its compliance is unknown, {words} is assumed"


def pressing_at_rest(bench: Bench) -> float:
    """Return what the cell reads of compression with the gripper free, N."""
    return max(0.0, bench.force.at_rest_N)


def reaction_s(bench: Bench) -> float:
    """Return the longest time from a sample that passes a limit to the stop byte, s: its frame and the reaction."""
    return bench.daq.frame_s + REACTION_S


def room_um(bench: Bench, force: float) -> float:
    """Return how far the stage may go on from this force (N) against something rigid, um."""
    compliance = bench.force.compliance_um_per_N or STIFFEST_UM_PER_N
    return (OVERLOAD * bench.force.capacity_N - force) * compliance


def return_speed(bench: Bench) -> float:
    """Return the fastest speed (m/s) at which both force limits stop the stage in time, whatever it meets."""
    worst = max(bench.limits.compression_N, bench.limits.tension_N)
    return room_um(bench, worst) * 1e-6 / reaction_s(bench)


def parking(bench: Bench) -> Parking:
    """Return how the stage is brought to its starting height, so that it harms nothing that is in its way."""
    touch = TOUCH * bench.force.capacity_N
    start = bench.stage.start_mm
    return Parking(
        start=None if start is None else start * 1e-3,
        speed=min(PARK_SPEED, room_um(bench, touch + abs(bench.force.at_rest_N)) * 1e-6 / reaction_s(bench)),
        touch=touch,
    )
