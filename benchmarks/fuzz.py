"""Coverage-guided fuzzing with atheris (``pip install '.[fuzz]'``): inputs tried and what they broke, target by target.

An input that breaks a target is kept as ``fuzz-crash-*`` in the working directory; try it again with
``python benchmarks/fuzz.py --only TARGET fuzz-crash-...``.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

PARTS = ["rig", "drivers", "tomllib", "pipython", "nidaqmx", "tomlkit", "fuzz_targets"]


def serve(name: str, words: list[str]) -> None:
    """Fuzz one target in this process, which ends with it."""
    import atheris

    with atheris.instrument_imports(include=PARTS):
        from fuzz_targets import TARGETS

    target, _ = TARGETS[name]
    target(b"")  # what is made once is made now
    atheris.Setup([sys.argv[0], *words], target)
    atheris.Fuzz()


def fuzz(name: str, seeds: tuple[bytes, ...], seconds: float, seed: int) -> None:
    """Fuzz a target for so long, in a process of its own, and say what came of it."""
    with tempfile.TemporaryDirectory() as corpus:
        for number, content in enumerate(seeds):
            (Path(corpus) / str(number)).write_bytes(content)
        command = [sys.executable, __file__, "--only", name, f"-max_total_time={seconds:g}", f"-seed={seed}"]
        command += ["-print_final_stats=1", "-timeout=60", "-rss_limit_mb=4096", "-artifact_prefix=fuzz-crash-", corpus]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        found = len(list(Path(corpus).iterdir())) - len(seeds)
    tried = re.findall(r"stat::number_of_executed_units:\s*(\d+)", done.stderr) or ["0"]
    covered = re.findall(r"cov: (\d+)", done.stderr) or ["0"]
    print(f"{name}: {tried[-1]} inputs, {covered[-1]} branches, {found} inputs that led further", flush=True)
    if done.returncode:
        kept = re.findall(r"fuzz-crash-\S+", done.stderr)
        print(f"BROKEN: {name}, {' '.join(kept[-1:])}\n{done.stdout[-3000:]}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=300.0, help="for each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="one target, by name; further words go to libFuzzer")
    arguments, words = parser.parse_known_args()
    if arguments.only and words:
        serve(arguments.only, words)
    from fuzz_targets import TARGETS

    for name, (_, seeds) in TARGETS.items():
        if arguments.only in (None, name):
            fuzz(name, seeds, arguments.seconds, arguments.seed)


if __name__ == "__main__":
    main()
