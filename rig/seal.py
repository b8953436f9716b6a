"""The seal at the end of a finished recording, and the probe for files without one.

HDF5's own code can run for ever or crash on a damaged file, and no time-out in this process could end it. So a finished
recording carries a SHA-256 of its bytes behind the HDF5 data (which readers ignore); whatever has none is first read by
a process of its own, which may be killed.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from rig.errors import FileError

MARK = b"\nRIGSEAL1"
PROBE_SECONDS = 20.0
PROBE_BYTES_PER_SECOND = 10e6
"""Processor time a probe may take: a sound file must not be called damaged because the computer is busy."""
POLL_SECONDS, SLEEP_SECONDS = 0.25, 5.0
_LENGTH = len(MARK) + 32


def seal(path: Path) -> None:
    """Append the seal to a closed recording."""
    digest = hashlib.sha256(path.read_bytes()).digest()
    with path.open("ab") as file:
        file.write(MARK + digest)


def is_sealed(path: Path) -> bool:
    """Whether the file is there, and to the byte what the recorder closed."""
    if not path.is_file():
        return False
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
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as reader:
        told = _words(reader, patience, path)
    if reader.returncode:
        lines = told.strip().splitlines()
        text = lines[-1] if reader.returncode == 1 and lines else f"reading it crashes (code {reader.returncode})"
        raise FileError(text if text.startswith("recording ") else f"recording {path}: damaged: {text}.")


def _words(reader: subprocess.Popen[str], patience: float, path: Path) -> str:
    """Return what the reader says, unless it takes more processor time than it may, or sleeps.

    HDF5 reads a damaged part of a file that was being written again and again, sleeping ever longer in between. On a
    busy computer a sound reader waits for the processor, which is not sleep.
    """
    import psutil

    clock = psutil.Process(reader.pid)
    asleep = 0
    while True:
        try:
            return reader.communicate(timeout=POLL_SECONDS)[1]
        except subprocess.TimeoutExpired as error:
            with suppress(psutil.NoSuchProcess):  # it has just ended
                asleep = asleep + 1 if clock.status() == psutil.STATUS_SLEEPING else 0
                if sum(clock.cpu_times()[:2]) > patience or asleep * POLL_SECONDS > SLEEP_SECONDS:
                    reader.kill()
                    raise FileError(
                        f"recording {path}: damaged: reading it has no end. Remedy: restore a copy."
                    ) from error


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
