"""``rig emulate``: serve the emulated instruments to any client, in real time, until Ctrl-C."""

from __future__ import annotations

import argparse
import json
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drivers.emulated.faults import Fault, Faults
    from drivers.emulated.truth import Truth

LATENCY = 5e-3
"""Delay of every reply of stage and pump, s, as on a serial line."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--pty", action="store_true", help="serve stage and pump on pseudo-terminals too (POSIX)")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="times real time (default: 1)")
    parser.add_argument("--faults", type=Path, metavar="FILE", help="fault script (TOML)")
    parser.add_argument("--scene", metavar="SCENE", help="substrate and gripper of this scene (default: 60 mm sphere)")
    parser.add_argument("--seed", type=int, default=0, help="which specimen and which noise")


def run(arguments: argparse.Namespace) -> int:
    """Print the endpoints as one line of JSON, then serve."""
    import signal
    import threading

    from drivers.emulated.bench import EmulatedBench
    from rig.errors import FileError

    if not 0 < arguments.speed <= 1000:
        raise FileError(f"--speed {arguments.speed:g}: must be above 0 and at most 1000. Remedy: e.g. --speed 1.")
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
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
        while not ended.wait(0.5):
            pass  # a bounded wait lets Windows deliver Ctrl-C
    return 0


def load_faults(path: Path) -> Faults:
    """Read a fault script: TOML with ``[[fault]]`` tables whose keys are those of ``drivers.emulated.faults.Fault``.

    Raises
    ------
    FileError
        Names the file, the fault, the key, the value and what is allowed.
    """
    from drivers.emulated.faults import Faults
    from rig.errors import FileError
    from rig.scene import read_text

    try:
        document = tomllib.loads(read_text(path, "fault script"))
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"fault script {path}: not valid TOML: {error}. Remedy: mend the line it names.") from error
    unknown = sorted(set(document) - {"fault"})
    tables = document.get("fault")
    if unknown or not isinstance(tables, list):
        found = f"unknown key {unknown[0]}" if unknown else "no list of faults"
        raise FileError(f"fault script {path}: {found}. Remedy: it holds [[fault]] tables and nothing else.")
    return Faults(_fault(table, f"fault script {path}, fault {number}") for number, table in enumerate(tables, 1))


def _fault(table: Any, place: str) -> Fault:
    from pydantic import TypeAdapter, ValidationError

    from drivers.emulated.faults import Fault
    from rig.errors import FileError

    known = known_faults()
    if not isinstance(table, dict):
        raise FileError(f"{place}: not a table. Remedy: begin it with [[fault]].")
    unknown = sorted(set(table) - set(Fault.__annotations__))
    if unknown:
        raise FileError(f"{place}: unknown key {unknown[0]}. Remedy: the keys are {', '.join(Fault.__annotations__)}.")
    try:
        fault = TypeAdapter(Fault).validate_python(table, strict=True)
    except ValidationError as error:
        finding = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in finding["loc"])
        raise FileError(f"{place}: {key}: {finding['msg']} (found {finding['input']!r}). Remedy: mend it.") from error
    if fault.device not in known:
        raise FileError(f"{place}: device = {fault.device!r} is none of {', '.join(known)}. Remedy: name one of them.")
    if fault.kind not in known[fault.device]:
        kinds = ", ".join(sorted(known[fault.device]))
        raise FileError(
            f"{place}: kind = {fault.kind!r} is not a fault of {fault.device!r}. Remedy: use one of {kinds}."
        )
    _check_times(fault, place)
    return fault


def _check_times(fault: Fault, place: str) -> None:
    from rig.errors import FileError

    if fault.at_sample is not None and fault.at_step is not None:
        raise FileError(f"{place}: both at_sample and at_step are given. Remedy: keep one.")
    for key in ("at_sample", "after_samples", "for_samples"):
        value = getattr(fault, key)
        if value is not None and value < 0:
            raise FileError(f"{place}: {key} = {value} is negative. Remedy: count samples from 0.")


def known_faults() -> dict[str, dict[str, str]]:
    """Return what each emulated device can be made to do wrong, with the meaning of every kind."""
    from drivers.emulated import daq, plant, pump, stage

    known: dict[str, dict[str, str]] = {"stage": dict(stage.FAULTS), "pump": dict(pump.FAULTS)}
    for faults in (daq.FAULTS, plant.FAULTS):
        for device, kinds in faults.items():
            known[device] = {**kinds, **known.get(device, {})}
    return known


def _truth(scene: str | None, seed: int) -> Truth:
    from drivers.emulated.truth import Truth

    if scene is None:
        return Truth.pull_off(seed=seed)
    from rig import emulation
    from rig.library import find_scene
    from rig.scene import parse_scene

    return emulation.truth(parse_scene(*find_scene(scene)), seed)


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
