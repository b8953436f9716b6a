"""Scenes at the edge of what can be typed into a scene file, and beyond what can be built."""

from __future__ import annotations

import math
import random

from model import Gas, GasAnchor, Gripper, Membrane, Parameters, Substrate

RANGES = {
    "d_b": (1e-3, 1e3),
    "E_m": (1e3, 1e9),
    "h_0": (1e-6, 5e-3),
    "omega_a": (1e-6, 100.0),
    "V_0": (1e-8, 1.0),
    "R_0": (1e-3, 50e-3),
}
"""Logarithmic ranges, SI."""

PRESSURE = (-101e3, 200e3)


def logarithmic(source: random.Random, low: float, high: float) -> float:
    """Return a number whose logarithm is evenly distributed."""
    return math.exp(source.uniform(math.log(low), math.log(high)))


def random_scene(source: random.Random) -> Parameters:
    """Return an extreme scene; one in three has a length that all but equals another."""
    R_0 = 8e-3 if source.random() < 0.5 else logarithmic(source, *RANGES["R_0"])
    r_e = R_0 * source.choice((0.9125, 1.0, 1 - 1e-9, source.uniform(0.05, 1.0)))
    if source.random() < 0.3:
        substrate = Substrate("flat", None if source.random() < 0.5 else logarithmic(source, 1e-3, 1.0))
    else:
        near = 2 * R_0 * source.choice((1.0, 1 + 1e-9, 1 - 1e-9, logarithmic(source, 0.8, 3.0)))
        substrate = Substrate("sphere", near if source.random() < 0.8 else logarithmic(source, *RANGES["d_b"]))
    adhesion = 0.0 if source.random() < 0.03 else logarithmic(source, *RANGES["omega_a"])
    pressure = source.choice(
        (0.0, source.uniform(*PRESSURE), source.uniform(-5e3, 5e3), -logarithmic(source, 1e-3, 1e5))
    )
    anchor = source.choice((GasAnchor.FREE, GasAnchor.START, GasAnchor.VENTED))
    return Parameters(
        substrate,
        Gripper(R_0, r_e, logarithmic(source, *RANGES["V_0"])),
        Membrane(logarithmic(source, *RANGES["E_m"]), logarithmic(source, *RANGES["h_0"]), adhesion),
        Gas(pressure, anchor=anchor),
    )


def ordinary_scene(source: random.Random) -> Parameters:
    """Return a scene within ten times of the papers' in everything, no lengths coinciding."""
    sphere = source.random() < 0.7
    return Parameters(
        Substrate("sphere", logarithmic(source, 17e-3, 200e-3)) if sphere else Substrate("flat"),
        Gripper(8e-3, source.uniform(4e-3, 7.9e-3), logarithmic(source, 2e-6, 1e-4)),
        Membrane(logarithmic(source, 2e5, 2e7), logarithmic(source, 2e-5, 2e-3), logarithmic(source, 0.4, 40.0)),
        Gas(source.uniform(-10e3, 10e3), anchor=source.choice((GasAnchor.FREE, GasAnchor.START, GasAnchor.VENTED))),
    )


def closed_at_start(scene: Parameters) -> bool:
    """Whether V(z_0, r_i) <= 0, by the printed equations (EML Eqs. 7-9, 12-14)."""
    from model.reference import start

    R_0, V_0 = scene.gripper.radius, scene.gripper.chamber_volume
    z, r = start(scene, float, math.sqrt)
    r_b = scene.substrate.radius
    h = 0.0 if math.isinf(r_b) else r_b - math.sqrt(max(r_b**2 - r**2, 0.0))
    cone = math.pi / 3 * (z + h) * (R_0**2 + r**2 + R_0 * r)
    return bool(V_0 + cone - math.pi * h / 6 * (3 * r**2 + h**2) <= 0)
