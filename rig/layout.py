"""The layout of a recording (docs/recording.md): its tables, where they lie, how an instrument's answer fits a row."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import PumpState, PumpStatus, StageStatus

FORMAT = "membrane-adhesion-rig recording 1"

FRAMES = np.dtype([("start", "<i8"), ("samples", "<i4"), ("arrived_s", "<f8")])
STAGE = np.dtype(
    [("sent_s", "<f8"), ("received_s", "<f8"), ("position_m", "<f8"), ("flags", "u1"), ("error", "<i4")],
)
PUMP = np.dtype(
    [
        ("sample", "<i8"),
        ("sent_s", "<f8"),
        ("received_s", "<f8"),
        ("state", "u1"),
        ("rate_m3_s", "<f8"),
        ("volume_m3", "<f8"),
    ]
)
STEPS = np.dtype([("sample", "<i8"), ("phase", "S8"), ("name", "S24"), ("outcome", "S200")])
EVENTS = np.dtype([("sample", "<i8"), ("kind", "S12"), ("text", "S400")])
PREDICTIONS = np.dtype([("sample", "<i8"), ("json", "S16000")])
ENDING = np.dtype([("reason", "S400"), ("exit_code", "<i4"), ("samples", "<i8"), ("ended", "S40")])

PER_SAMPLE = ("raw/volts", "data/time", "data/force", "data/height", "data/pressure")
TABLES = {
    "raw/frames": FRAMES,
    "raw/stage": STAGE,
    "raw/pump": PUMP,
    "steps": STEPS,
    "events": EVENTS,
    "predictions": PREDICTIONS,
    "ending": ENDING,
}
PER_FRAME = ("raw/frames", "raw/stage")

_STAGE_FLAGS = ("moving", "on_target", "servo_on", "negative_limit", "positive_limit")
PUMP_STATES = tuple(PumpState)


def pack_stage(status: StageStatus) -> tuple[float, float, float, int, int]:
    """Return one row of the stage's table."""
    flags = sum(getattr(status, name) << bit for bit, name in enumerate(_STAGE_FLAGS))
    return status.sent, status.received, status.position, flags, status.error


def unpack_stage(row: Any) -> StageStatus:
    """Return the poll a row of the stage's table holds."""
    flags = {name: bool(row["flags"] >> bit & 1) for bit, name in enumerate(_STAGE_FLAGS)}
    return StageStatus(
        float(row["sent_s"]), float(row["received_s"]), float(row["position_m"]), error=int(row["error"]), **flags
    )


def unpack_pump(row: Any) -> PumpStatus:
    """Return the poll a row of the pump's table holds."""
    state = PUMP_STATES[int(row["state"])]
    return PumpStatus(
        float(row["sent_s"]), float(row["received_s"]), state, float(row["rate_m3_s"]), float(row["volume_m3"])
    )


def pieces(text: str) -> Iterator[str]:
    """Yield the rows that a line of the log takes: a long one, such as a traceback, goes on in the next row."""
    encoded = text.encode(errors="backslashreplace")
    while True:
        piece = encoded[: EVENTS["text"].itemsize].decode(errors="ignore")
        yield piece
        encoded = encoded[len(piece.encode()) :]
        if not encoded:
            return


def lay_out(
    file: h5py.File,
    info: Mapping[str, Any],
    channels: Sequence[str],
    units: Sequence[str],
    metadata: Mapping[str, str],
    started: str,
) -> dict[str, h5py.Dataset]:
    """Make every group and dataset of a recording, empty; return the datasets that grow, by name.

    Parameters
    ----------
    info
        A ``RunInfo`` as a dictionary.
    channels, units
        Of the raw values, in order.
    metadata
        Texts kept whole beside the data, by name.
    started
        When the run began, ISO 8601.
    """
    file.attrs.update({"default": "entry", "format": FORMAT})
    entry = _group(file, "entry", "NXentry", default="data")
    entry.attrs["title"] = info["title"]
    entry["title"] = info["title"]
    entry["start_time"] = started
    entry["definition"] = FORMAT
    notes = _group(entry, "configuration", "NXcollection")
    for name, text in metadata.items():
        notes[name] = text
    notes["run"] = json.dumps(info)
    raw = _group(entry, "raw", "NXcollection")
    raw.attrs["sample_rate_Hz"] = info["rate"]
    data = _group(entry, "data", "NXdata", signal="force", axes="time")
    sets = {
        "volts": _rows(raw, "volts", np.float64, (len(channels),), 4096, units=", ".join(dict.fromkeys(units))),
        "frames": _rows(raw, "frames", FRAMES, (), 512),
        "stage": _rows(raw, "stage", STAGE, (), 512),
        "time": _rows(data, "time", np.float64, (), 4096, units="s"),
        "force": _rows(data, "force", np.float64, (), 4096, units="N", long_name="F_r (N), untared"),
        "height": _rows(data, "height", np.float64, (), 4096, units="m"),
        "steps": _rows(entry, "steps", STEPS, (), 64),
        "events": _rows(entry, "events", EVENTS, (), 64),
        "predictions": _rows(entry, "predictions", PREDICTIONS, (), 8),
        "ending": _rows(entry, "ending", ENDING, (), 1),
    }
    sets["volts"].attrs.update({"channels": list(channels), "channel_units": list(units)})
    auxiliary = ["height"]
    if info["uses_pressure"]:
        sets["pressure"] = _rows(data, "pressure", np.float64, (), 4096, units="Pa", long_name="P_a (Pa), gauge")
        sets["pump"] = _rows(raw, "pump", PUMP, (), 512)
        auxiliary.append("pressure")
    data.attrs["auxiliary_signals"] = auxiliary
    return sets


def extend(dataset: h5py.Dataset, block: NDArray[Any]) -> None:
    """Append rows to a dataset and hand them to the operating system."""
    size = dataset.shape[0]
    dataset.resize(size + len(block), axis=0)
    dataset[size:] = block
    dataset.flush()


def complete(entry: h5py.Group) -> tuple[int, int]:
    """Return samples and frames up to the last frame that every stream holds whole.

    A flush writes the frames' table last. A program that dies inside a flush can leave rows that were made but not yet
    filled; they do not follow on from the row before.
    """
    limit = min(entry[name].shape[0] for name in PER_SAMPLE if name in entry)
    frames = entry["raw/frames"][: min(entry[name].shape[0] for name in PER_FRAME)]
    stops = frames["start"] + frames["samples"]
    follows = (frames["start"] == np.concatenate(([0], stops[:-1]))) & (frames["samples"] > 0) & (stops <= limit)
    whole = int(follows.argmin()) if not follows.all() else len(frames)
    return (int(stops[whole - 1]) if whole else 0), whole


def filled(table: NDArray[Any]) -> NDArray[Any]:
    """Return the table without the unfilled rows at its end."""
    blank = np.zeros(1, table.dtype)[0]
    length = len(table)
    while length and table[length - 1] == blank:
        length -= 1
    return table[:length]


def _group(parent: h5py.Group, name: str, kind: str, **attributes: str) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs.update({"NX_class": kind, **attributes})
    return group


def _rows(
    parent: h5py.Group, name: str, kind: Any, shape: tuple[int, ...], chunk: int, **attributes: str
) -> h5py.Dataset:
    dataset = parent.create_dataset(
        name, shape=(0, *shape), maxshape=(None, *shape), dtype=kind, chunks=(chunk, *shape), track_times=False
    )
    dataset.attrs.update(attributes)
    return dataset
