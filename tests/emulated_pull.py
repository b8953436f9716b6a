"""A pull-off test played by hand on a plant, without instruments, sequence or loop."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drivers.emulated.plant import Plant
from drivers.emulated.truth import Disturbance, Truth

RATE = 1000.0
STILL = Disturbance(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 5.0, 0.0, 0.0)


def still(truth: Truth, **train: float) -> Truth:
    """The same world without noise, drift or relaxation."""
    return replace(truth, disturbance=STILL, train=replace(truth.train, **{"relaxing": 0.0, **train}))


@dataclass
class Pull:
    """What a test yields: arrays over samples of the retraction, and of the whole cycle."""

    plant: Plant
    force: np.ndarray
    height: np.ndarray
    started: int
    gone: int

    @property
    def pull_off_force(self) -> float:
        return float(-self.force[self.started :].min())

    @property
    def pull_off_distance(self) -> float:
        crossing = self.started + int(np.argmax(self.force[self.started :] < 0))
        return float(self.height[self.gone] - self.height[crossing])

    @property
    def work(self) -> float:
        """Work put into the specimen over the whole cycle, J."""
        return float(-np.trapezoid(self.force, self.height))


def pull(
    truth: Truth, pressure: float | None = None, *, preload: float = 0.5, speed: float = 1e-5, samples: int = 20
) -> Pull:
    """Approach, preload, rest, set the pressure, retract until the contact is gone, and 0.2 mm on."""
    plant = Plant(truth)
    forces: list[np.ndarray] = []
    heights: list[float] = []

    def advance() -> float:
        measured = plant.advance(samples, RATE)["force"]
        forces.append(measured[-1:])
        heights.append(plant.state.height)
        return float(measured.mean())

    plant.axis.move(truth.train.contact_position + 50e-6, 5e-3, 1.0, 1.0)
    while plant.axis.moving:
        advance()
    plant.axis.move(truth.train.contact_position - 4e-3, 1e-4, 1e-2, 1e-2)
    while advance() < preload:
        assert plant.axis.moving
    plant.axis.halt(1e-2)
    for _ in range(100):
        advance()
    for _ in range(100 if pressure is not None else 0):
        missing = pressure - plant.state.pressure
        if abs(missing) < 20:
            break
        volume = 0.8 * missing / 101.3e3 * truth.chamber.volume
        plant.syringe.run(np.sign(volume) * 1e-7, abs(volume))
        while plant.syringe.rate:
            advance()
    started = len(forces)
    plant.axis.move(plant.axis.position + 6e-3, speed, 1e-2, 1e-2)
    while plant.state.radius > 0.0:
        advance()
        assert plant.axis.moving
    gone = len(forces) - 1
    leaving = plant.axis.position + 0.2e-3
    while plant.axis.position < leaving:
        advance()
    return Pull(plant, np.concatenate(forces), np.array(heights), started, gone)
