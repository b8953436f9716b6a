"""Messages between a run and its consoles: a JSON header and raw arrays. Nothing is ever unpickled.

Layout of one message: four bytes, little-endian, with the length of the header; the header, UTF-8 JSON
``{"kind", "body", "arrays": [[name, dtype, shape], ...]}``; the bytes of each array in that order.
"""

from __future__ import annotations

import dataclasses
import json
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import PumpStatus, StageStatus
from rig.errors import RigError
from rig.live_prediction import LivePrediction
from rig.observe import Ending, Event, RunInfo, StepEvent
from sequences.frame import Frame

Array = NDArray[np.float64]


class BadMessage(RigError):
    """What came over the link is not a message of this program."""


@dataclass(frozen=True)
class Samples:
    """Consecutive frames in one message.

    Attributes
    ----------
    first, last
        Numbers of the first and the last frame.
    start
        Index of the first sample.
    rate
        Hz.
    force
        (n,), N, untared, compression positive.
    pressure
        (n,), Pa gauge, or ``None``.
    ends
        (k,), index one past the last sample of each frame.
    positions
        (k,), m, the stage's position polled at the end of each frame.
    stage, pump
        The last polls.
    """

    first: int
    last: int
    start: int
    rate: float
    force: Array
    pressure: Array | None
    ends: Array
    positions: Array
    stage: StageStatus
    pump: PumpStatus | None

    @property
    def stop(self) -> int:
        """Index one past the last sample."""
        return self.start + self.force.size


@dataclass(frozen=True, slots=True)
class Gap:
    """So many messages were dropped because this console did not take them in time."""

    messages: int


Message = RunInfo | Samples | StepEvent | Event | LivePrediction | Ending | Gap

KINDS: dict[str, type[Any]] = {
    "run": RunInfo,
    "samples": Samples,
    "step": StepEvent,
    "event": Event,
    "prediction": LivePrediction,
    "ending": Ending,
    "gap": Gap,
}
_NAMES = {kind: name for name, kind in KINDS.items()}


def samples_of(frames: Sequence[Frame]) -> Samples:
    """Put consecutive frames into one message."""
    first, last = frames[0], frames[-1]
    pressures = [frame.pressure for frame in frames if frame.pressure is not None]
    return Samples(
        first=first.number,
        last=last.number,
        start=first.start,
        rate=first.rate,
        force=np.concatenate([frame.force for frame in frames]),
        pressure=np.concatenate(pressures) if len(pressures) == len(frames) else None,
        ends=np.array([frame.stop for frame in frames], dtype=np.float64),
        positions=np.array([frame.stage.position for frame in frames]),
        stage=last.stage,
        pump=last.pump,
    )


def encode(message: Message) -> bytes:
    """Return the bytes of a message."""
    body: dict[str, Any] = {}
    arrays: list[tuple[str, NDArray[Any]]] = []
    for field in dataclasses.fields(message):
        value = getattr(message, field.name)
        if isinstance(value, np.ndarray):
            arrays.append((field.name, np.ascontiguousarray(value)))
        else:
            body[field.name] = _plain(value)
    header = json.dumps(
        {
            "kind": _NAMES[type(message)],
            "body": body,
            "arrays": [[name, array.dtype.str, array.shape] for name, array in arrays],
        },
        separators=(",", ":"),
    ).encode()
    return b"".join([struct.pack("<I", len(header)), header, *(array.tobytes() for _, array in arrays)])


def decode(data: bytes) -> Message:
    """Return the message in ``data``.

    Raises
    ------
    BadMessage
        The bytes are not a message; nothing of them was run or trusted.
    """
    try:
        (length,) = struct.unpack_from("<I", data)
        header = json.loads(data[4 : 4 + length])
        fields = dict(header["body"]) | _arrays(header["arrays"], data, 4 + length)
        message: Message = _build(KINDS[header["kind"]], fields)
    except (struct.error, ValueError, KeyError, TypeError) as error:
        raise BadMessage(f"link: a message cannot be read ({error}). Remedy: use one version on both ends.") from error
    return message


def _arrays(described: Sequence[Any], data: bytes, offset: int) -> dict[str, NDArray[Any]]:
    arrays = {}
    for name, code, shape in described:
        kind = np.dtype(code)
        if kind.hasobject:
            raise ValueError(f"array {name} of objects")
        count = math.prod(shape)
        arrays[name] = np.frombuffer(data, kind, count, offset).reshape(shape)
        offset += count * kind.itemsize
    return arrays


@cache
def _hints(kind: type[Any]) -> dict[str, Any]:
    return get_type_hints(kind)


def _build(kind: Any, value: Any) -> Any:
    """Make a value of the annotated type out of plain ones, or raise ``TypeError`` or ``ValueError``."""
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        hints = _hints(kind)
        return kind(**{name: _build(hints[name], item) for name, item in value.items()})
    origin = get_origin(kind)
    if origin is UnionType:
        return None if value is None else _build(next(one for one in get_args(kind) if one is not NoneType), value)
    if origin is tuple:
        return tuple(_build(get_args(kind)[0], item) for item in value)
    expected: Any = {Mapping: dict, float: (int, float), Any: object}.get(origin or kind, origin or kind)
    if isinstance(expected, type) and issubclass(expected, Enum):
        return expected(value)
    if not isinstance(value, expected):
        raise TypeError(f"{value!r} is not of type {kind}")
    return value


def _plain(value: Any) -> Any:
    """Reduce to what JSON knows."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, str | int | float | bool):
        return value
    return dict(value) if hasattr(value, "keys") else str(value)
