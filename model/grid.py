"""The papers' own method, for comparison: tabulate the energy on heights times radii and difference it.

PNAS 2017 SI, Fig. S8: 20,001 heights and 50,001 radii, central differences. Vectorised over the radii, with
everything that depends on the radius alone computed once, so that the comparison is fair to it.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from model.errors import NotConverged
from model.parameters import GasAnchor, Parameters
from model.prediction import Array
from model.start import check, start_position, start_radius

PAPER_GRID = (20_001, 50_001)
"""Heights and radii of the papers."""


@dataclass(frozen=True)
class GridResult:
    """Features read off the grid, SI units, and what they cost."""

    pull_off_force: float
    pull_off_distance: float
    detachment_position: float
    zero_force_position: float
    evaluations: int
    """Evaluations of the energy."""
    runtime_s: float


class EnergyTable:
    """EML Eq. 1 on a row of radii; ``dtype`` float32 shows what single precision leaves of it."""

    def __init__(self, parameters: Parameters, contact_stretch: bool, radii: int, dtype: Any = np.float64) -> None:
        scene, real = parameters, np.dtype(dtype).type
        R_0 = scene.gripper.radius
        self.r = np.linspace(0, start_radius(scene.substrate, scene.gripper), radii).astype(dtype)
        if self.r[-1] >= R_0:
            self.r[-1] = self.r[-1] * real(1 - 4 * np.finfo(dtype).eps)
        self.stiffness = real(math.pi * scene.membrane.thickness * scene.membrane.youngs_modulus / 6)
        self.ring = real(R_0**2) - self.r**2
        self.width = (real(R_0) - self.r) ** 2
        self.area = real(math.pi / 3) * (real(R_0**2) + self.r**2 + real(R_0) * self.r)
        self.fixed = -real(math.pi * scene.membrane.work_of_adhesion) * self.r**2
        self.h, self.cap = np.zeros_like(self.r), np.zeros_like(self.r)
        if scene.substrate.shape == "sphere":
            self._add_sphere(real(scene.substrate.radius), contact_stretch)
        self.V_0 = real(scene.gripper.chamber_volume)
        gas = scene.gas
        self.vented = gas.anchor is GasAnchor.VENTED
        self.P_0, self.P_atm, self.anchor = real(gas.initial_pressure), real(gas.atmospheric_pressure), self.V_0
        if gas.anchor is GasAnchor.START:
            z_0 = real(start_position(scene.substrate, scene.gripper))
            self.anchor = self.V_0 + (z_0 + self.h[-1]) * self.area[-1] - self.cap[-1]

    def _add_sphere(self, r_b: Any, contact_stretch: bool) -> None:
        self.h = self.r**2 / (r_b + np.sqrt(r_b**2 - self.r**2))
        self.cap = self.r.dtype.type(math.pi / 6) * self.h * (3 * self.r**2 + self.h**2)
        if contact_stretch:
            u = np.maximum(self.r / r_b, np.finfo(self.r.dtype).tiny)
            stretch = (np.arcsin(u) / u) ** 2
            self.fixed = self.fixed + self.stiffness * self.r**2 * (stretch + 1 / stretch - 2)

    def differences(self, below: Array, here: Array, above: Array, step: float) -> None:
        """Nothing: the derivatives are taken at the contact only."""

    def row(self, z: float) -> Array:
        """Return Pi(r, z) for all radii."""
        d = self.r.dtype.type(z) + self.h
        stretch = 1 + d * d / self.width
        growth = d * self.area - self.cap
        energy = self.stiffness * self.ring * (stretch + 1 / stretch - 2) + self.fixed
        if self.vented:
            result: Array = energy - self.P_0 * growth
            return result
        volume = self.V_0 + growth
        work = self.P_atm * (volume - self.anchor) - (self.P_atm + self.P_0) * self.anchor * np.log(
            volume / self.anchor
        )
        total: Array = energy + work
        return total


class DescribedTable(EnergyTable):
    """The same row by row, with nothing kept from one row to the next."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._arguments = arguments

    def row(self, z: float) -> Array:
        """Return Pi(r, z) for all radii, every factor of it evaluated anew."""
        return EnergyTable(*self._arguments).row(z)

    def differences(self, below: Array, here: Array, above: Array, step: float) -> None:
        """Evaluate both derivatives at all radii."""
        np.gradient(here, self.r)
        np.divide(np.subtract(above, below), 2 * step)


def solve(
    parameters: Parameters,
    *,
    contact_stretch: bool = True,
    positions: int = PAPER_GRID[0],
    radii: int = PAPER_GRID[1],
    dtype: Any = np.float64,
    as_described: bool = False,
) -> GridResult:
    """Read the features off a grid of ``positions`` heights times ``radii`` contact radii.

    ``as_described`` evaluates the energy as printed at every point of the grid and both of its derivatives
    everywhere; otherwise what depends on the radius alone is computed once, and the force at the contact only.

    Raises
    ------
    NotConverged
        The grid is too coarse to hold the contact at all.
    """
    begin = time.perf_counter()
    check(parameters)
    start = start_position(parameters.substrate, parameters.gripper)
    coarse = EnergyTable(parameters, contact_stretch, 501)
    reach = 4 * parameters.gripper.radius
    for _ in range(24):
        detached = _walk(coarse, np.linspace(start, start + reach, 401))[2]
        if detached > start + reach / 4:
            break
        reach /= 2
    heights = np.linspace(start, detached + 2 * reach / 400, positions)
    table: EnergyTable = (DescribedTable if as_described else EnergyTable)(parameters, contact_stretch, radii, dtype)
    force, zero, detachment, evaluations = _walk(table, heights)
    if not math.isfinite(force):
        raise NotConverged(f"a grid of {positions} x {radii} does not resolve the contact")
    return GridResult(-force, detachment - zero, detachment, zero, evaluations, time.perf_counter() - begin)


def _walk(table: EnergyTable, heights: Array) -> tuple[float, float, float, int]:
    """Follow the critical radius row by row; return peak force, z of zero force, z of detachment, evaluations."""
    step = float(heights[1] - heights[0])
    below, here = table.row(heights[0] - step), table.row(heights[0])
    index = table.r.size - 1
    lowest, zero, last, detachment, rows = math.inf, math.nan, math.nan, float(heights[0]), 2
    for z in heights:
        above = table.row(z + step)
        rows += 1
        table.differences(below, here, above, step)
        index = _critical(here, index)
        if index < 0:
            break
        force = -float(above[index] - below[index]) / (2 * step)
        if math.isnan(zero) and force < 0:
            zero = float(z) if math.isnan(last) or last <= 0 else float(z) - step * force / (force - last)
        lowest, last, detachment = min(lowest, force), force, float(z)
        below, here = here, above
    return lowest, zero, detachment, rows * table.r.size


def _critical(row: Array, index: int) -> int:
    """Return the largest radius up to ``index`` at which dPi/dr < 0: pinned, or the largest stable root; -1 if none."""
    after = row[1 : index + 2] if index + 1 < row.size else np.append(row[1:], row[-1])
    before = np.append(row[:1], row[:index])
    falling = np.flatnonzero(after < before)
    return int(falling[-1]) if falling.size else -1
