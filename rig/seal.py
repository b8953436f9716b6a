"""The seal at the end of a finished recording, and the probe for files without one.

HDF5's own code can run for ever or crash on a damaged file, and no time-out in this process could end it. So a finished
recording carries a SHA-256 of its bytes behind the HDF5 data (which readers ignore); whatever has none is first read by
a process of its own, which may be killed.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

from rig.errors import FileError

MARK = b"\nRIGSEAL1"
PROBE_SECONDS = 20.0
PROBE_BYTES_PER_SECOND = 10e6
_LENGTH = len(MARK) + 32


def seal(path: Path) -> None:
    """Append the seal to a closed recording."""
    digest = hashlib.sha256(path.read_bytes()).digest()
    with path.open("ab") as file:
        file.write(MARK + digest)


def is_sealed(path: Path) -> bool:
    """Whether the file is to the byte what the recorder closed."""
    content = path.read_bytes()
    mark, digest = content[-_LENGTH:-32], content[-32:]
    return mark == MARK and hashlib.sha256(content[:-_LENGTH]).digest() == digest


def probe(path: Path) -> None:
    """Read the whole recording in another process.

    Raises
    ------
    FileError
        It cannot be read, or reading it crashes or does not end.
    """
    command = [sys.executable, "-m", "rig.seal", str(path)]
    patience = PROBE_SECONDS + path.stat().st_size / PROBE_BYTES_PER_SECOND
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=patience, check=False)
    except subprocess.TimeoutExpired as error:
        raise FileError(
            f"recording {path}: damaged: reading it does not end within {patience:.0f} s. Remedy: restore a copy."
        ) from error
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        text = lines[-1] if done.returncode == 1 and lines else f"reading it crashes (code {done.returncode})"
        raise FileError(text if text.startswith("recording ") else f"recording {path}: damaged: {text}.")


def _main(path: Path) -> int:
    from rig.recording import read_through

    try:
        read_through(path)
    except FileError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(_main(Path(sys.argv[1])))
