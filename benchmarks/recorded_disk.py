"""A disk that notes every write and every flush, for Linux and root: a file served by FUSE, below a loop device.

Run as a script with the size in bytes and the place of an empty file to mount on: serves until it is unmounted, then
writes what it has noted to the file named third. Kernel interface: ``include/uapi/linux/fuse.h``, version 7.31.
"""

from __future__ import annotations

import ctypes
import errno
import os
import pickle
import struct
import sys
import time
from dataclasses import dataclass

MAX_WRITE = 1 << 17
IN_HEADER = struct.Struct("<IIQQIIIHH")
OUT_HEADER = struct.Struct("<IiQ")
GETATTR, SETATTR, OPEN, READ, WRITE, STATFS, RELEASE, FSYNC, FLUSH, INIT, ACCESS, DESTROY = (
    3, 4, 14, 15, 16, 17, 18, 20, 25, 26, 34, 38,
)  # fmt: skip
UNANSWERED = (2, 36, 42)
"""FORGET, INTERRUPT, BATCH_FORGET."""


@dataclass(frozen=True)
class Write:
    """Bytes that the file system has handed to the disk."""

    moment: float
    offset: int
    data: bytes


@dataclass(frozen=True)
class Flush:
    """The file system has had the disk's own memory emptied."""

    moment: float


class Disk:
    """Answers the kernel."""

    def __init__(self, size: int) -> None:
        self.content = bytearray(size)
        self.log: list[Write | Flush] = []
        sizes = struct.pack("<QQQ", 1, size, size // 512)
        rights = struct.pack("<QQQIIIIIIIIII", *(0,) * 6, 0o100600, 1, 0, 0, 0, 4096, 0)
        attributes = struct.pack("<QII", 3600, 0, 0) + sizes + rights
        self._plain = {
            INIT: struct.pack("<IIIIHHIIHHI28x", 7, 31, MAX_WRITE, 1 << 5, 1, 1, MAX_WRITE, 1, 0, 0, 0),
            GETATTR: attributes,
            SETATTR: attributes,
            OPEN: struct.pack("<QII", 1, 0, 0),
            STATFS: bytes(80),
            **dict.fromkeys((RELEASE, FSYNC, FLUSH, ACCESS, DESTROY), b""),
        }

    def answer(self, operation: int, body: bytes) -> bytes | int:
        """Return the reply's body, or an error number."""
        if operation == FSYNC:
            self.log.append(Flush(time.monotonic()))
        if operation in (READ, WRITE):
            _, offset, length = struct.unpack_from("<QQI", body)
            return self._read(offset, length) if operation == READ else self._write(offset, body[40 : 40 + length])
        return self._plain.get(operation, errno.ENOSYS)

    def _read(self, offset: int, length: int) -> bytes:
        return bytes(self.content[offset : offset + length])

    def _write(self, offset: int, data: bytes) -> bytes:
        self.content[offset : offset + len(data)] = data
        self.log.append(Write(time.monotonic(), offset, data))
        return struct.pack("<II", len(data), 0)


def serve(disk: Disk, place: str) -> None:
    """Mount and answer until unmounted."""
    kernel = os.open("/dev/fuse", os.O_RDWR)
    options = f"fd={kernel},rootmode=100000,user_id=0,group_id=0".encode()
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mount(b"rig", place.encode(), b"fuse", 0, options):
        raise OSError(ctypes.get_errno(), f"cannot mount on {place}")
    sys.stdout.write("mounted\n")
    sys.stdout.flush()
    while True:
        try:
            request = os.read(kernel, MAX_WRITE + 4096)
        except OSError as error:
            if error.errno == errno.ENODEV:  # unmounted
                return
            raise
        _, operation, unique, *_ = IN_HEADER.unpack_from(request)
        if operation in UNANSWERED:
            continue
        answer = disk.answer(operation, request[IN_HEADER.size :])
        error, body = (0, answer) if isinstance(answer, bytes) else (-answer, b"")
        os.write(kernel, OUT_HEADER.pack(OUT_HEADER.size + len(body), error, unique) + body)


def main() -> None:
    """Serve, then keep the log."""
    size, place, out = sys.argv[1:]
    disk = Disk(int(size))
    serve(disk, place)
    with open(out, "wb") as file:
        pickle.dump([(w.moment, w.offset, w.data) if isinstance(w, Write) else (w.moment,) for w in disk.log], file)


if __name__ == "__main__":
    main()
