"""A disk that loses its power, in a model: pages that were not forced to it survive in any selection and any age.

The operating system keeps what programs write in pages and brings them to the disk when it likes, each by itself; only
``fsync`` brings the pages of one file, or the names in one folder, at once. The disk is looked at after every write of
the recorder to a dataset, and at every ``fsync``.
"""

from __future__ import annotations

import contextlib
import os
import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import rig.recorder
from rig.recorder import Recorder

PAGE = 4096


@dataclass
class _File:
    """What has become of one file: its pages and its lengths in the order of the moments they were seen at."""

    content: bytes = b""
    pages: list[tuple[int, int, bytes]] = field(default_factory=list)
    lengths: list[tuple[int, int]] = field(default_factory=lambda: [(0, 0)])
    forced: list[int] = field(default_factory=list)


class Disk:
    """Follows the files of one folder; ``cut`` writes what a power cut at some moment would leave of them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[str, _File] = {}
        self._named: list[tuple[int, set[str]]] = []
        self.moments = 0
        self.acknowledged: list[tuple[int, int]] = []

    def look(self) -> None:
        """Note every page that has changed."""
        self.moments += 1
        for path in self._folder.iterdir():
            self._look_at(self._files.setdefault(path.name, _File()), path.read_bytes())

    def _look_at(self, file: _File, now: bytes) -> None:
        before, file.content = file.content, now
        if len(now) != len(before):
            file.lengths.append((self.moments, len(now)))
        for start in range(0, len(now), PAGE):
            if now[start : start + PAGE] != before[start : start + PAGE]:
                file.pages.append((self.moments, start, now[start : start + PAGE]))

    def force(self, descriptor: int) -> None:
        """Take the ``fsync`` of a file or of the folder."""
        self.look()
        forced = os.fstat(descriptor)
        if os.path.samestat(forced, self._folder.stat()):
            self._named.append((self.moments, {path.name for path in self._folder.iterdir()}))
        for path in self._folder.iterdir():
            if os.path.samestat(forced, path.stat()):
                self._files[path.name].forced.append(self.moments)

    def safe_at(self, moment: int) -> int:
        """Return how many samples had been acknowledged by then."""
        return max((samples for at, samples in self.acknowledged if at <= moment), default=0)

    def cut(self, moment: int, draw: random.Random, folder: Path) -> None:
        """Write into an empty folder what is left after a power cut just after this moment."""
        named: set[str] = set().union(*(names for at, names in self._named if at <= moment))
        for name, file in self._files.items():
            if name in named or (file.lengths[1:] and file.lengths[1][0] <= moment and draw.random() < 0.5):
                (folder / name).write_bytes(_left(file, moment, draw))


def _left(file: _File, moment: int, draw: random.Random) -> bytes:
    """Every page as it was when it was last forced, or as at any time since; so too the length."""
    forced = max((at for at in file.forced if at <= moment), default=0)
    length = draw.choice(_since(file.lengths, forced, moment))[1]
    ages: dict[int, list[tuple[int, int, bytes]]] = {}
    for page in file.pages:
        ages.setdefault(page[1], [(0, page[1], b"")]).append(page)
    content = bytearray(length)
    for start, versions in ages.items():
        page = draw.choice(_since(versions, forced, moment))[2][: max(0, length - start)]
        content[start : start + len(page)] = page
    return bytes(content)


def _since(versions: list[Any], forced: int, moment: int) -> list[Any]:
    """Return the last version that was forced to the disk, and those after it."""
    reached = [version for version in versions if version[0] <= moment]
    first = max(number for number, version in enumerate(reached) if version[0] <= forced)
    return reached[first:]


@contextlib.contextmanager
def watched(folder: Path) -> Iterator[Disk]:
    """Follow what the recorder does to a folder."""
    disk = Disk(folder)
    extend, fsync, flush = rig.recorder.extend, os.fsync, Recorder.flush

    def extended(*arguments: Any) -> None:
        extend(*arguments)
        disk.look()

    def forced(descriptor: int) -> None:
        fsync(descriptor)
        disk.force(descriptor)

    def flushed(self: Recorder) -> None:
        flush(self)
        disk.acknowledged.append((disk.moments, self.acknowledged))

    with (
        mock.patch("rig.recorder.extend", extended),
        mock.patch("os.fsync", forced),
        mock.patch.object(Recorder, "flush", flushed),
    ):
        yield disk
