"""Scenes to sequences: each protocol's settings in SI, and its steps."""

from __future__ import annotations

from drivers.interfaces import Pump, Stage
from rig.bench import Bench
from rig.check import AT_REST, return_speed, room_um
from rig.scene import (
    ComplianceSection,
    ContactSection,
    DeadWeightsSection,
    LeakSection,
    PressureZeroSection,
    PullOffSection,
    Scene,
    VolumeSection,
)
from sequences import calibration, chamber
from sequences.pressurize import Chamber
from sequences.pull_off import PullOff, PullOffSettings
from sequences.step import Apparatus, Step, Teller, by_hand


def apparatus_of(bench: Bench, stage: Stage, pump: Pump | None, tell: Teller) -> Apparatus:
    """Return what the steps act on, with the bench's look-ahead, frames and load cell."""
    return Apparatus(
        stage,
        pump,
        tell,
        look_ahead=bench.limits.look_ahead_um * 1e-6,
        frame=bench.daq.frame_s,
        room=lambda force: room_um(bench, force) * 1e-6,
        lowest_contact=bench.stage.lowest_m,
        at_rest=bench.force.at_rest_N,
        at_rest_within=AT_REST * bench.force.capacity_N,
        return_speed=return_speed(bench),
    )


def build_steps(scene: Scene, apparatus: Apparatus, hands: str = "") -> list[Step]:
    """Return the steps of the scene's protocol; ``hands`` is what the operator is asked to do before the first."""
    steps = _protocol_steps(scene, apparatus)
    return [by_hand(apparatus, "place", "the operator goes on", hands), *steps] if hands else steps


def _protocol_steps(scene: Scene, apparatus: Apparatus) -> list[Step]:
    protocol = scene.protocol
    if isinstance(protocol, VolumeSection):
        strokes = [stroke * 1e-6 for stroke in protocol.strokes_ml]
        return chamber.volume(apparatus, _chamber(scene), strokes, protocol.settle_s)
    if isinstance(protocol, LeakSection):
        pressure, tolerance = protocol.initial_pressure_kPa * 1e3, protocol.pressure_tolerance_kPa * 1e3
        return chamber.leak(apparatus, _chamber(scene), pressure, tolerance, protocol.hold_s)
    if isinstance(protocol, DeadWeightsSection):
        masses = [mass * 1e-3 for mass in protocol.masses_g]
        return calibration.dead_weights(apparatus, masses, protocol.rest_s)
    if isinstance(protocol, PressureZeroSection):
        return calibration.pressure_zero(apparatus, protocol.rest_s)
    test = PullOff(apparatus, contact_settings(scene, protocol))
    if isinstance(protocol, ComplianceSection):
        back = calibration.unload(apparatus, protocol.retract_speed_um_s * 1e-6, protocol.unload_um * 1e-6)
        stop = by_hand(apparatus, "place", "the operator goes on", "Put the rigid stop under the probe")
        return [stop, *test.contact_steps(), back]
    return test.steps()


def contact_settings(scene: Scene, protocol: ContactSection) -> PullOffSettings:
    """Return the settings of a test that touches a sample, SI."""
    gas = protocol if isinstance(protocol, PullOffSection) else PullOffSection()
    pressure = gas.initial_pressure_kPa
    return PullOffSettings(
        preload=protocol.preload_N,
        approach_speed=protocol.approach_speed_um_s * 1e-6,
        retract_speed=protocol.retract_speed_um_s * 1e-6,
        dwell=protocol.preload_dwell_s,
        tare=protocol.tare_s,
        contact_force=protocol.contact_force_mN * 1e-3,
        initial_pressure=None if pressure is None else pressure * 1e3,
        pressure_tolerance=gas.pressure_tolerance_kPa * 1e3,
        chamber_volume=scene.gripper.chamber_volume_ml * 1e-6,
        atmospheric_pressure=scene.gas.atmospheric_pressure_kPa * 1e3,
    )


def _chamber(scene: Scene) -> Chamber:
    return Chamber(scene.gripper.chamber_volume_ml * 1e-6, scene.gas.atmospheric_pressure_kPa * 1e3)
