"""The soft gripper. Empirical: the papers have no adhesion model for it, only the forces of PNAS SI Table S2.

Pull-off force between the two pressures of the table is a straight line; the force-distance law has the shape of a
universal binding curve, its distance is an assumption. Nothing here should be read as a prediction.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

from drivers.emulated.specimens import State, Surroundings, finish

TABLE_S2 = {
    15e-3: ((1.5e3, 0.18), (-51.0e3, 1.18), 0.6e-4),
    30e-3: ((0.6e3, 0.42), (-50.7e3, 2.70), 1.5e-4),
    60e-3: ((3.6e3, 0.49), (-52.1e3, 2.91), 2.5e-4),
    math.inf: ((1.7e3, 0.66), (-51.7e3, 3.61), 2.5e-4),
}
"""By sphere diameter (m; infinite is flat glass): (pressure, force) highest and lowest, contact area (Pa, N, m^2)."""

RUBBER = ((0.3e3, 0.08), (-50.9e3, 0.61), 2.5e-4)
"""The same on the flat rubber film."""

BREAKING = 3.0
"""The contact ends at so many times the distance of the largest force."""


@dataclass(frozen=True, slots=True)
class SoftGripper:
    """Soft gripper, after Table S2.

    Attributes
    ----------
    substrate_diameter
        Of the sphere, m; infinite is flat.
    distance
        Retraction at the largest force, m (assumed).
    compression
        Stiffness in compression, N/m (assumed).
    factor
        Of this specimen's force over the table's.
    rubber
        On the rubber film, not on glass.
    """

    substrate_diameter: float = math.inf
    distance: float = 1.2e-3
    compression: float = 1500.0
    factor: float = 1.0
    rubber: bool = False

    def pull_off_force(self, pressure: float) -> float:
        """Largest tension (N) at a chamber pressure (Pa), between table rows straight in the sphere's curvature."""
        if self.rubber:
            return self.factor * max(_line(RUBBER[0], RUBBER[1], pressure), 0.0)
        rows = sorted((1 / diameter, row) for diameter, row in TABLE_S2.items())
        curvature = min(1 / self.substrate_diameter, rows[-1][0])
        (flatter, below), (rounder, above) = next(
            pair for pair in itertools.pairwise(rows) if pair[0][0] <= curvature <= pair[1][0]
        )
        share = (curvature - flatter) / (rounder - flatter)
        forces = [_line(row[0], row[1], pressure) for row in (below, above)]
        return self.factor * max((1 - share) * forces[0] + share * forces[1], 0.0)

    def step(self, state: State, duration: float, around: Surroundings) -> State:
        """Balance the empirical law and the load train."""
        pressure, height, stiffness = around.closed_pressure, around.height, around.stiffness
        touching = height < 0.0
        if not touching and (state.radius == 0.0 or state.height > BREAKING * self.distance):
            return finish(state, duration, 0.0, pressure, height, 0.0, 0.0, 0.0)
        strongest = self.pull_off_force(pressure)
        loaded = state.height if state.radius else height
        for _ in range(100):
            correction = height + self._force(strongest, loaded) / stiffness - loaded
            loaded += correction
            if abs(correction) < 1e-12:
                break
        force = self._force(strongest, loaded)
        return finish(state, duration, force, pressure, loaded, math.sqrt(self._area / math.pi), 0.0, 0.0)

    @property
    def _area(self) -> float:
        if self.rubber:
            return RUBBER[2]
        nearest = min(TABLE_S2, key=lambda diameter: abs(1 / diameter - 1 / self.substrate_diameter))
        return TABLE_S2[nearest][2]

    def _force(self, strongest: float, height: float) -> float:
        if height < 0.0:
            return -self.compression * height
        stretched = height / self.distance
        return -strongest * stretched * math.exp(1 - stretched)


def _line(first: tuple[float, float], second: tuple[float, float], x: float) -> float:
    return first[1] + (second[1] - first[1]) * (x - first[0]) / (second[0] - first[0])
