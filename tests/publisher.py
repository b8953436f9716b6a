"""A synthetic run served through the real link, for the console's tests: no instruments, no loop.

In a process of its own: ``python tests/publisher.py --speed 20 [--no-pressure] [--fault] [--hold-at SAMPLE]``.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator

import numpy as np

from drivers.interfaces import PumpState, PumpStatus, StageStatus
from rig.link_server import LinkServer
from rig.live_prediction import Estimate, LivePrediction
from rig.observe import Controls, Ending, Event, RunInfo, StepEvent, StepPhase, StepPlan, Wish
from sequences.frame import Frame

RATE = 1000.0
SAMPLES = 20
FORCE_ZERO = 0.012
CONTACT = 20e-3
PULL_OFF_FORCE = 0.82
PULL_OFF_DISTANCE = 1.5e-3
SPEED = 100e-6

STEPS = (
    ("tare", "2 s without contact", 2.0),
    ("approach", "force above 10 mN", 5.0),
    ("preload", "force reaches 0.5 N", 2.0),
    ("dwell", "3 s at rest", 3.0),
    ("pressurize", "P_a = -3.2 kPa within 0.05 kPa", 4.0),
    ("retract", "the tension has passed its peak", 13.0),
    ("pull-off", "no force for 5 s", 8.0),
    ("return", "back at the starting height", 2.0),
)


def info(*, pressure: bool = True, repeat: int = 1, repeats: int = 1, recording: str = "") -> RunInfo:
    plan = tuple(StepPlan(name, words) for name, words, _ in STEPS if pressure or name != "pressurize")
    return RunInfo(
        title="60 mm glass sphere at \N{MINUS SIGN}3.2 kPa (Table S1)",
        protocol="pull_off",
        recording=recording,
        pid=os.getpid(),
        rate=RATE,
        frame_samples=SAMPLES,
        uses_pressure=pressure,
        plan=plan,
        limits={"force_compression_N": 3.0, "force_tension_N": 3.0, "travel_low_m": 1e-3, "travel_high_m": 51e-3},
        scene={"protocol": {"initial_pressure_kPa": -3.2 if pressure else None, "retract_speed_um_s": SPEED * 1e6}},
        identities={"stage": "C-863", "pump": "Legato", "daq": "USB-6211"},
        virtual=False,
        repeat=repeat,
        repeats=repeats,
    )


def truth(z: np.ndarray) -> np.ndarray:
    """F_r against z_r: compressive below 0, a rounded peak, a fold."""
    u = np.clip(z / PULL_OFF_DISTANCE, -0.4, None)
    pulled = -PULL_OFF_FORCE * np.sin(np.clip(u, 0, 1) * 0.86 * np.pi) ** 0.8
    return np.where(z < 0, -1250.0 * z, np.where(u < 1, pulled, 0.0))


def prediction(frame: Frame, z_now: float) -> LivePrediction:
    known = min(max(z_now / PULL_OFF_DISTANCE, 0.0), 1.0)
    spread = 0.12 * (1 - known) + 0.015
    z = np.linspace(-0.2e-3, 1.05 * PULL_OFF_DISTANCE, 90)
    force = truth(z) * (1 + 0.4 * spread)
    width = spread * PULL_OFF_FORCE * np.clip((z - z_now) / PULL_OFF_DISTANCE + 0.1, 0.05, 1)

    def around(value: float) -> Estimate:
        return Estimate(value * (1 + 0.2 * spread), value * (1 - spread), value * (1 + spread))

    return LivePrediction(
        frame.number, frame.stop, "cone", z, force, force - width, force + width,
        -3200 - 4e5 * z, -3200 - 4e5 * z - 60, -3200 - 4e5 * z + 60,
        around(PULL_OFF_FORCE), around(PULL_OFF_DISTANCE), around(4.0),
        Estimate(FORCE_ZERO, FORCE_ZERO - 1e-3, FORCE_ZERO + 1e-3), CONTACT, True, "", known,
        {"pull_off_force": 3e-12, "pull_off_distance": 2e-14}, 1.3e-3,
    )  # fmt: skip


def run(*, pressure: bool = True, seed: int = 0, fault_at: int | None = None) -> Iterator[object]:
    """Yield what a run tells its observers, in order: StepEvent, Frame, LivePrediction, Event, and the Ending."""
    random = np.random.default_rng(seed)
    sample = number = 0
    height = CONTACT + 0.5e-3
    air = 0.0
    for name, _, seconds in STEPS:
        if name == "pressurize" and not pressure:
            continue
        yield StepEvent(StepPhase.STARTED, name, sample)
        yield Event(sample, "command", f"stage: {name}")
        begin = height
        end = {
            "approach": CONTACT, "preload": CONTACT - 0.4e-3, "retract": begin + seconds * SPEED,
            "pull-off": begin + seconds * SPEED, "return": CONTACT + 0.5e-3,
        }.get(name, begin)  # fmt: skip
        frames = int(seconds * RATE / SAMPLES)
        for step in range(frames):
            if fault_at is not None and sample >= fault_at:
                words = (
                    "force: interlock: -3.104 N exceeds the tension limit -3 N in step retract. "
                    "Remedy: reset the force, look at the sample, lower the preload or raise tension_N."
                )
                yield Event(sample, "interlock", words)
                yield StepEvent(StepPhase.ENDED, name, sample, "interlock")
                yield Ending(words, 3, sample)
                return
            path = begin + (end - begin) * (step + np.arange(1, SAMPLES + 1) / SAMPLES) / frames
            height = float(path[-1])
            touched = name not in ("tare", "approach", "return")
            force = FORCE_ZERO + random.normal(0, 2e-3, SAMPLES) + (truth(path - CONTACT) if touched else 0.0)
            air += (-3200.0 - air) * 0.02 if name == "pressurize" else 0.0
            stretch = 4e5 * np.clip(path - CONTACT, 0, PULL_OFF_DISTANCE) if name == "retract" else 0.0
            gas = air - stretch + random.normal(0, 6.0, SAMPLES)
            now = (sample + SAMPLES) / RATE
            stage = StageStatus(now, now, height, end != begin, end == begin, True, False, False)
            state = PumpState.WITHDRAWING if name == "pressurize" else PumpState.IDLE
            flow = -4e-9 if name == "pressurize" else 0.0
            pump = PumpStatus(now, now, state, flow, 7e-11 * air) if pressure else None
            volts = np.zeros((2 if pressure else 1, SAMPLES))
            frame = Frame(number, sample, RATE, volts, force, gas if pressure else None, stage, pump)
            yield frame
            sample, number = frame.stop, number + 1
            if step % 5 == 0:
                value, target, unit = {
                    "preload": (float(force.mean()) - FORCE_ZERO, 0.5, "N"),
                    "pressurize": (air, -3200.0, "Pa"),
                    "retract": (float(force.mean()) - FORCE_ZERO, -0.6, "N"),
                }.get(name, (step * SAMPLES / RATE, seconds, "s"))
                yield StepEvent(StepPhase.PROGRESS, name, sample, "", value, target, unit)
            if name == "retract" and step % 10 == 0:
                yield prediction(frame, height - CONTACT)
        yield StepEvent(StepPhase.ENDED, name, sample, "done")
    yield Ending("done", 0, sample, {"pull_off_force_N": PULL_OFF_FORCE, "pull_off_distance_m": PULL_OFF_DISTANCE})


def publish(server: LinkServer, controls: Controls, speed: float, *, pressure: bool, fault_at: int | None) -> Wish:
    """Tell the server a run in time; return what ended it."""
    server.started(info(pressure=pressure))
    begin, paused = time.monotonic(), False
    for told in run(pressure=pressure, fault_at=fault_at):
        if isinstance(told, Frame):
            wish = controls.take()
            while wish is Wish.HOLD or (paused and wish is Wish.NONE):
                if wish is Wish.HOLD:
                    server.event(Event(told.start, "operator", "hold"))
                paused = True
                held = time.monotonic()
                time.sleep(0.02)
                begin += time.monotonic() - held
                wish = controls.take()
            if paused:
                server.event(Event(told.start, "operator", "resume"))
            paused = False
            if wish in (Wish.STOP, Wish.EMERGENCY):
                server.event(Event(told.start, "operator", wish.value))
                server.finished(Ending(f"{wish.value} by the operator", 130, told.start))
                return wish
            time.sleep(max(0.0, begin + told.time / speed - time.monotonic()))
            server.frame(told)
        elif isinstance(told, StepEvent):
            server.step(told)
        elif isinstance(told, Event):
            server.event(told)
        elif isinstance(told, LivePrediction):
            server.prediction(told)
        elif isinstance(told, Ending):
            server.finished(told)
    return Wish.NONE


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--no-pressure", action="store_true")
    parser.add_argument("--fault-at", type=int)
    parser.add_argument("--linger", type=float, default=1.0)
    told = parser.parse_args()
    controls = Controls()
    with LinkServer(controls) as server:
        publish(server, controls, told.speed, pressure=not told.no_pressure, fault_at=told.fault_at)
        time.sleep(told.linger)


if __name__ == "__main__":
    main()
