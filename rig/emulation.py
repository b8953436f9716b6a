"""The emulated bench for a scene: the scene gives the geometry, the world keeps its own truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from rig.observe import Controls, Event, Observer

if TYPE_CHECKING:
    from drivers.emulated.bench import EmulatedBench
    from drivers.emulated.electronics import Device
    from drivers.emulated.truth import Truth
    from rig.bench import Bench, StageSection
    from rig.scene import Scene
    from rig.session import Request


def emulated_bench(request: Request) -> EmulatedBench:
    """Return the emulated bench for a request; its servers start when their endpoints are asked for."""
    from drivers.emulated.bench import EmulatedBench

    return EmulatedBench(
        _left_on(truth(request.scene, request.seed), request.bench.stage),
        seed=request.seed,
        speed=request.speed,
        faults=request.faults,
        referenced=request.referenced or request.bench.stage.left_on,
        wire=request.wire,
        pressure=request.scene.uses_pressure,
        device=_device(request.bench),
    )


def _left_on(world: Truth, stage: StageSection) -> Truth:
    """Return the world with its stage where the bench says that it was left."""
    if not stage.left_on or stage.start_mm is None:
        return world
    return replace(world, train=replace(world.train, start_position=stage.start_mm * 1e-3))


def is_rubber_film(scene: Scene) -> bool:
    """Whether the substrate is the flat rubber film of Table S2."""
    return scene.substrate.shape == "flat" and scene.substrate.material.casefold() == "rubber film"


def truth(scene: Scene, seed: int) -> Truth:
    """Return a world with the scene's geometry; its membrane is never the scene's."""
    from drivers.emulated.chamber import Chamber
    from drivers.emulated.specimens import DeadWeight, RigidStop
    from drivers.emulated.truth import Truth

    gripper = scene.gripper
    diameter = None if scene.substrate.diameter_mm is None else scene.substrate.diameter_mm * 1e-3
    volume = gripper.chamber_volume_ml * 1e-6
    special: dict[str, Callable[[], Truth]] = {
        "indentation": lambda: Truth.indentation(seed=seed),
        "fiber": lambda: Truth.fibers(seed=seed),
        "punch": lambda: Truth.punch(radius=gripper.effective_radius_mm * 1e-3, seed=seed),
        "volume": lambda: Truth.closed(chamber_volume=volume, seed=seed),
        "leak": lambda: Truth.closed(chamber_volume=volume, seed=seed),
        "pressure_zero": lambda: Truth.closed(chamber_volume=volume, seed=seed),
        "compliance": lambda: Truth(RigidStop(), Chamber(vented=True)),
        "dead_weights": lambda: Truth(DeadWeight(0.0), Chamber(vented=True)),
    }
    kind = "punch" if gripper.kind == "punch" else scene.protocol.name
    if kind in special:
        return special[kind]()
    if gripper.kind == "soft":
        sphere, rubber = scene.substrate.shape == "sphere", is_rubber_film(scene)
        return Truth.soft(diameter if sphere else None, rubber=rubber, chamber_volume=volume, seed=seed)
    return Truth.pull_off(
        scene.substrate.shape,
        diameter,
        radius=gripper.radius_mm * 1e-3,
        effective_radius=gripper.effective_radius_mm * 1e-3,
        chamber_volume=volume,
        vented=not scene.uses_pressure,
        seed=seed,
    )


def _device(bench: Bench) -> Device:
    """Return the DAQ with the load cell the bench names; its noise is that of its capacity."""
    from drivers.emulated.electronics import Cell, usb_6211

    force = bench.force
    cell = Cell(
        name=force.cell,
        capacity=force.capacity_N,
        sensitivity=1 / force.calibration.slope,
        noise=4e-5 * force.capacity_N,
    )
    return usb_6211(cell=cell)


def weights(scene: Scene) -> list[float]:
    """Return what the operator hangs on the gripper in a scene, prompt by prompt, kg."""
    from rig.scene import DeadWeightsSection
    from sequences.calibration import weighing_order

    protocol = scene.protocol
    return (
        weighing_order([mass * 1e-3 for mass in protocol.masses_g]) if isinstance(protocol, DeadWeightsSection) else []
    )


class Hands(Observer):
    """The emulated operator: hangs the next mass (kg), if any, whenever a prompt asks, and lets the run go on."""

    def __init__(self, controls: Controls, world: EmulatedBench, masses: Iterable[float] = ()) -> None:
        self._controls = controls
        self._world = world
        self._masses = iter(masses)

    def event(self, event: Event) -> None:
        """Answer a prompt."""
        if event.kind != "prompt":
            return
        mass = next(self._masses, None)
        if mass is not None:
            from drivers.emulated.specimens import DeadWeight

            self._world.plant.mount(DeadWeight(mass))
        self._controls.resume()
