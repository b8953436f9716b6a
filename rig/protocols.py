"""Scenes to sequences: each protocol's settings in SI, and its steps."""

from __future__ import annotations

from rig.scene import PullOffSection, Scene
from sequences.pull_off import PullOff, PullOffSettings
from sequences.step import Apparatus, Step


def build_steps(scene: Scene, apparatus: Apparatus) -> list[Step]:
    """Return the steps of the scene's protocol."""
    return PullOff(apparatus, _pull_off(scene, scene.protocol)).steps()


def _pull_off(scene: Scene, protocol: PullOffSection) -> PullOffSettings:
    pressure = protocol.initial_pressure_kPa
    return PullOffSettings(
        preload=protocol.preload_N,
        approach_speed=protocol.approach_speed_um_s * 1e-6,
        retract_speed=protocol.retract_speed_um_s * 1e-6,
        dwell=protocol.preload_dwell_s,
        tare=protocol.tare_s,
        contact_force=protocol.contact_force_mN * 1e-3,
        initial_pressure=None if pressure is None else pressure * 1e3,
        pressure_tolerance=protocol.pressure_tolerance_kPa * 1e3,
        chamber_volume=scene.gripper.chamber_volume_ml * 1e-6,
        atmospheric_pressure=scene.gas.atmospheric_pressure_kPa * 1e3,
    )
