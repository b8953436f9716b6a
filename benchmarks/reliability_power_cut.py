"""A power cut under a real file system: ext4 on a disk that notes every write, cut at random ones. Linux and root only.

After a cut the disk holds every write before the last flush, and of those since then any half: a disk's own memory
keeps no order. The image is mounted again, which replays ext4's journal, and the recording is read by the program.
"""

from __future__ import annotations

import argparse
import contextlib
import pickle
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from killed_run import record_and_kill
from test_power_cut import is_part_of

from rig.errors import RigError
from rig.recording import Recording, load_recording

DISK = Path(__file__).with_name("recorded_disk.py")
SIZE = 48 << 20
RATE = 1000.0

Entry = tuple[float] | tuple[float, int, bytes]


def run(*command: str | Path) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout.strip()


@contextlib.contextmanager
def mounted(disk: Path, place: Path) -> Iterator[None]:
    """Mount a disk's file system by way of a loop device."""
    device = run("losetup", "--show", "-f", disk)
    try:
        run("mount", device, place)
        try:
            yield
        finally:
            run("umount", place)
    finally:
        run("losetup", "-d", device)


def record(folder: Path, seconds: float, *options: str) -> tuple[list[Entry], np.ndarray, Path]:
    """Record for so long, then kill; return what the disk has noted, the acknowledgements, and the file as it was."""
    disk, log, place, whole = folder / "disk", folder / "log", folder / "mounted", folder / "whole.h5"
    disk.touch()
    place.mkdir()
    server = subprocess.Popen(
        [sys.executable, str(DISK), str(SIZE), str(disk), str(log)], stdout=subprocess.PIPE, text=True
    )
    assert server.stdout is not None
    server.stdout.readline()
    run("mke2fs", "-q", "-F", "-t", "ext4", disk)
    with mounted(disk, place):
        told = record_and_kill(place / "run.h5", seconds, *options)
        for name in ("run.h5", "run.h5.journal"):
            if (place / name).exists():
                shutil.copy(place / name, whole.with_name(name.replace("run", "whole")))
    run("umount", disk)
    server.wait()
    acknowledged = np.array([(one.moment, one.samples) for one in told])
    return pickle.loads(log.read_bytes()), acknowledged, whole  # noqa: S301 - written just now


def cut(log: list[Entry], number: int, draw: random.Random) -> bytearray:
    """Return the disk as a power cut just after this write would leave it."""
    forced = max((i for i, entry in enumerate(log[: number + 1]) if len(entry) == 1), default=0)
    image = bytearray(SIZE)
    for place, entry in enumerate(log[: number + 1]):
        if len(entry) == 1:
            continue
        _, offset, data = entry
        for start in range(0, len(data), 4096):
            if place < forced or draw.random() < 0.5:
                image[offset + start : offset + start + len(data[start : start + 4096])] = data[start : start + 4096]
    return image


def found_in(image: bytearray, folder: Path) -> Recording | None:
    """Mount a disk as it was left, and read its recording; ``None`` if there is none that can be read."""
    disk, place = folder / "cut", folder / "mounted"
    disk.write_bytes(image)
    with tempfile.TemporaryDirectory() as copy:
        with mounted(disk, place):
            for path in place.glob("run*"):
                shutil.copy(path, copy)
        try:
            return load_recording(Path(copy) / "run.h5")
        except RigError:
            return None


def judge(found: Recording | None, whole: Recording, safe: int) -> str:
    if found is None:
        return "not readable" if safe else "not begun"
    if not is_part_of(found, whole):
        return "with wrong values"
    return "whole and true" if found.force.size >= safe else "true, samples missing"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--cuts", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=45.0)
    arguments = parser.parse_args()
    draw = random.Random(4)
    for options in (("1", "journalled"), ("1",)):
        with tempfile.TemporaryDirectory(dir="/dev/shm") as name:
            folder = Path(name)
            log, acknowledged, path = record(folder, arguments.seconds, *options)
            whole = load_recording(path)
            during = [i for i, entry in enumerate(log) if acknowledged[0, 0] <= entry[0] <= acknowledged[-1, 0]]
            verdicts: Counter[str] = Counter()
            missing = []
            for _ in range(arguments.cuts):
                number = draw.choice(during)
                told = acknowledged[acknowledged[:, 0] <= log[number][0], 1]
                safe = int(told[-1]) if told.size else 0
                found = found_in(cut(log, number, draw), folder)
                verdicts[judge(found, whole, safe)] += 1
                missing.append(max(0, safe - (0 if found is None else found.force.size)) / RATE)
        print(
            f"{' '.join(options)}: {len(log)} entries, {len(during)} of them while recording; {arguments.cuts} cuts: "
            f"{', '.join(f'{count} {verdict}' for verdict, count in sorted(verdicts.items()))}; "
            f"acknowledged data missing: median {np.median(missing):.1f}, at most {max(missing):.1f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
