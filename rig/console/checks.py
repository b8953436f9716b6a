"""What is asked of a scene before anything moves, said line by line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from rig.bench import Bench, load_bench
from rig.check import needed_ml, reasons, usable_ml
from rig.errors import RigError
from rig.library import load_scene
from rig.protocols import build_steps
from rig.scene import Scene

if TYPE_CHECKING:
    from sequences.step import Apparatus


@dataclass(frozen=True)
class Checked:
    """A scene held against a bench: what was looked at, why it was refused (empty when it was not), and its steps."""

    scene: Scene | None
    emulated: bool
    findings: tuple[str, ...]
    refusals: tuple[str, ...]
    plan: tuple[str, ...] = ()

    @property
    def ready(self) -> bool:
        """Whether the scene may be run."""
        return self.scene is not None and not self.refusals


def check_scene(name: str, bench_path: Path | None) -> Checked:
    """Read scene and bench and hold one against the other. Opens and moves nothing."""
    try:
        scene, _ = load_scene(name)
        bench, _ = load_bench(bench_path)
    except RigError as error:
        return Checked(None, True, (), (str(error),))
    return Checked(scene, bench.is_emulated, tuple(_findings(scene, bench)), tuple(reasons(scene, bench)), _plan(scene))


def _plan(scene: Scene) -> tuple[str, ...]:
    """Return the names of the steps; planning touches no instrument, so none is given."""
    return tuple(step.name for step in build_steps(scene, cast("Apparatus", None)))


def _findings(scene: Scene, bench: Bench) -> list[str]:
    protocol, limits = scene.protocol, bench.limits
    found = [
        f"load cell {bench.force.cell}: {bench.force.capacity_N:g} N; "
        f"stops at {limits.compression_N:g} N compression, {limits.tension_N:g} N tension",
        f"travel {bench.stage.minimum_mm:g} to {bench.stage.maximum_mm:g} mm, "
        f"look-ahead {limits.look_ahead_um:g} \u00b5m",
    ]
    preload = getattr(protocol, "preload_N", None)
    if preload is not None:
        found.append(f"preload {preload:g} N of {min(limits.compression_N, bench.force.capacity_N):g} N")
    pressure = getattr(protocol, "initial_pressure_kPa", None)
    if pressure is not None and bench.pump is not None:
        found.append(
            f"P\u2080 {pressure:g} kPa within {limits.pressure_low_kPa:g} to {limits.pressure_high_kPa:g} kPa; "
            f"syringe: {needed_ml(scene, pressure):.2f} of {usable_ml(bench.pump):g} ml"
        )
    return found
