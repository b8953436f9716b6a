"""Which functions of the vendors' own clients a run calls over the wire, and what the emulated instruments received.

Usage: ``python benchmarks/vendor_clients.py [SCENE]``.
"""

from __future__ import annotations

import inspect
import sys
import tempfile
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

from rig.emulation import emulated_bench
from rig.library import load_scene
from rig.session import Request, run_scene

CLIENTS = ("pipython", "serial", "nidaqmx")
called: dict[str, Counter[str]] = {name: Counter() for name in CLIENTS}
benches: list[Any] = []


def watch(frame: FrameType, event: str, argument: Any) -> None:
    """Count every call of a function that lives in a vendor's package."""
    if event != "call" or not frame.f_code.co_flags & inspect.CO_OPTIMIZED:
        return
    module = str(frame.f_globals.get("__name__", ""))
    client = module.partition(".")[0]
    if client in called and "_stubs" not in module:
        called[client][f"{module}.{frame.f_code.co_qualname}"] += 1


def keep(request: Request) -> Any:
    """Open the emulated bench and keep it, to ask afterwards what it was asked."""
    benches.append(emulated_bench(request))
    return benches[-1]


def main(scene: str) -> None:
    """Run once and print the lists."""
    from rig.bench import load_bench

    sys.modules["rig.emulation"].emulated_bench = keep  # type: ignore[attr-defined]
    with tempfile.TemporaryDirectory() as folder:
        sys.setprofile(watch)
        try:
            request = Request(*load_scene(scene), *load_bench(None), Path(folder) / "run.h5", live=False)
            ending = run_scene(request)
        finally:
            sys.setprofile(None)
    print(f"{scene}: {ending.reason}")
    for client, counts in called.items():
        print(f"\n{client}: {len(counts)} functions")
        for name, count in sorted(counts.items()):
            if "<" not in name:
                print(f"  {count:8d}  {name}")
    emulated = benches[0]
    print(f"\nreceived by the controller: {dict(emulated.controller.received)}")
    if request.scene.uses_pressure:
        print(f"received by the pump: {dict(emulated.legato.received)}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "sphere-60mm-low")
