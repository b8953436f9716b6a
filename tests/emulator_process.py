"""The emulated bench in real time, in a process of its own, which keeps the plant's truth: run as a script.

Prints its endpoints as one line of JSON, then obeys what it reads: ``trip N`` lets the force pass its limit N samples
from now, ``clear`` ends that, anything else makes it print its log and end. A row of the log is (monotonic time,
samples, height m, volume displaced m^3, least and greatest true force N since the row before). Besides, it tells the
samples of the trips, and when the stage's stop bytes came in.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from typing import Any

from drivers.emulated.bench import EmulatedBench
from drivers.emulated.faults import Fault, Faults
from drivers.emulated.truth import Truth

GAP = 0.15e-3
"""Height of the gripper above the specimen at the start, m."""


def watched(bench: EmulatedBench, log: list[tuple[float, ...]]) -> None:
    """Note the plant's truth whenever its time moves on."""
    plant = bench.plant
    advance = plant.advance

    def advanced(samples: int, rate: float) -> Any:
        signals = advance(samples, rate)
        if samples:
            force = signals["force"]
            state = plant.axis.position, plant.syringe.volume
            log.append((time.monotonic(), plant.sample, *state, float(force.min()), float(force.max())))
        return signals

    plant.advance = advanced  # type: ignore[method-assign]


def noting_stops(bench: EmulatedBench, stops: list[float]) -> None:
    """Note when byte 24 reaches the stage's controller."""
    control = bench.controller.control

    def noted(byte: int) -> Any:
        if byte == 0x18:
            stops.append(time.monotonic())
        return control(byte)

    bench.controller.control = noted  # type: ignore[method-assign]


def main() -> None:
    """Serve until told to end."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--vented", action="store_true")
    arguments = parser.parse_args()
    truth = Truth.pull_off(seed=arguments.seed, vented=arguments.vented)
    truth = replace(truth, train=replace(truth.train, start_position=truth.train.contact_position + GAP))
    faults = Faults()
    trips: list[int] = []
    log: list[tuple[float, ...]] = []
    stops: list[float] = []
    with EmulatedBench(truth, seed=arguments.seed, speed=1.0, faults=faults, referenced=True, latency=5e-3) as bench:
        watched(bench, log)
        noting_stops(bench, stops)
        ends = bench.endpoints
        sys.stdout.write(json.dumps({"stage": ends.stage, "pump": ends.pump, "daq": ends.daq}) + "\n")
        sys.stdout.flush()
        for line in sys.stdin:
            word, _, number = line.strip().partition(" ")
            if word == "trip":
                trips.append(bench.plant.sample + int(number))
                faults.add(Fault("force", "over_range", at_sample=trips[-1], value=4.7))
            elif word == "clear":
                faults.clear()
            else:
                break
    sys.stdout.write(json.dumps({"log": log, "stops": stops, "trips": trips}) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
