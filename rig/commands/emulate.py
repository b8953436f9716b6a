"""``rig emulate``: serve the emulated instruments to any client, in real time, until Ctrl-C."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.commands import SCENE, natural

if TYPE_CHECKING:
    from drivers.emulated.truth import Truth

LATENCY = 5e-3
"""Delay of every reply of stage and pump, s, as on a serial line."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--pty", action="store_true", help="serve stage and pump on pseudo-terminals too (POSIX)")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="times real time (default: 1)")
    parser.add_argument("--faults", type=Path, metavar="FILE", help="fault script (TOML)")
    parser.add_argument("--scene", metavar="SCENE", help=f"what to pull off: {SCENE} (default: 60 mm sphere)")
    parser.add_argument("--seed", type=natural, default=0, help="which specimen and which noise")


def run(arguments: argparse.Namespace) -> int:
    """Print the endpoints as one line of JSON, then serve."""
    import signal
    import time

    from drivers.emulated.bench import EmulatedBench
    from rig.errors import FileError
    from rig.fault_script import load_faults

    if not 0 < arguments.speed <= 1000:
        raise FileError(f"--speed {arguments.speed:g}: must be above 0 and at most 1000. Remedy: e.g. --speed 1.")
    ended: list[int] = []  # not an event: the handler may run while this thread holds its lock
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: ended.append(number))
    faults = None if arguments.faults is None else load_faults(arguments.faults)
    bench = EmulatedBench(
        _truth(arguments.scene, arguments.seed),
        seed=arguments.seed,
        speed=arguments.speed,
        faults=faults,
        latency=LATENCY,
    )
    with bench:
        print(json.dumps(_endpoints(bench, arguments.pty)), flush=True)
        while not ended:
            time.sleep(0.1)
    return 0


def _truth(scene: str | None, seed: int) -> Truth:
    from drivers.emulated.truth import Truth

    if scene is None:
        return Truth.pull_off(seed=seed)
    from rig import emulation
    from rig.library import load_scene

    return emulation.truth(load_scene(scene)[0], seed)


def _endpoints(bench: Any, terminals: bool) -> dict[str, str]:
    from rig.errors import RigError

    endpoints = bench.endpoints
    answer = {"stage": endpoints.stage, "pump": endpoints.pump, "daq": endpoints.daq.removeprefix("grpc://")}
    if terminals:
        try:
            answer["stage_pty"], answer["pump_pty"] = bench.serve_terminals()
        except OSError as error:
            raise RigError(
                f"--pty: {error}. Remedy: leave --pty out; the TCP endpoints serve the same bytes."
            ) from error
    return answer
