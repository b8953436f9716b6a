"""How fast a run goes in virtual time, and where the time goes: wire and direct, in one process, one after the other.

Usage: ``python benchmarks/virtual_speed.py [SCENE]``.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rig.loop
import rig.recorder
import rig.session
from rig.bench import load_bench
from rig.library import load_scene
from rig.session import Request, run_scene

spent: Counter[str] = Counter()
calls: Counter[str] = Counter()


def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with its wall time added up under ``name``."""

    def run(*arguments: Any, **options: Any) -> Any:
        began = time.perf_counter()
        try:
            return function(*arguments, **options)
        finally:
            spent[name] += time.perf_counter() - began
            calls[name] += 1

    return run


def instrument_the_rig() -> None:
    """Time the parts of the loop, whichever instruments are behind it."""
    opening = rig.session.open_instruments

    def opened(request: Request) -> Any:
        instruments = opening(request)
        for device, method in (("daq", "read"), ("stage", "status"), ("stage", "move_to"), ("pump", "status")):
            target = getattr(instruments, device)
            if target is not None:
                setattr(target, method, timed(f"{device}.{method}", getattr(target, method)))
        return instruments

    rig.session.open_instruments = opened
    rig.recorder.Recorder.append = timed("recorder.append", rig.recorder.Recorder.append)  # type: ignore[method-assign]
    rig.loop.Loop.run = timed("loop", rig.loop.Loop.run)  # type: ignore[method-assign]


def measure(scene: str, *, wire: bool, live: bool) -> float:
    """Run once; print the table; return sample time over wall time."""
    bench, bench_text = load_bench(None)
    spent.clear()
    calls.clear()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run.h5"
        ending = run_scene(Request(*load_scene(scene), bench, bench_text, out, wire=wire, live=live))
    frames = calls["daq.read"]
    seconds = frames * bench.daq.frame_ms * 1e-3
    ratio = seconds / spent["loop"]
    print(f"\n{'wire' if wire else 'direct'}{', live prediction' if live else ''}: {ending.reason}, {frames} frames")
    print(f"  {seconds:.1f} s of samples in {spent['loop']:.2f} s: {ratio:.1f} times real time")
    outside = sum(spent[name] for name in spent if "." in name and name != "recorder.append")
    print(f"  per frame: {spent['loop'] / frames * 1e3:.3f} ms, of it")
    for name, total in spent.most_common():
        if name != "loop":
            print(f"    {name:<16} {total / frames * 1e3:.3f} ms  ({calls[name]} calls)")
    print(f"    engine (all but the instruments) {(spent['loop'] - outside) / frames * 1e3:.3f} ms")
    return ratio


if __name__ == "__main__":
    name = sys.argv[1] if len(sys.argv) > 1 else "sphere-60mm-low"
    instrument_the_rig()
    direct = measure(name, wire=False, live=False)
    wired = measure(name, wire=True, live=False)
    measure(name, wire=True, live=True)
    print(f"\ndirect over wire: {direct / wired:.1f}")
