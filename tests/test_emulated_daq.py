"""The emulated DAQ as any nidaqmx client sees it, and as real time makes it behave."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import grpc
import nidaqmx
import numpy as np
import pytest
from daq_world import RATE, SignalWorld, connect
from nidaqmx.constants import AcquisitionType, BridgePhysicalUnits, ForceUnits, VoltageUnits
from nidaqmx.errors import DaqError, DaqReadError, RpcError
from nidaqmx.grpc_session_options import GrpcSessionOptions, SessionInitializationBehavior
from nidaqmx.stream_readers import AnalogMultiChannelReader
from nidaqmx.system import System

from drivers.daq import NIDaq
from drivers.emulated.daq import FAULTS, EmulatedDaq
from drivers.emulated.electronics import compact_daq
from drivers.emulated.faults import Fault
from drivers.errors import BadReply, DataLost


@pytest.fixture
def world() -> SignalWorld:
    return SignalWorld()


@pytest.fixture
def server(world: SignalWorld) -> Iterator[EmulatedDaq]:
    with EmulatedDaq(world) as server:
        yield server


@pytest.fixture
def options(server: EmulatedDaq) -> Iterator[GrpcSessionOptions]:
    with grpc.insecure_channel(server.address) as channel:
        yield GrpcSessionOptions(channel, "")


@pytest.fixture
def task(options: GrpcSessionOptions) -> Iterator[nidaqmx.Task]:
    with nidaqmx.Task(grpc_options=options) as task:
        yield task


def timed(task: nidaqmx.Task, samples: int = 1000, mode: AcquisitionType = AcquisitionType.CONTINUOUS) -> nidaqmx.Task:
    task.ai_channels.add_ai_voltage_chan("Dev1/ai0:2")
    task.timing.cfg_samp_clk_timing(RATE, sample_mode=mode, samps_per_chan=samples)
    return task


def code_of(failure: pytest.ExceptionInfo[DaqError]) -> int:
    return int(failure.value.error_code)


def test_the_system_lists_the_device_and_its_inputs(options: GrpcSessionOptions) -> None:
    system = System.remote(options)
    assert system.driver_version == (24, 8, 0)
    (device,) = system.devices
    assert (device.name, device.product_type, device.is_simulated) == ("Dev1", "USB-6211", False)
    assert device.ai_physical_chans.channel_names == [f"Dev1/ai{i}" for i in range(16)]


def test_the_plain_task_interface_works(task: nidaqmx.Task) -> None:
    timed(task)
    assert task.channel_names == ["Dev1/ai0", "Dev1/ai1", "Dev1/ai2"]
    assert [device.name for device in task.devices] == ["Dev1"]
    assert (task.number_of_channels, task.number_of_devices) == (3, 1)
    assert task.timing.samp_clk_rate == RATE
    assert task.timing.samp_quant_samp_mode == AcquisitionType.CONTINUOUS
    task.start()
    values = np.array(task.read(100))
    np.testing.assert_allclose(values.mean(axis=1), [0.43, 2.406, 5.02], atol=0.01)
    assert task.in_stream.total_samp_per_chan_acquired == 100
    assert task.in_stream.curr_read_pos == 100
    assert not task.is_task_done()
    task.stop()
    assert task.is_task_done()


def test_a_finite_acquisition_ends(task: nidaqmx.Task) -> None:
    timed(task, 60, AcquisitionType.FINITE)
    task.start()
    assert np.array(task.read(50)).shape == (3, 50)
    with pytest.raises(DaqReadError) as failure:
        task.read(20)
    assert code_of(failure) == -200278
    assert np.array(task.read(10)).shape == (3, 10)
    task.wait_until_done(timeout=1.0)


def test_waiting_for_the_end_of_an_endless_task_times_out(task: nidaqmx.Task) -> None:
    timed(task).start()
    with pytest.raises(DaqError) as failure:
        task.wait_until_done(timeout=0.0)
    assert code_of(failure) == -200560


def test_a_single_untimed_read_gives_one_value(task: nidaqmx.Task) -> None:
    task.ai_channels.add_ai_voltage_chan("Dev1/ai2")
    assert task.read() == pytest.approx(5.02, abs=0.01)


@pytest.mark.parametrize(
    ("rate", "samples", "expected"), [(50, 10, 1000), (1000, 1000, 10_000), (1000, 40_000, 40_000), (20e3, 9, 100_000)]
)
def test_the_buffer_is_sized_as_ni_documents(task: nidaqmx.Task, rate: float, samples: int, expected: int) -> None:
    task.ai_channels.add_ai_voltage_chan("Dev1/ai0")
    task.timing.cfg_samp_clk_timing(rate, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=samples)
    assert task.in_stream.input_buf_size == expected
    task.in_stream.input_buf_size = 123
    assert task.in_stream.input_buf_size == 123


def test_a_partial_read_is_an_ok_response_with_padding(task: nidaqmx.Task, world: SignalWorld) -> None:
    timed(task).start()
    reader = AnalogMultiChannelReader(task.in_stream)
    world.faults.add(Fault("daq", "partial", value=3))
    data = np.full((3, 10), 7.0)
    with pytest.raises(DaqReadError) as failure:
        reader.read_many_sample(data, 10, 0.1)
    assert code_of(failure) == -200284
    assert failure.value.samps_per_chan_read == 3
    assert (data[:, :3] != 0).all()
    assert (data[:, 3:] == 0).all()


def test_a_failed_read_tells_how_many_samples_came(task: nidaqmx.Task, world: SignalWorld) -> None:
    timed(task).start()
    world.faults.add(Fault("daq", "overrun"))
    with pytest.raises(DaqReadError) as failure:
        task.read(10)
    assert code_of(failure) == -200279
    assert failure.value.samps_per_chan_read == 0


def test_a_force_bridge_channel_scales_as_daqmx_does(world: SignalWorld) -> None:
    with (
        EmulatedDaq(world, compact_daq()) as server,
        grpc.insecure_channel(server.address) as channel,
        nidaqmx.Task(grpc_options=GrpcSessionOptions(channel, "")) as task,
    ):
        world.force = lambda index: np.full(index.size, 4.0)
        task.ai_channels.add_ai_force_bridge_two_point_lin_chan(
            "cDAQ1Mod1/ai0",
            min_val=-2.2,
            max_val=2.2,
            units=ForceUnits.POUNDS,
            second_electrical_val=0.15 * 4.4482216152605,
            second_physical_val=1.0,
            physical_units=BridgePhysicalUnits.POUNDS,
        )
        task.timing.cfg_samp_clk_timing(2000.0, sample_mode=AcquisitionType.CONTINUOUS)
        task.start()
        pounds = np.mean(task.read(2000))
        assert pounds == pytest.approx((4.0 + 0.004 * 9.80665) / 4.4482216152605, rel=2e-3)


def test_a_custom_scale_is_applied(options: GrpcSessionOptions, task: nidaqmx.Task) -> None:
    nidaqmx.Scale.create_lin_scale("millivolts", slope=1000.0, y_intercept=5.0, grpc_options=options)
    scale = nidaqmx.Scale("millivolts", grpc_options=options)
    assert (scale.lin_slope, scale.lin_y_intercept) == (1000.0, 5.0)
    task.ai_channels.add_ai_voltage_chan(
        "Dev1/ai2", min_val=-9000, max_val=9000, units=VoltageUnits.FROM_CUSTOM_SCALE, custom_scale_name="millivolts"
    )
    assert task.read() == pytest.approx(5025.0, abs=5.0)


@pytest.mark.parametrize(
    ("channel", "limits", "code"),
    [
        ("Dev1/ai77", {}, -200170),
        ("Dev9/ai0", {}, -200220),
        ("Dev1/ai0", {"min_val": 5.0, "max_val": -5.0}, -200082),
        ("Dev1/ai0", {"min_val": -50.0, "max_val": 50.0}, -200077),
    ],
)
def test_impossible_channels_get_daqmx_codes(
    task: nidaqmx.Task, channel: str, limits: dict[str, float], code: int
) -> None:
    with pytest.raises(DaqError) as failure:
        task.ai_channels.add_ai_voltage_chan(channel, **limits)
    assert code_of(failure) == code


def test_a_running_task_cannot_be_changed_or_started_again(task: nidaqmx.Task) -> None:
    timed(task).start()
    for change, code in (
        (task.start, -200479),
        (lambda: task.timing.cfg_samp_clk_timing(500.0), -200557),
        (lambda: setattr(task.in_stream, "input_buf_size", 9), -200557),
        (lambda: task.ai_channels.add_ai_voltage_chan("Dev1/ai5"), -200557),
    ):
        with pytest.raises(DaqError) as failure:
            change()
        assert code_of(failure) == code


def test_a_task_without_channels_cannot_be_timed(task: nidaqmx.Task) -> None:
    with pytest.raises(DaqError) as failure:
        task.timing.cfg_samp_clk_timing(500.0)
    assert code_of(failure) == -200478


def test_an_unknown_property_is_a_daqmx_error_and_an_unknown_call_unimplemented(task: nidaqmx.Task) -> None:
    timed(task)
    with pytest.raises(DaqError) as failure:
        _ = task.timing.ai_conv_rate
    assert code_of(failure) == -200452
    with pytest.raises(RpcError, match="not supported"):
        task.ao_channels.add_ao_voltage_chan("Dev1/ao0")


def test_a_cleared_task_is_invalid(options: GrpcSessionOptions) -> None:
    task = nidaqmx.Task(grpc_options=options)
    handle, interpreter = task._handle, task._interpreter
    task.close()
    with pytest.raises(DaqError) as failure:
        interpreter.start_task(handle)
    assert code_of(failure) == -200088


def test_sessions_are_shared_created_and_missed_as_ni_does(server: EmulatedDaq) -> None:
    with grpc.insecure_channel(server.address) as channel:

        def open_as(behavior: SessionInitializationBehavior) -> nidaqmx.Task:
            return nidaqmx.Task(
                "shared", grpc_options=GrpcSessionOptions(channel, "shared", initialization_behavior=behavior)
            )

        with pytest.raises(RpcError, match="no such session"):
            open_as(SessionInitializationBehavior.ATTACH_TO_SERVER_SESSION)
        with open_as(SessionInitializationBehavior.AUTO) as task:
            timed(task)
            with open_as(SessionInitializationBehavior.ATTACH_TO_SERVER_SESSION) as same:
                assert same.channel_names == task.channel_names
            with pytest.raises(RpcError, match="already exists"):
                open_as(SessionInitializationBehavior.INITIALIZE_SERVER_SESSION)
            assert task.number_of_channels == 3
        assert server.calls["ClearTask"] == 1


def test_two_tasks_cannot_run_on_one_device(options: GrpcSessionOptions, task: nidaqmx.Task) -> None:
    timed(task).start()
    with nidaqmx.Task(grpc_options=options) as second:
        timed(second)
        with pytest.raises(DaqError) as failure:
            second.start()
        assert code_of(failure) == -50103
        task.stop()
        second.start()


def test_a_client_that_has_died_loses_the_device(
    server: EmulatedDaq, world: SignalWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.emulated.daq_service._LEASE", 0.0)
    dead = connect(server)
    dead.read(10)
    with connect(server) as alive:
        assert alive.read(10).shape == (3, 10)
    dead.close()


def test_the_codes_have_texts(options: GrpcSessionOptions) -> None:
    interpreter = System.remote(options)._interpreter
    assert interpreter.get_error_string(-200279) == "Samples no longer available."


def test_a_big_read_travels_whole(server: EmulatedDaq) -> None:
    """More than gRPC's default of 4 MiB in one answer."""
    with connect(server, buffer_seconds=300.0) as daq:
        assert daq.read(200_000).shape == (3, 200_000)


def test_only_the_loopback_interface_is_served(server: EmulatedDaq) -> None:
    assert server.address.startswith("127.0.0.1:")
    assert server.port > 0


def test_a_port_in_use_is_not_shared(server: EmulatedDaq, world: SignalWorld) -> None:
    with pytest.raises(RuntimeError, match=r"bind|address"):
        EmulatedDaq(world, port=server.port)


def test_every_fault_kind_is_documented_by_device() -> None:
    assert set(FAULTS) == {"daq", "force", "pressure", "supply"}
    assert all(text for kinds in FAULTS.values() for text in kinds.values())


# Real time

LARGE = 1_000_000
"""Samples of a buffer that no reader on a busy computer is too late for."""


def sawtooth(index: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """A force of 1 mN per sample, within the range of the input however long the plant has been running."""
    return index % 1000 * 1e-3


def steps(volts: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Samples the sawtooth has gone on by, from sample to sample."""
    return (np.diff(volts) / 0.8e-3 + 500) % 1000 - 500


def patient(server: EmulatedDaq, **options: float) -> NIDaq:
    """Return the driver as ``connect`` does; it does not mind a busy computer."""
    return connect(server, **{"buffer_seconds": LARGE / RATE, "patience": 60.0, **options})


def test_every_n_samples_the_client_is_called(world: SignalWorld) -> None:
    with (
        EmulatedDaq(world, speed=20.0) as server,
        grpc.insecure_channel(server.address) as channel,
        nidaqmx.Task(grpc_options=GrpcSessionOptions(channel, "")) as task,
    ):
        timed(task, LARGE)
        reader = AnalogMultiChannelReader(task.in_stream)
        blocks: list[np.ndarray[Any, Any]] = []

        def arrived(_task: object, _kind: object, samples: int, _data: object) -> int:
            block = np.empty((3, samples))
            reader.read_many_sample(block, samples, 60.0)
            blocks.append(block)
            return 0

        world.force = sawtooth
        task.register_every_n_samples_acquired_into_buffer_event(50, arrived)
        task.start()
        eventually(lambda: len(blocks) >= 6)
        task.stop()
        assert np.abs(steps(np.concatenate(blocks, axis=1)[0]) - 1).max() < 8
        task.register_every_n_samples_acquired_into_buffer_event(50, None)


def test_events_are_registered_once_and_before_the_start(task: nidaqmx.Task) -> None:
    timed(task)
    interpreter, handle = task._interpreter, task._handle

    def register(samples: int) -> Any:
        return interpreter.register_every_n_samples_event(handle, 1, samples, 0, lambda *_: 0, None)

    with pytest.raises(DaqError) as failure:
        register(0)
    assert code_of(failure) == -200077
    first = register(10)
    with pytest.raises(DaqError) as failure:
        register(10)
    assert code_of(failure) == -200966
    interpreter.unregister_every_n_samples_event(handle, 1)
    first.close()
    task.start()
    with pytest.raises(DaqError) as failure:
        register(10)
    assert code_of(failure) == -200960


def eventually(condition: Any, seconds: float = 200.0) -> None:
    """Wait until it is so; fails only if it never is."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.005)


def test_in_real_time_the_plant_lives_though_nobody_reads(world: SignalWorld) -> None:
    with EmulatedDaq(world, speed=20.0):
        eventually(lambda: world.sample > 500)
    stopped = world.sample
    time.sleep(0.05)
    assert world.sample == stopped


def test_in_real_time_the_stream_is_contiguous_and_not_ahead_of_the_plant(world: SignalWorld) -> None:
    world.force = sawtooth
    with EmulatedDaq(world, speed=10.0) as server, patient(server) as daq:
        volts = np.concatenate([daq.read(50) for _ in range(40)], axis=1)
        assert np.abs(steps(volts[0]).mean() - 1) < 0.02
        assert np.abs(steps(volts[0]) - 1).max() < 8  # one step is 0.8 mV, noise 0.5 mV; a gap of one frame would be 50
        assert world.sample >= 2000


def test_in_real_time_no_sample_comes_before_its_time(world: SignalWorld) -> None:
    with EmulatedDaq(world, speed=2.0) as server:
        begin = time.perf_counter()
        with patient(server) as daq:
            daq.read(200)
            assert time.perf_counter() - begin >= 0.1


def test_in_real_time_a_reader_that_sleeps_overruns(world: SignalWorld) -> None:
    with EmulatedDaq(world, speed=50.0) as server, connect(server, buffer_seconds=0.2) as daq:
        begin = world.sample
        eventually(lambda: world.sample > begin + 300)
        with pytest.raises(DataLost, match="-200279"):
            daq.read(20)


def test_in_real_time_the_idle_rate_gives_way_to_the_tasks(world: SignalWorld) -> None:
    with EmulatedDaq(world, speed=10.0) as server:
        eventually(lambda: world.sample > 10)
        with patient(server, rate=500.0) as daq:
            daq.read(20)
        eventually(lambda: world.rates[-1] == 1000.0)
        assert {500.0, 1000.0} == set(world.rates)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_plant_that_fails_in_real_time_is_told_to_reader_and_owner(world: SignalWorld) -> None:
    def breaks(_index: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        raise ArithmeticError("the membrane has left the world")

    server = EmulatedDaq(world, speed=5.0).start()
    daq = patient(server)
    world.force = breaks
    with pytest.raises(BadReply, match="left the world"):
        daq.read(2000)
    with pytest.raises(RuntimeError, match="left the world"):
        server.stop()
    daq.close()


def test_an_impossible_speed_is_refused(world: SignalWorld) -> None:
    for speed in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="speed"):
            EmulatedDaq(world, speed=speed)


def test_nothing_is_left_running(world: SignalWorld) -> None:
    before = set(threading.enumerate())
    with EmulatedDaq(world, speed=10.0) as server, patient(server) as daq:
        daq.read(20)
    eventually(lambda: set(threading.enumerate()) <= before)
