"""Fibres on a rigid backing: a few single ones (PNAS SI S5), and a whole array on a punch (EML 2020 Fig. 3e)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.emulated.specimens import State, Surroundings, finish


@dataclass(frozen=True, slots=True)
class FewFibers:
    """Single fibres under a sphere that is flat to them; each is a spring that lets go at its own force.

    Attributes
    ----------
    fiber_stiffness
        N/m of one fibre.
    strengths
        N, at which each lets go.
    heights
        How far each stands out beyond the lowest, m.
    """

    fiber_stiffness: float = 215.0
    strengths: tuple[float, ...] = (0.60e-3, 0.63e-3, 0.64e-3)
    heights: tuple[float, ...] = (0.0, 0.15e-6, 0.3e-6)

    def step(self, state: State, duration: float, around: Surroundings) -> State:
        """Balance the holding fibres with the load train; ``state.stretch`` is the set of those that hold, as bits."""
        holding = int(state.stretch)
        height, stiffness = around.height, around.stiffness
        force, loaded = self._balance(holding, height, stiffness)
        while (changed := self._change(holding, loaded)) != holding:
            holding = changed
            force, loaded = self._balance(holding, height, stiffness)
        radius = 37e-6 * math.sqrt(holding.bit_count())
        return finish(state, duration, force, around.closed_pressure, loaded, radius, 0.0, float(holding))

    def _balance(self, holding: int, height: float, stiffness: float) -> tuple[float, float]:
        heights = [tip for fiber, tip in enumerate(self.heights) if holding >> fiber & 1]
        k = self.fiber_stiffness
        loaded = (height + k * sum(heights) / stiffness) / (1 + k * len(heights) / stiffness)
        return k * (sum(heights) - loaded * len(heights)), loaded

    def _change(self, holding: int, loaded: float) -> int:
        """Fibres that touch begin to hold; of those beyond their strength the weakest lets go."""
        overload = 1.0
        weakest = -1
        for fiber, (strength, tip) in enumerate(zip(self.strengths, self.heights, strict=True)):
            if not holding >> fiber & 1:
                if loaded < tip:
                    return holding | 1 << fiber
            elif (load := self.fiber_stiffness * (loaded - tip) / strength) > overload:
                overload, weakest = load, fiber
        return holding if weakest < 0 else holding & ~(1 << weakest)


@dataclass(frozen=True, slots=True)
class RigidPunch:
    """An array of fibres on a rigid, slightly tilted disk: equal load sharing up to the tilt.

    The fibres are a bed of springs. They let go where they are stretched beyond their strength, so the contact
    shrinks from the high side; where it can no longer carry the load train's pull it snaps.

    Attributes
    ----------
    radius
        Of the disk, m.
    bed_stiffness
        Pa/m.
    strength
        Pa.
    tilt
        rad.
    """

    radius: float = 7.3e-3
    bed_stiffness: float = 1e8
    strength: float = 14e3
    tilt: float = 2e-3

    _SCAN = 1000

    def step(self, state: State, duration: float, around: Surroundings) -> State:
        """Balance bed and load train; ``state.stretch`` is where the contact ends, over the disk's radius, plus 1."""
        edge = state.stretch - 1.0
        height, stiffness = around.height, around.stiffness
        start = min(state.height, height) if edge <= -1.0 else state.height
        loaded = self._balance(edge, start, height, stiffness)
        edge = self._edge(edge, loaded)
        area, _ = self._segment(edge)
        radius = math.sqrt(area / math.pi)
        force = (loaded - height) * stiffness
        return finish(state, duration, force, around.closed_pressure, loaded, radius, 0.0, edge + 1.0)

    def _edge(self, edge: float, height: float) -> float:
        """Where the contact ends across the disk (-1 nowhere, 1 everywhere) after standing at ``height``."""
        lift = self.tilt * self.radius
        touching = -height / lift
        holding = (self.strength / self.bed_stiffness - height) / lift
        return max(-1.0, min(max(edge, touching), holding, 1.0))

    def _segment(self, edge: float) -> tuple[float, float]:
        """Area (m^2) and first moment (m^3) of the part of the disk below ``edge``."""
        half = math.sqrt(1 - edge * edge)
        area = self.radius**2 * (math.pi - math.acos(edge) + edge * half)
        return area, -2 / 3 * (self.radius * half) ** 3

    def _force(self, edge: float, height: float) -> float:
        area, moment = self._segment(edge)
        return -self.bed_stiffness * (height * area + self.tilt * moment)

    def _balance(self, edge: float, start: float, height: float, stiffness: float) -> float:
        """The first height on the way from ``start`` at which bed and load train balance."""

        def excess(place: float) -> float:
            return place - height - self._force(self._edge(edge, place), place) / stiffness

        if edge <= -1.0 and height >= self.tilt * self.radius:
            return height
        begin = excess(start)
        if begin == 0.0:
            return start
        stride = math.copysign(self.strength / self.bed_stiffness / self._SCAN, -begin)
        here = start
        while excess(here + stride) * begin > 0.0:
            here += stride
            if abs(here - start) > 20 * abs(stride) and self._edge(edge, here) <= -1.0:
                return height  # nothing holds any more
        near, far = here, here + stride
        for _ in range(30):
            middle = 0.5 * (near + far)
            near, far = (middle, far) if excess(middle) * begin > 0.0 else (near, middle)
        return 0.5 * (near + far)
