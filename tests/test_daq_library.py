"""What only the installed runtime's path (ctypes) shows: a pure-Python stand-in for the NI-DAQmx C library."""

from __future__ import annotations

import ctypes
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import nidaqmx._lib
import numpy as np
import pytest
from daq_world import CHANNELS, RATE
from nidaqmx._lib import DaqFunctionImporter, lib_importer

from drivers.daq import BridgeChannel, NIDaq
from drivers.errors import CommandRefused, DataLost, NoReply, NotConnected, WrongDevice

STRINGS = {0x0631: "USB-6211", 0x231E: "Dev1/ai0, Dev1/ai1, Dev1/ai2", 0x193B: "Dev1", 0x1276: "task", 0x1273: ""}
NUMBERS = {0x1272: 24, 0x1923: 8, 0x2F22: 0, 0x0632: 0x1234ABCD, 0x22CA: 0}


class Function:
    """One C function: checks its arguments against ``argtypes`` as ctypes does, then calls Python."""

    def __init__(self, name: str, action: Callable[..., int], calls: Counter[str]) -> None:
        self.argtypes: list[Any] | None = None
        self._name, self._action, self._calls = name, action, calls

    def __call__(self, *arguments: Any) -> int:
        assert self.argtypes is not None
        self._calls[self._name] += 1
        fixed = arguments[: len(self.argtypes)]
        for kind, argument in zip(self.argtypes, fixed, strict=True):
            if argument is not None and not isinstance(argument, _BYREF):
                try:
                    kind.from_param(argument)
                except TypeError as error:
                    raise ctypes.ArgumentError(str(error)) from error
        return self._action(*arguments)


_BYREF = type(ctypes.byref(ctypes.c_int()))


class Library:
    """The functions the driver uses; each attribute is made when it is asked for, as in a shared library."""

    def __init__(self) -> None:
        self.calls: Counter[str] = Counter()
        self.created: list[tuple[Any, ...]] = []
        self.arrays: list[np.ndarray[Any, Any]] = []
        self.status = 0
        self.delivered: int | None = None
        self.names: set[str] = set()

    def __getattr__(self, name: str) -> Function:
        if not name.startswith("DAQmx"):
            raise AttributeError(name)
        action = getattr(self, "_" + name.removeprefix("DAQmx"), None)
        if action is None:
            raise AttributeError(name)
        function = Function(name, action, self.calls)
        setattr(self, name, function)
        return function

    def _SetRuntimeEnvironment(self, *_: Any) -> int:
        return 0

    def _GetSystemInfoAttribute(self, attribute: int, value: Any, *size: Any) -> int:
        return self._attribute(attribute, value, size)

    def _GetDeviceAttribute(self, _device: Any, attribute: int, value: Any, *size: Any) -> int:
        return self._attribute(attribute, value, size)

    def _GetTaskAttribute(self, _task: Any, attribute: int, value: Any, *size: Any) -> int:
        return self._attribute(attribute, value, size)

    def _attribute(self, attribute: int, value: Any, size: Any) -> int:
        if attribute in NUMBERS:
            value._obj.value = NUMBERS[attribute]
            return 0
        text = STRINGS[attribute].encode() + b"\0"
        if value is None or len(value) < len(text):
            return len(text)
        value.value = text[:-1]
        return 0

    def _GetTimingAttribute(self, _task: Any, _attribute: int, value: Any, *_: Any) -> int:
        value._obj.value = RATE
        return 0

    def _SetBufferAttribute(self, *_: Any) -> int:
        return 0

    def _CreateTask(self, name: Any, handle: Any) -> int:
        handle._obj.value = len(self.calls) + 1
        return 0

    def _CreateAIVoltageChan(self, *arguments: Any) -> int:
        self.created.append(arguments)
        return 0

    def _CreateAIForceBridgeTwoPointLinChan(self, *arguments: Any) -> int:
        self.created.append(arguments)
        return 0

    def _CfgSampClkTiming(self, *_: Any) -> int:
        return 0

    def _StartTask(self, *_: Any) -> int:
        return 0

    def _StopTask(self, *_: Any) -> int:
        return 0

    def _ClearTask(self, *_: Any) -> int:
        return 0

    def _GetExtendedErrorInfo(self, text: Any, _size: int) -> int:
        text.value = b"what the driver says"
        return 0

    def _ReadAnalogF64(
        self, _task: Any, samples: int, _timeout: float, fill: int, array: Any, size: int, *out: Any
    ) -> int:
        assert fill == 0
        assert size == array.size
        count = samples if self.delivered is None else self.delivered
        rows = array.reshape(-1, samples)
        rows[:, :count] = np.arange(len(rows))[:, None]
        self.arrays.append(array)
        out[0]._obj.value = count
        return self.status


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Library:
    library = Library()
    functions = DaqFunctionImporter(library)
    monkeypatch.setattr(lib_importer, "_windll", functions)
    monkeypatch.setattr(lib_importer, "_cdll", functions)
    monkeypatch.setattr(lib_importer, "_encoding", "utf-8")
    return library


@pytest.fixture
def daq(library: Library) -> Iterator[NIDaq]:
    with NIDaq(CHANNELS, rate=RATE) as daq:
        daq.start()
        yield daq


def test_the_local_path_asks_for_no_server(daq: NIDaq, library: Library) -> None:
    assert daq.identity.model == "USB-6211"
    assert daq.identity.serial == "1234ABCD"
    assert library.calls["DAQmxCreateTask"] == 1
    assert library.calls["DAQmxCreateAIVoltageChan"] == 3


def test_the_library_gets_contiguous_writable_arrays_of_its_own(daq: NIDaq, library: Library) -> None:
    volts = daq.read(20)
    np.testing.assert_array_equal(volts, np.repeat([[0.0], [1.0], [2.0]], 20, axis=1))
    daq.read(20)
    first, second = library.arrays
    assert first.flags.c_contiguous
    assert first.flags.writeable
    assert not np.shares_memory(first, second)


def test_the_stand_in_refuses_what_ctypes_refuses(daq: NIDaq) -> None:
    """The check above means something: a strided array does not pass."""
    with pytest.raises(ctypes.ArgumentError):
        daq._reader.read_many_sample(np.empty((20, 3)).T, 20, 1.0)


def test_one_read_is_one_call(daq: NIDaq, library: Library) -> None:
    before = library.calls.copy()
    daq.read(20)
    assert dict(library.calls - before) == {"DAQmxReadAnalogF64": 1}


def test_the_task_is_cleared_once(library: Library) -> None:
    daq = NIDaq(CHANNELS, rate=RATE)
    daq.close()
    daq.close()
    assert library.calls["DAQmxClearTask"] == 1


def test_a_partial_read_keeps_what_came(daq: NIDaq, library: Library) -> None:
    library.status, library.delivered = -200284, 5
    with pytest.raises(NoReply, match="5 of 20"):
        daq.read(20)
    library.status, library.delivered = 0, None
    daq.read(20)
    assert [array.shape for array in library.arrays] == [(3, 20), (3, 15)]


@pytest.mark.parametrize(
    ("code", "kind"), [(-200279, DataLost), (-88710, NotConnected), (-200022, NotConnected), (-200077, CommandRefused)]
)
def test_codes_of_the_library_become_the_rigs_errors(
    daq: NIDaq, library: Library, code: int, kind: type[Exception]
) -> None:
    library.status = code
    with pytest.raises(kind, match=f"{code}.*what the driver says"):
        daq.read(20)


def test_a_bridge_channel_leaves_no_default_to_daqmx(library: Library) -> None:
    NIDaq([BridgeChannel("force", "Dev1/ai0", excitation=5.0)], rate=RATE).close()
    _, physical, name, *numbers = library.created[0]
    assert (physical, name) == ("Dev1/ai0", "force")
    newtons, full_bridge, internal, millivolts_per_volt = 15875, 10182, 10200, 15897
    assert numbers[:-1] == [
        *(-25.0, 25.0, newtons, full_bridge, internal, 5.0, 350.0),
        *(0.0, 1.0, millivolts_per_volt, 0.0, 1.0, newtons),
    ]


def test_a_simulated_device_of_the_runtime_is_refused(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(NUMBERS, 0x22CA, 1)
    with pytest.raises(WrongDevice, match="simulated"):
        NIDaq(CHANNELS, rate=RATE)


def test_without_a_runtime_the_remedy_is_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_windll", "_cdll", "_encoding"):
        monkeypatch.setattr(lib_importer, name, None)
    monkeypatch.setattr(nidaqmx._lib, "find_library", lambda _name: None)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(NotConnected, match="runtime is not installed") as failure:
        NIDaq(CHANNELS, rate=RATE)
    assert "ni.com" in failure.value.remedy


def test_on_a_system_without_daqmx_the_error_is_the_rigs(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_windll", "_cdll", "_encoding"):
        monkeypatch.setattr(lib_importer, name, None)
    monkeypatch.setattr("sys.platform", "darwin")
    with pytest.raises(NotConnected, match="not supported on this platform"):
        NIDaq(CHANNELS, rate=RATE)


def test_an_old_runtime_without_a_function_is_told(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(Library, "_CfgSampClkTiming")
    with pytest.raises(NotConnected, match="CfgSampClkTiming"):
        NIDaq(CHANNELS, rate=RATE)
    assert library.calls["DAQmxClearTask"] == 1
