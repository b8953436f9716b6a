"""Cost of the emulated plant per 20 ms frame at 1 kHz, by phase of a pull-off test.

    python -m benchmarks.plant

CPU time of this process, so that a busy machine disturbs little; the last column is plant time over CPU time.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from drivers.emulated.plant import Plant
from drivers.emulated.truth import Truth

RATE = 1000.0
FRAME = 20


def measure(name: str, plant: Plant, until: Callable[[float], bool], frames: int, every: int = 0) -> None:
    """Advance by frames until a condition on the force holds, at most so many; redirect the stage every few frames."""
    target = plant.axis.target
    counted = 0
    spent = 0.0
    while counted < frames:
        begin = time.process_time()
        if every and counted % every == 0:
            step = 50e-6 if target > plant.axis.position else -50e-6
            plant.axis.move(plant.axis.position + step, 1e-5 if step > 0 else 1e-4, 0.1, 0.1)
        force = plant.advance(FRAME, RATE)["force"]
        spent += time.process_time() - begin
        counted += 1
        if until(float(force.mean())):
            break
    per_frame = spent / counted
    print(f"{name:36s} {counted:6d} frames {per_frame * 1e6:8.1f} us/frame {FRAME / RATE / per_frame:8.0f} x")


def main() -> None:
    plant = Plant(Truth.pull_off("sphere", 60e-3))
    plant.advance(FRAME, RATE)
    measure("at rest in the air", plant, lambda _: False, 1000)
    plant.axis.move(20.1e-3, 5e-3, 0.1, 0.1)
    measure("fast in the air", plant, lambda _: not plant.axis.moving, 1000)
    plant.axis.move(18e-3, 1e-4, 0.1, 0.1)
    measure("approach and contact at 100 um/s", plant, lambda force: force > 0.5, 3000)
    plant.axis.halt(0.1)
    measure("dwell in contact", plant, lambda _: False, 1000)
    plant.syringe.run(-50e-9, 0.35e-6)
    measure("pressurize", plant, lambda _: plant.syringe.rate == 0.0, 1000)
    plant.axis.move(22e-3, 1e-5, 0.1, 0.1)
    measure("retract at 10 um/s, one command", plant, lambda force: force < -0.3, 3000)
    measure("retract, redirected every 5th frame", plant, lambda _: plant.state.radius == 0.0, 10000, every=5)


if __name__ == "__main__":
    main()
