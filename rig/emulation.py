"""The emulated bench for a scene: the scene gives the geometry, the world keeps its own truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drivers.emulated.bench import EmulatedBench
    from drivers.emulated.truth import Truth
    from rig.scene import Scene
    from rig.session import Request


def emulated_bench(request: Request) -> EmulatedBench:
    """Return the emulated bench for a request; its servers start when their endpoints are asked for."""
    from drivers.emulated.bench import EmulatedBench

    return EmulatedBench(
        truth(request.scene, request.seed),
        seed=request.seed,
        speed=request.speed,
        faults=request.faults,
        wire=request.wire,
        pressure=request.scene.uses_pressure,
    )


def truth(scene: Scene, seed: int) -> Truth:
    """Return a world with the scene's geometry; its membrane is never the scene's."""
    from drivers.emulated.truth import Truth

    diameter = scene.substrate.diameter_mm
    return Truth.pull_off(
        scene.substrate.shape,
        None if diameter is None else diameter * 1e-3,
        radius=scene.gripper.radius_mm * 1e-3,
        effective_radius=scene.gripper.effective_radius_mm * 1e-3,
        chamber_volume=scene.gripper.chamber_volume_ml * 1e-6,
        vented=not scene.uses_pressure,
        seed=seed,
    )
