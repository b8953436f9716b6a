"""The RPCs of ``nidaqmx_grpc.NiDAQmx`` the emulated DAQ answers: request in, response out.

A time-out is an OK response with a status and zero-padded data; every other failure is a ``Refusal``. Enumerations
travel in the ``*_raw`` fields.
"""
# ruff: noqa: D102  Each public method is the RPC of its name; ni's nidaqmx.proto documents them.

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import grpc
import numpy as np
from nidaqmx._stubs import nidaqmx_pb2
from nidaqmx.error_codes import DAQmxErrors
from nidaqmx.utils import flatten_channel_string, unflatten_channel_string

from drivers.emulated.acquisition import Acquisition, AtOnce, RealTime, check_present
from drivers.emulated.electronics import Device, Electronics, Input, Refusal
from drivers.emulated.world import World

TIMED_OUT = -200284
DRIVER_VERSION = (24, 8, 0)
CONTINUOUS, FINITE = 10123, 10178
ANALOG_INPUT, VOLTAGE, FORCE_BRIDGE = 10100, 10322, 15899

_MILLIVOLTS_PER_VOLT = {15897: 1.0, 15896: 1e3}  # DAQmx_Val_mVoltsPerVolt, DAQmx_Val_VoltsPerVolt
_NEWTONS = {15875: 1.0, 15876: 4.4482216152605, 15877: 9.80665}  # newtons, pounds, kilogram-force
_LEASE = 2.0  # s without a read, after which another client may take the device over
_LONGEST_READ = 60.0  # s
_EVENT_TICK = 1e-3  # s


@dataclass
class Task:
    """A DAQmx task as the client configures it."""

    name: str
    channels: dict[str, Input] = field(default_factory=dict)
    rate: float = 0.0
    mode: int = CONTINUOUS
    samples: int = 1000
    buffer: int | None = None
    every: int = 0
    running: Acquisition | None = None
    last_read: float = 0.0

    def buffer_size(self) -> int:
        """Samples per channel (NI-DAQmx help, "How is buffer size determined?")."""
        if self.buffer is not None:
            return self.buffer
        if self.mode == FINITE:
            return self.samples
        automatic = next(size for rate, size in _BUFFERS if self.rate <= rate)
        return max(automatic, self.samples)


_BUFFERS = ((100.0, 1_000), (10e3, 10_000), (1e6, 100_000), (float("inf"), 1_000_000))


class DaqService:
    """One method per RPC: request in, response out, ``Refusal`` for a DAQmx error."""

    def __init__(self, world: World, device: Device, seed: int, pace: AtOnce | RealTime) -> None:
        self._world, self._device, self._seed, self._pace = world, device, seed, pace
        self._lock = threading.RLock()
        self._reading = threading.Lock()
        self._tasks: dict[str, Task] = {}
        self._scales: dict[str, tuple[float, float]] = {}
        self._starts = 0
        self._unnamed = 0
        self.stopping = threading.Event()

    # Tasks

    def CreateTask(self, request: Any, context: Any) -> dict[str, Any]:
        with self._lock:
            name = request.session_name or self._free_name()
            behavior = request.initialization_behavior
            exists = name in self._tasks
            if exists and behavior == 1:
                context.abort(grpc.StatusCode.ALREADY_EXISTS, f"Cannot initialize '{name}': it already exists.")
            if not exists and behavior == 2:
                context.abort(grpc.StatusCode.FAILED_PRECONDITION, f"Cannot attach to '{name}': no such session.")
            self._tasks.setdefault(name, Task(name))
            return {"task": {"name": name}, "new_session_initialized": not exists}

    def ClearTask(self, request: Any, context: Any) -> dict[str, Any]:
        with self._lock:
            task = self._task(request)
            self._halt(task)
            task.every = 0
            del self._tasks[task.name]
            return {}

    def StartTask(self, request: Any, context: Any) -> dict[str, Any]:
        with self._lock:
            check_present(self._world)
            task = self._task(request)
            if task.running:
                raise Refusal(-200479, "Specified operation cannot be performed while the task is running.")
            self._run(task)
            return {}

    def StopTask(self, request: Any, context: Any) -> dict[str, Any]:
        with self._lock:
            self._halt(self._task(request))
            return {}

    def TaskControl(self, request: Any, context: Any) -> dict[str, Any]:
        with self._lock:
            task = self._task(request)
            if request.action_raw == 0:  # DAQmx_Val_Task_Start
                self._run(task)
            elif request.action_raw in (1, 6):  # stop, abort
                self._halt(task)
            return {}

    def IsTaskDone(self, request: Any, context: Any) -> dict[str, Any]:
        task = self._task(request)
        return {"is_task_done": task.running is None or task.running.done}

    def WaitUntilTaskDone(self, request: Any, context: Any) -> dict[str, Any]:
        task = self._task(request)
        if task.running is not None and not self._ends(task.running, task, request.time_to_wait):
            raise Refusal(-200560, "Wait Until Done did not indicate that the task was done within the time-out.")
        return {}

    # Channels and timing

    def CreateAIVoltageChan(self, request: Any, context: Any) -> dict[str, Any]:
        name = request.custom_scale_name
        gain, offset = self._scale(name) if name else (1.0, 0.0)
        return self._add(request, bridge=False, gain=gain, offset=offset)

    def CreateAIForceBridgeTwoPointLinChan(self, request: Any, context: Any) -> dict[str, Any]:
        electrical = _MILLIVOLTS_PER_VOLT.get(request.electrical_units_raw)
        physical = _NEWTONS.get(request.physical_units_raw)
        units = _NEWTONS.get(request.units_raw)
        if electrical is None or physical is None or units is None:
            raise Refusal(-200077, "Requested units are not supported.")
        span = (request.second_electrical_val - request.first_electrical_val) * electrical
        if span == 0:
            raise Refusal(-200077, "The two electrical values must differ.")
        gain = (request.second_physical_val - request.first_physical_val) * physical / units / span
        offset = request.first_physical_val * physical / units - gain * request.first_electrical_val * electrical
        return self._add(request, bridge=True, gain=gain, offset=offset)

    def CreateLinScale(self, request: Any, context: Any) -> dict[str, Any]:
        self._scales[request.name] = (request.slope, request.y_intercept)
        return {}

    def CfgSampClkTiming(self, request: Any, context: Any) -> dict[str, Any]:
        with self._lock:
            task = self._task(request)
            self._check_stopped(task)
            if request.sample_mode_raw not in (CONTINUOUS, FINITE):
                raise Refusal(-200077, "Requested sample mode is not supported.")
            self._check_channels(task)
            task.rate = self._device.coerce_rate(request.rate, len(task.channels))
            task.mode, task.samples = request.sample_mode_raw, int(request.samps_per_chan)
            return {}

    # Reading

    def ReadAnalogF64(self, request: Any, context: Any) -> bytes:
        count = request.num_samps_per_chan
        task, running = self._for_reading(request, context)
        if count < 0:
            count = task.samples if task.mode == FINITE else running.available
        if request.array_size_in_samps < count * len(task.channels):
            raise Refusal(-200229, "Buffer is too small to fit read data.", 0)
        if request.fill_mode_raw not in (0, 1):
            raise Refusal(-200077, f"Fill mode {request.fill_mode_raw} is not supported.", 0)
        volts = self._read(running, count, request.timeout, context)
        data = np.zeros((len(task.channels), count))
        data[:, : volts.shape[1]] = volts
        flat = np.ravel(data, order="C" if request.fill_mode_raw == 0 else "F")
        padding = bytes(8 * (request.array_size_in_samps - flat.size))
        return _read_response(TIMED_OUT if volts.shape[1] < count else 0, flat.tobytes() + padding, volts.shape[1])

    def ReadAnalogScalarF64(self, request: Any, context: Any) -> dict[str, Any]:
        _, running = self._for_reading(request, context)
        volts = self._read(running, 1, request.timeout, context)
        if not volts.size:
            raise Refusal(TIMED_OUT, "Some or all of the samples requested have not yet been acquired.", 0)
        return {"value": float(volts[0, 0])}

    # Events

    def RegisterEveryNSamplesEvent(self, request: Any, context: Any) -> Iterator[dict[str, Any]]:
        with self._lock:
            task = self._task(request)
            if task.running:
                raise Refusal(-200960, "Register all your events prior to starting the task.")
            if task.every:
                raise Refusal(-200966, "DAQmx software event has already been registered.")
            if not request.n_samples:
                raise Refusal(-200077, "An event every 0 samples is not supported.")
            task.every = request.n_samples
        context.send_initial_metadata(())  # the client waits for it before it goes on
        answer = {
            "every_n_samples_event_type_raw": request.every_n_samples_event_type_raw,
            "n_samples": request.n_samples,
        }
        return (answer for _ in self._every(task, context))

    def UnregisterEveryNSamplesEvent(self, request: Any, context: Any) -> dict[str, Any]:
        self._task(request).every = 0
        return {}

    def _every(self, task: Task, context: Any) -> Iterator[int]:
        """Yield whenever another ``task.every`` samples are in the buffer, while anybody listens."""
        heard, due = None, 0
        while context.is_active() and task.every and not self.stopping.wait(_EVENT_TICK):
            if task.running is not heard:
                heard, due = task.running, task.every
            while heard is not None and heard is task.running and heard.acquired >= due:
                yield due
                due += task.every

    # Attributes

    def GetSystemInfoAttributeUInt32(self, request: Any, context: Any) -> dict[str, Any]:
        numbers = (0x1272, 0x1923, 0x2F22)  # major, minor, update version of the driver
        return {"value": _known(dict(zip(numbers, DRIVER_VERSION, strict=True)), request.attribute_raw)}

    def GetSystemInfoAttributeString(self, request: Any, context: Any) -> dict[str, Any]:
        gone = self._world.faults.active("daq", "removed") is not None
        names = [] if gone else [module.name for module in self._device.modules]
        values = {0x193B: flatten_channel_string(names), 0x1265: flatten_channel_string(list(self._tasks))}
        return {"value": _known(values, request.attribute_raw)}

    def GetDeviceAttributeString(self, request: Any, context: Any) -> dict[str, Any]:
        check_present(self._world)
        module = self._device.module(request.device_name)
        values = {0x0631: module.product, 0x231E: ", ".join(self._device.inputs(module.name))}
        return {"value": _known(values, request.attribute_raw)}

    def GetDeviceAttributeUInt32(self, request: Any, context: Any) -> dict[str, Any]:
        check_present(self._world)
        return {"value": _known({0x0632: self._device.module(request.device_name).serial}, request.attribute_raw)}

    def GetDeviceAttributeBool(self, request: Any, context: Any) -> dict[str, Any]:
        check_present(self._world)
        self._device.module(request.device_name)
        return {"value": _known({0x22CA: self._device.simulated}, request.attribute_raw)}

    def GetTaskAttributeString(self, request: Any, context: Any) -> dict[str, Any]:
        task = self._task(request)
        modules = sorted({wanted.physical.split("/")[0] for wanted in task.channels.values()})
        values = {0x1276: task.name, 0x1273: flatten_channel_string(list(task.channels)), 0x230E: ", ".join(modules)}
        return {"value": _known(values, request.attribute_raw)}

    def GetTaskAttributeUInt32(self, request: Any, context: Any) -> dict[str, Any]:
        task = self._task(request)
        modules = {wanted.physical.split("/")[0] for wanted in task.channels.values()}
        return {"value": _known({0x2181: len(task.channels), 0x29BA: len(modules)}, request.attribute_raw)}

    def GetTimingAttributeDouble(self, request: Any, context: Any) -> dict[str, Any]:
        task = self._timed(request)
        return {"value": _known({0x1344: task.rate}, request.attribute_raw)}

    def GetTimingAttributeInt32(self, request: Any, context: Any) -> dict[str, Any]:
        return {"value_raw": _known({0x1300: self._timed(request).mode}, request.attribute_raw)}

    def GetTimingAttributeUInt64(self, request: Any, context: Any) -> dict[str, Any]:
        return {"value": _known({0x1310: self._timed(request).samples}, request.attribute_raw)}

    def GetBufferAttributeUInt32(self, request: Any, context: Any) -> dict[str, Any]:
        return {"value": _known({0x186C: self._timed(request).buffer_size()}, request.attribute_raw)}

    def SetBufferAttributeUInt32(self, request: Any, context: Any) -> dict[str, Any]:
        with self._lock:
            task = self._task(request)
            self._check_stopped(task)
            _known({0x186C: None}, request.attribute_raw)
            task.buffer = request.value
            return {}

    def GetReadAttributeUInt32(self, request: Any, context: Any) -> dict[str, Any]:
        task = self._task(request)
        available = task.running.available if task.running else 0
        default = task.samples if task.mode == FINITE else available
        values = {0x217B: len(task.channels), 0x1223: available, 0x31E8: default}
        return {"value": _known(values, request.attribute_raw)}

    def GetReadAttributeUInt64(self, request: Any, context: Any) -> dict[str, Any]:
        running = self._task(request).running
        if running is None:
            raise Refusal(-200983, "Property can be read only while the task is running.")
        return {"value": _known({0x192A: running.acquired, 0x1221: running.position}, request.attribute_raw)}

    def GetReadAttributeString(self, request: Any, context: Any) -> dict[str, Any]:
        names = flatten_channel_string(list(self._task(request).channels))
        return {"value": _known({0x1823: names}, request.attribute_raw)}

    def GetChanAttributeInt32(self, request: Any, context: Any) -> dict[str, Any]:
        wanted = self._channel(request)
        kind = FORCE_BRIDGE if wanted.bridge else VOLTAGE
        return {"value_raw": _known({0x187F: ANALOG_INPUT, 0x0695: kind}, request.attribute_raw)}

    def GetChanAttributeDouble(self, request: Any, context: Any) -> dict[str, Any]:
        wanted = self._channel(request)
        span = self._device.module(wanted.physical).range_for(*wanted.limits)
        values = {0x17DE: wanted.minimum, 0x17DD: wanted.maximum, 0x1816: -span, 0x1815: span}
        return {"value": _known(values, request.attribute_raw)}

    def GetScaleAttributeDouble(self, request: Any, context: Any) -> dict[str, Any]:
        slope, intercept = self._scale(request.scale_name)
        return {"value": _known({0x1227: slope, 0x1228: intercept}, request.attribute_raw)}

    def GetErrorString(self, request: Any, context: Any) -> dict[str, Any]:
        try:
            name = DAQmxErrors(request.error_code).name
        except ValueError:
            return {"error_string": ""}
        return {"error_string": f"{name.replace('_', ' ').capitalize()}."}

    # What they share

    def _task(self, request: Any) -> Task:
        try:
            return self._tasks[request.task.name]
        except KeyError:
            raise Refusal(-200088, "Task specified is invalid or does not exist.") from None

    def _timed(self, request: Any) -> Task:
        task = self._task(request)
        if not task.rate:
            raise Refusal(-200452, "Specified property is not supported: the task has no sample clock.")
        return task

    def _channel(self, request: Any) -> Input:
        task = self._task(request)
        names = unflatten_channel_string(request.channel) or list(task.channels)
        if not names or names[0] not in task.channels:
            raise Refusal(-200099, f"Specified channel {request.channel!r} is not in the task.")
        return task.channels[names[0]]

    def _scale(self, name: str) -> tuple[float, float]:
        try:
            return self._scales[name]
        except KeyError:
            raise Refusal(-200378, f"Specified scale does not exist: {name}.") from None

    def _free_name(self) -> str:
        while (name := f"_unnamedTask<{self._unnamed:X}>") in self._tasks:
            self._unnamed += 1
        return name

    def _add(self, request: Any, bridge: bool, gain: float, offset: float) -> dict[str, Any]:
        with self._lock:
            check_present(self._world)
            task = self._task(request)
            self._check_stopped(task)
            if gain == 0 or not math.isfinite(gain) or not math.isfinite(offset):
                raise Refusal(-200077, f"Scaling by {gain} and {offset} is not supported.")
            names = unflatten_channel_string(request.physical_channel)
            assigned = request.name_to_assign_to_channel
            for i, physical in enumerate(names):
                wanted = Input(physical, request.min_val, request.max_val, bridge, gain, offset)
                self._device.check(wanted)
                name = f"{assigned}{i}" if assigned and len(names) > 1 else assigned or physical
                if name in task.channels:
                    raise Refusal(-200489, f"Specified channel cannot be added to the task: {name!r} is already in it.")
                task.channels[name] = wanted
            return {}

    def _ends(self, running: Acquisition, task: Task, timeout: float) -> bool:
        if task.mode == FINITE:
            self._pace.until(running, task.samples, timeout)
        return running.done

    def _check_channels(self, task: Task) -> None:
        if not task.channels:
            raise Refusal(-200478, "Specified operation cannot be performed when there are no channels in the task.")

    def _check_stopped(self, task: Task) -> None:
        if task.running:
            raise Refusal(-200557, "Specified property cannot be set while the task is running.")

    def _run(self, task: Task) -> None:
        self._check_channels(task)
        self._reserve(task)
        rate = task.rate or self._device.coerce_rate(1000.0, len(task.channels))
        electronics = Electronics(
            self._device,
            list(task.channels.values()),
            rate,
            seed=self._seed,
            run=self._starts,
            faults=self._world.faults,
            start=self._world.sample,
        )
        self._starts += 1
        total = task.samples if task.mode == FINITE and task.rate else None
        buffer = task.buffer_size() if task.rate else 1_000
        task.running = Acquisition(self._world, electronics, self._pace, rate, buffer, total)
        task.last_read = time.monotonic()
        if isinstance(self._pace, RealTime):
            self._pace.attach(task.running)

    def _reserve(self, task: Task) -> None:
        """One running task per device; a client that has gone silent loses it."""
        for other in self._tasks.values():
            if other is task or other.running is None:
                continue
            if time.monotonic() - other.last_read < _LEASE:
                raise Refusal(-50103, f"The specified resource is reserved by task {other.name!r}.")
            self._halt(other)

    def _halt(self, task: Task) -> None:
        if task.running is None:
            return
        task.running = None
        if isinstance(self._pace, RealTime):
            self._pace.attach(None)

    def _for_reading(self, request: Any, context: Any) -> tuple[Task, Acquisition]:
        with self._lock:
            check_present(self._world)
            task = self._task(request)
            if task.running is None:
                self._run(task)
            task.last_read = time.monotonic()
            assert task.running is not None
            return task, task.running

    def _read(self, running: Acquisition, samples: int, timeout: float, context: Any) -> np.ndarray[Any, Any]:
        with self._reading:
            if self._world.faults.active("daq", "hang") is not None:
                self._pace.rest(running, max(timeout, 0.0))
                while context.is_active() and not self.stopping.wait(0.01):
                    pass
                context.abort(grpc.StatusCode.DEADLINE_EXCEEDED, "The server has been told to hang.")
            return running.read(samples, min(timeout, _LONGEST_READ))


def _known(values: dict[int, Any], attribute: int) -> Any:
    try:
        return values[attribute]
    except KeyError:
        raise Refusal(-200452, f"Specified property {attribute:#x} is not supported by the device.") from None


def _read_response(status: int, doubles: bytes, samples: int) -> bytes:
    """Serialise a ReadAnalogF64Response at memory speed; ``read_array`` is its field 2, packed."""
    head: bytes = nidaqmx_pb2.ReadAnalogF64Response(status=status, samps_per_chan_read=samples).SerializeToString()
    return head + b"\x12" + _varint(len(doubles)) + doubles


def _varint(number: int) -> bytes:
    digits = bytearray()
    while number > 0x7F:
        digits.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes(digits) + bytes([number])
