"""What a fuzzer feeds with bytes: a target returns quietly, or raises if anything but one clear error came of them."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import struct
import tempfile
import tomllib
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import grpc
import h5py
import numpy as np
from conftest import scene_text
from google.protobuf.message import DecodeError
from test_pump import CALLS as PUMP_CALLS
from test_pump import GOOD_START as PUMP_START
from test_pump import babble as pump_that_hears
from test_stage import CALLS as STAGE_CALLS
from test_stage import GOOD_START as STAGE_START
from test_stage import connect as stage_that_hears

from drivers.daq import NIDaq, signal_channel
from drivers.emulated.bench import EmulatedBench
from drivers.emulated.truth import Truth
from drivers.errors import DeviceError
from drivers.pump import LegatoPump, parse_quantity, parse_reply
from drivers.stage import PIStage
from rig.bench import load_bench, parse_bench
from rig.campaign import JOURNAL, Journal, load_campaign
from rig.check import check
from rig.errors import FileError, Refused
from rig.fault_script import load_faults
from rig.journal import _MAGIC, journal_of
from rig.measured import as_run
from rig.observe import Controls, Observer
from rig.recording import _load, load_recording
from rig.recording_file import entry_of
from rig.recovery import recover
from rig.scene import Scene, parse_scene
from rig.session import Request, run_scene

SCENE = scene_text("sphere-60mm-low")
BENCH = load_bench(None)[1]
FAULTS = '[[fault]]\ndevice = "pump"\nkind = "stalled"\nat_step = "pressurize"\nvalue = 1.0\n'
CAMPAIGN = (
    'title = "t"\norder = "random"\nseed = 1\nrepeats = 2\n[[test]]\nscene = "flat-low"\nname = "glass"\n'
    'initial_pressures_kPa = [1.6, -2.9]\nprompt = "Mount it."\n'
)
JOURNAL_LINE = '{"key": "01-glass-1", "recording": "01-glass-1.h5", "scene": "0123"}\n'
NAMES = ("force", "pressure", "supply")


class Choices:
    """Decisions taken from bytes; when they run out, every decision is the first."""

    def __init__(self, data: bytes) -> None:
        self._data, self._place = data, 0

    def below(self, limit: int) -> int:
        """Return a number from 0 to ``limit`` - 1."""
        return int.from_bytes(self.take(2), "little") % limit

    def of(self, items: Sequence[Any]) -> Any:
        """Return one of the items."""
        return items[self.below(len(items))]

    def take(self, count: int) -> bytes:
        """Return the next bytes."""
        self._place += count
        return self._data[self._place - count : self._place]

    def some(self) -> bytes:
        """Return up to 255 bytes."""
        return self.take(self.below(256))

    def number(self) -> Any:
        """Return a float of any kind."""
        return struct.unpack("<d", self.take(8).ljust(8, b"\0"))[0]

    def __bool__(self) -> bool:
        return self._place < len(self._data)


def one_message(error: Exception) -> None:
    """An error of a file is one line that names it, and says what to do or what is allowed."""
    text = str(error).strip()
    assert text
    assert "\n" not in text
    assert all(character.isprintable() for character in text), repr(text)


@contextlib.contextmanager
def refusing(*kinds: type[Exception]) -> Iterator[None]:
    """Let through errors of these kinds that are one clear message."""
    try:
        yield
    except kinds as error:
        one_message(error)


def scene_file(data: bytes) -> None:
    with refusing(FileError, Refused):
        check(parse_scene(data.decode(errors="replace"), "scene.toml"), parse_bench(BENCH, "bench.toml"))


def bench_file(data: bytes) -> None:
    with refusing(FileError, Refused):
        check(parse_scene(SCENE, "scene.toml"), parse_bench(data.decode(errors="replace"), "bench.toml"))


def fault_file(data: bytes) -> None:
    path = _scratch() / "faults.toml"
    path.write_bytes(data)
    with refusing(FileError):
        load_faults(path)


def campaign_file(data: bytes) -> None:
    path = _scratch() / "campaign.toml"
    path.write_bytes(data)
    with refusing(FileError):
        load_campaign(path)


def campaign_journal(data: bytes) -> None:
    (_scratch() / JOURNAL).write_bytes(data)
    journal = Journal(_scratch())
    with refusing(FileError):
        assert all(Path(name).name == name for name in journal.done().values())


def gcs_replies(data: bytes) -> None:
    _converse(data, stage_that_hears, STAGE_START, STAGE_CALLS)


def legato_replies(data: bytes) -> None:
    with contextlib.suppress(ValueError):
        parse_reply(data)
    with contextlib.suppress(ValueError):
        assert parse_quantity(data.decode("latin-1")) >= 0
    _converse(data, pump_that_hears, PUMP_START, PUMP_CALLS)


def _converse(data: bytes, connect: Callable[[list[bytes]], Any], start: list[bytes], calls: Sequence[Any]) -> None:
    """Some replies right, some not, to the connection and to eight calls."""
    choices = Choices(data)
    start = list(start)
    for _ in range(choices.below(3)):
        start[choices.below(len(start))] = choices.some()
    chosen = [choices.of(calls) for _ in range(8)]
    replies = []
    while choices:
        replies.append(choices.some())
    with contextlib.suppress(DeviceError):
        instrument = connect(start + replies)
        for call in chosen:
            with contextlib.suppress(DeviceError):
                result = call(instrument)
                assert call not in (PIStage.status, LegatoPump.status) or _finite(result)


def _finite(status: Any) -> bool:
    return bool(np.isfinite(getattr(status, "position", getattr(status, "volume", np.nan))))


class _Entry(NamedTuple):
    key: str
    value: str


class _Failure(grpc.RpcError):
    """What gRPC raises."""

    def __init__(self, code: grpc.StatusCode, details: str, trailer: tuple[_Entry, ...] = ()) -> None:
        self._parts = code, details, trailer

    def code(self) -> grpc.StatusCode:
        return self._parts[0]

    def details(self) -> str:
        return self._parts[1]

    def trailing_metadata(self) -> tuple[_Entry, ...]:
        return self._parts[2]


class _Channel:
    """Plays back a server's answers, some of them changed, or records them."""

    def __init__(self, answers: dict[str, list[bytes]], choices: Choices | None, real: Any = None) -> None:
        self._answers, self._choices, self._real = answers, choices, real

    def unary_unary(self, method: str, request_serializer: Any, response_deserializer: Any, **_: Any) -> Any:
        def call(request: Any, metadata: Any = None) -> Any:
            answer = self._answer(method)
            try:
                return response_deserializer(answer)
            except DecodeError as error:  # as gRPC itself does
                raise _Failure(grpc.StatusCode.INTERNAL, "Exception deserializing response!") from error

        def recorded(request: Any, metadata: Any = None) -> Any:
            raw = self._real.unary_unary(method, request_serializer, lambda data: data)(request, timeout=5)
            self._answers.setdefault(method, []).append(raw)
            return response_deserializer(raw)

        return call if self._real is None else recorded

    def _answer(self, method: str) -> bytes:
        choices = self._choices
        assert choices is not None
        known = self._answers.get(method, [b""])
        truth = known[0]
        match choices.below(8) if choices else 0:
            case 1:
                return choices.some()
            case 2:
                changed = bytearray(truth)
                for _ in range(1 + choices.below(4)):
                    if changed:
                        changed[choices.below(len(changed))] = choices.below(256)
                return bytes(changed)
            case 3:
                return truth[: choices.below(len(truth) + 1)]
            case 4:
                return bytes(choices.of([answer for answers in self._answers.values() for answer in answers]))
            case 5:
                key = choices.of(["ni-error", "ni-samps-per-chan-read"])
                trailer = (
                    _Entry(key, choices.of([str(choices.below(2**16) - 2**15), choices.some().decode("latin-1")])),
                )
                raise _Failure(choices.of(list(grpc.StatusCode)), choices.some().decode("latin-1"), trailer)
        return truth

    def unary_stream(self, *_: Any, **__: Any) -> Any:
        return lambda *_, **__: iter(())

    def close(self) -> None:
        pass


def _daq(channel: Callable[..., Any], connection: str) -> NIDaq:
    inputs = [signal_channel(name, f"Dev1/ai{number}") for number, name in enumerate(NAMES)]
    with mock.patch("drivers.daq_connection.BoundedChannel", channel):
        return NIDaq(inputs, rate=1000.0, connection=connection)


@functools.cache
def _answers() -> dict[str, list[bytes]]:
    """What a real conversation over gRPC sounds like."""
    answers: dict[str, list[bytes]] = {}
    with EmulatedBench(Truth.pull_off()) as bench:
        daq = _daq(lambda channel, deadline: _Channel(answers, None, channel), bench.endpoints.daq)
        daq.start()
        daq.read(20)
        daq.stop()
        daq.close()
    return answers


def grpc_replies(data: bytes) -> None:
    channel = _Channel(_answers(), Choices(data))
    with (
        mock.patch("grpc.insecure_channel", return_value=channel),
        contextlib.suppress(DeviceError),
        contextlib.closing(_daq(lambda *_: channel, "grpc://127.0.0.1:9")) as daq,
    ):
        daq.start()
        for _ in range(3):
            with contextlib.suppress(DeviceError):
                volts = daq.read(20)
                assert volts.shape == (3, 20)
                assert np.isfinite(volts).all()
        daq.stop()


@functools.cache
def _scratch() -> Path:
    return Path(tempfile.mkdtemp(prefix="fuzz-"))


@functools.cache
def _sound() -> Path:
    """A short recording."""

    class Stop(Observer):
        def frame(self, frame: Any) -> None:
            if frame.stop >= 200:
                controls.stop()

    controls = Controls()
    path = _scratch() / "sound.h5"
    bench, bench_text = load_bench(None)
    scene = Scene.model_validate(tomllib.loads(SCENE))
    request = Request(scene, SCENE, bench, bench_text, path, wire=False, live=False, observers=[Stop()])
    request.controls = controls
    run_scene(request)
    return path


@functools.cache
def _content() -> bytes:
    return _sound().read_bytes()


def recording_parts(data: bytes) -> None:
    """Sound HDF5 whose parts are not those of a recording."""
    choices = Choices(data)
    with h5py.File(io.BytesIO(_content()), "r+") as file:
        parts: list[str] = []
        file.visit(parts.append)
        for _ in range(1 + choices.below(4)):
            with contextlib.suppress(ValueError, OSError, TypeError, OverflowError):  # no such change is possible
                _change(file, choices.of(parts), choices)
        try:
            recording = _load(entry_of(file, _sound()), _sound())
            as_run(recording)
        except FileError as error:
            one_message(error)


def _change(file: h5py.File, name: str, choices: Choices) -> None:
    item = file.get(name)
    if item is None:
        return
    kind = choices.below(7)
    if kind == 0:
        del file[name]
    elif kind == 1:
        item.attrs[choices.of(list(item.attrs) or ["x"])] = choices.of(
            [choices.number(), np.void(choices.some() or b"x"), [1, 2], "x"]
        )
    elif isinstance(item, h5py.Group):
        item[choices.of(["x", "pump", "pressure"])] = choices.of([choices.number(), np.zeros((2, 2)), "text"])
    elif kind == 2 and item.maxshape != () and None in item.maxshape:
        item.resize(choices.below(400), axis=0)
    elif kind == 3 and item.shape == ():
        del file[name]
        file[name] = choices.some().decode("latin-1").replace("\0", "")
    elif kind == 4 and item.shape == ():
        text = bytearray(item[()] if isinstance(item[()], bytes) else b"")
        for _ in range(1 + choices.below(4)):
            text[choices.below(len(text) or 1) : choices.below(len(text) or 1)] = choices.some()[:3]
        del file[name]
        file[name] = bytes(text).replace(b"\0", b"")
    elif kind == 5 and item.dtype.names and len(item):
        field = choices.of(item.dtype.names)
        row = item[choices.below(len(item))]
        row[field] = choices.of([choices.below(2**16) - 2**15, -1, 2**31 - 1, choices.number()])
        item[choices.below(len(item))] = row
    else:
        del file[name]
        file[name] = choices.of([np.zeros(3), np.zeros((2, 2, 2)), np.array([b"x"]), 5, np.zeros(3, "S5")])


def recording_bytes(data: bytes) -> None:
    """A file whose bytes have been changed, read as the program reads it: first in a process that may die of it."""
    choices = Choices(data)
    content = bytearray(_content())
    for _ in range(1 + choices.below(12)):
        content[int.from_bytes(choices.take(4), "little") % len(content)] ^= 1 << choices.below(8)
    path = _scratch() / "changed.h5"
    path.write_bytes(content[: len(content) - choices.below(2) * choices.below(len(content))])
    with refusing(FileError):
        load_recording(path)


def journal(data: bytes) -> None:
    """A journal whose checksums are right and whose content is not."""
    choices = Choices(data)
    header = {"info": {"pid": -1, "title": "x", "rate": 1000.0, "uses_pressure": True}, "channels": list(NAMES)}
    header |= {"metadata": {"scene": SCENE, "bench": BENCH, "writer": "{}"}, "units": ["V"], "started": "now"}
    match choices.below(4):
        case 1:
            header[choices.of(list(header))] = choices.of([None, 5, "x", [], {}, choices.number()])
        case 2:
            header["info"][choices.of(list(header["info"]))] = choices.of([None, 5, "x", [], {}])  # type: ignore[index]
    records = [choices.some() if choices.below(4) == 1 else json.dumps(header).encode()]
    while choices:
        packed = io.BytesIO()
        names = ("volts", "time", "force", "height", "stage", "pump", "frames", "steps", "x")
        rows = choices.of([np.zeros(20), np.zeros((20, 3)), np.zeros(0), np.array(["x"]), np.zeros((2, 2, 2))])
        np.savez(packed, **{choices.of(names): rows})
        records.append(choices.of([packed.getvalue(), choices.some(), packed.getvalue()[: choices.below(300)]]))
    path = _scratch() / "journalled.h5"
    path.write_bytes(b"")
    prefixed = (struct.pack("<QI", len(record), zlib.crc32(record)) + record for record in records)
    journal_of(path).write_bytes(_MAGIC + b"".join(prefixed)[: -choices.below(20) or None])
    # Without a journal that can be read, the empty file itself is tried.
    with refusing(FileError), mock.patch("rig.recovery.probe"):
        recover(path)


TARGETS: dict[str, tuple[Callable[[bytes], None], tuple[bytes, ...]]] = {
    "scene files": (scene_file, (SCENE.encode(),)),
    "bench files": (bench_file, (BENCH.encode(),)),
    "fault scripts": (fault_file, (FAULTS.encode(),)),
    "campaign files": (campaign_file, (CAMPAIGN.encode(),)),
    "campaign journals": (campaign_journal, (JOURNAL_LINE.encode() * 2, JOURNAL_LINE.encode() + b"{")),
    "GCS replies": (gcs_replies, (bytes(18), b"\0\0" * 9 + b"\4\0" + b"1=5\n")),
    "Legato replies": (legato_replies, (b"\n1 2 3 I...i.\r\n>\x11", b"6.5 ml/min")),
    "gRPC replies": (grpc_replies, (bytes(40), b"\2\0" * 20)),
    "parts of recordings": (recording_parts, (bytes(16), b"\1\0\2\0\3\0" * 5)),
    "bytes of recordings": (recording_bytes, (bytes(8),)),
    "journals": (journal, (bytes(16),)),
}
"""By name: what is fuzzed, and inputs to begin with."""
