"""Many random runs with faults in one process; prints what the process holds as it goes on."""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from test_soak import soak


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--wire", action="store_true", help="through the vendors' clients")
    options = parser.parse_args()
    out, started = sys.stdout, time.monotonic()
    print("  runs  memory (MB)  threads  open files    min", file=out)
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()) as said:
        for held in soak(options.runs, Path(folder), wire=options.wire):
            said.seek(said.truncate(0))
            minutes = (time.monotonic() - started) / 60
            line = f"{held.runs:6d} {held.memory_MB:12.1f} {held.threads:8d} {held.open_files:11d} {minutes:6.1f}"
            print(line, file=out, flush=True)


if __name__ == "__main__":
    main()
