"""The NI driver through the unmodified gRPC client: what it returns, and how everything that goes wrong is told."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent import futures

import grpc
import numpy as np
import pytest
from daq_world import CHANNELS, CHASSIS_CHANNELS, FORCE, RATE, SUPPLY, SignalWorld, connect
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from nidaqmx._stubs import nidaqmx_pb2

import drivers.daq
from drivers.daq import BridgeChannel, NIDaq, VoltageChannel
from drivers.emulated.daq import EmulatedDaq
from drivers.emulated.electronics import compact_daq, usb_6009, usb_6211
from drivers.emulated.faults import Fault
from drivers.errors import (
    BadReply,
    CommandRefused,
    DataLost,
    DeviceError,
    NoReply,
    NotConnected,
    WrongDevice,
)


@pytest.fixture
def world() -> SignalWorld:
    return SignalWorld()


@pytest.fixture
def server(world: SignalWorld) -> Iterator[EmulatedDaq]:
    with EmulatedDaq(world) as server:
        yield server


@pytest.fixture
def daq(server: EmulatedDaq) -> Iterator[NIDaq]:
    with connect(server) as daq:
        yield daq


def test_a_read_is_a_fresh_contiguous_block_in_the_channels_order(daq: NIDaq) -> None:
    first, second = daq.read(20), daq.read(20)
    assert first.shape == second.shape == (3, 20)
    assert first.flags.c_contiguous
    assert not np.shares_memory(first, second)
    np.testing.assert_allclose(first.mean(axis=1), [0.43, 2.406, 5.02], atol=0.01)
    assert daq.channels == ("force", "pressure", "supply")
    assert daq.units == ("V", "V", "V")


def test_channels_come_in_the_order_asked_for(server: EmulatedDaq) -> None:
    with connect(server, SUPPLY, FORCE) as daq:
        assert daq.channels == ("supply", "force")
        np.testing.assert_allclose(daq.read(50).mean(axis=1), [5.02, 0.43], atol=0.01)


def test_the_identity_is_the_devices_own(daq: NIDaq) -> None:
    assert daq.identity.maker == "National Instruments"
    assert daq.identity.model == "USB-6211"
    assert daq.identity.serial == "01A2B3C4"
    assert daq.identity.firmware == "NI-DAQmx 24.8.0"


@pytest.mark.parametrize("asked", [1000.0, 999.9, 1234.5, 7.0])
def test_a_usb_device_divides_its_timebase(server: EmulatedDaq, asked: float) -> None:
    with connect(server, rate=asked) as daq:
        assert asked <= daq.rate <= asked * (1 + asked / 20e6)
        assert 20e6 / daq.rate == pytest.approx(round(20e6 / daq.rate), rel=1e-12)


def test_a_bridge_module_runs_faster_than_asked(world: SignalWorld) -> None:
    with EmulatedDaq(world, compact_daq()) as server, connect(server, *CHASSIS_CHANNELS) as daq:
        assert daq.rate == pytest.approx(50e3 / 31)
        daq.read(100)
        assert world.rates == [daq.rate]
        assert daq.units == ("mV/V", "V", "V")
        # 0.5 N at 0.15 mV/V per N, a zero of 0.4 % of capacity.
        assert daq.read(500)[0].mean() == pytest.approx(0.0809, abs=2e-4)


def test_two_drivers_of_one_seed_read_the_same_bits_however_they_cut(server: EmulatedDaq) -> None:
    other = SignalWorld()
    with connect(server) as whole, EmulatedDaq(other) as second, connect(second) as pieces:
        parts = [pieces.read(n) for n in (1, 19, 20, 7, 53, 400)]
        np.testing.assert_array_equal(whole.read(500), np.concatenate(parts, axis=1))


def test_reading_moves_the_plant_by_exactly_the_samples_read(daq: NIDaq, world: SignalWorld) -> None:
    for samples in (1, 20, 999):
        before = world.sample
        daq.read(samples)
        assert world.sample == before + samples


def test_stop_and_close_may_be_called_again(server: EmulatedDaq) -> None:
    daq = connect(server)
    daq.read(5)
    daq.stop()
    daq.stop()
    with pytest.raises(CommandRefused, match="not running"):
        daq.read(5)
    daq.start()
    assert daq.read(5).shape == (3, 5)
    daq.close()
    daq.close()
    daq.stop()
    with pytest.raises(NotConnected, match="closed"):
        daq.read(5)
    with pytest.raises(NotConnected, match="closed"):
        daq.start()
    assert server.calls["StopTask"] == 1
    assert server.calls["ClearTask"] == 1


def test_a_closed_driver_leaves_the_device_to_the_next(server: EmulatedDaq) -> None:
    for _ in range(3):
        with connect(server) as daq:
            daq.read(10)


def test_a_device_in_use_is_refused_by_name(server: EmulatedDaq, daq: NIDaq) -> None:
    with NIDaq([FORCE], rate=RATE, connection=server.connection) as second, pytest.raises(NotConnected, match="-50103"):
        second.start()
    assert daq.read(5).shape == (3, 5)


def test_a_wrong_model_is_refused(server: EmulatedDaq) -> None:
    with pytest.raises(WrongDevice, match=r"names 'USB-6009'.*'USB-6211'"):
        NIDaq(CHANNELS, rate=RATE, connection=server.connection, expected_model="USB-6009")
    NIDaq(CHANNELS, rate=RATE, connection=server.connection, expected_model="USB-6211").close()


def test_a_missing_device_and_a_missing_input_are_told_apart(server: EmulatedDaq) -> None:
    with pytest.raises(NotConnected, match=r"no device 'Dev7'.*present: Dev1"):
        NIDaq([VoltageChannel("force", "Dev7/ai0")], rate=RATE, connection=server.connection)
    with pytest.raises(WrongDevice, match="no analog input 'Dev1/ai99'"):
        NIDaq([VoltageChannel("force", "Dev1/ai99")], rate=RATE, connection=server.connection)


def test_a_simulated_device_is_refused_unless_wanted(world: SignalWorld) -> None:
    with EmulatedDaq(world, usb_6211(simulated=True)) as server:
        with pytest.raises(WrongDevice, match="simulated"):
            NIDaq(CHANNELS, rate=RATE, connection=server.connection)
        NIDaq(CHANNELS, rate=RATE, connection=server.connection, allow_simulated=True).close()


def test_what_the_device_cannot_do_is_refused_and_releases_the_task(server: EmulatedDaq) -> None:
    with pytest.raises(CommandRefused, match="-200077"):
        NIDaq(CHANNELS, rate=1e6, connection=server.connection)
    with pytest.raises(CommandRefused, match="-200077"):
        NIDaq([VoltageChannel("force", "Dev1/ai0", -40, 40)], rate=RATE, connection=server.connection)
    with pytest.raises(CommandRefused, match="-200431"):
        NIDaq([BridgeChannel("force", "Dev1/ai0")], rate=RATE, connection=server.connection)
    assert server.calls["ClearTask"] == server.calls["CreateTask"] == 3


@pytest.mark.parametrize("host", ["192.0.2.1", "rig.example.org", "0.0.0.0", "[2001:db8::1]"])
def test_another_computer_is_refused_unless_allowed(host: str) -> None:
    with pytest.raises(NotConnected, match="not this computer"):
        NIDaq(CHANNELS, rate=RATE, connection=f"grpc://{host}:31763")


@pytest.mark.parametrize("connection", ["usb", "grpc://", "grpc://127.0.0.1", "http://127.0.0.1:1", "grpc://[::1", ""])
def test_a_connection_that_makes_no_sense_is_refused(connection: str) -> None:
    with pytest.raises(NotConnected):
        NIDaq(CHANNELS, rate=RATE, connection=connection)


def test_localhost_is_this_computer(server: EmulatedDaq) -> None:
    NIDaq(CHANNELS, rate=RATE, connection=f"grpc://localhost:{server.port}").close()


def test_an_absent_server_says_so() -> None:
    with pytest.raises(NotConnected, match="UNAVAILABLE") as failure:
        NIDaq(CHANNELS, rate=RATE, connection="grpc://127.0.0.1:9")
    assert "rig emulate" in failure.value.remedy


@pytest.mark.parametrize(
    ("channels", "options"),
    [
        ([], {}),
        ([FORCE, FORCE], {}),
        ([FORCE], {"rate": 0.0}),
        ([FORCE], {"rate": float("nan")}),
        ([FORCE], {"buffer_seconds": -1.0}),
        ([FORCE], {"patience": 0.0}),
    ],
)
def test_impossible_arguments_are_refused(channels: list[VoltageChannel], options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"channel|must be"):
        NIDaq(channels, **{"rate": RATE, **options})  # type: ignore[arg-type]


def test_impossible_channels_are_refused() -> None:
    with pytest.raises(ValueError, match="none of force"):
        VoltageChannel("torque", "Dev1/ai0")
    with pytest.raises(ValueError, match="Dev1/ai0"):
        VoltageChannel("force", "ai0")
    with pytest.raises(ValueError, match="not below"):
        VoltageChannel("force", "Dev1/ai0", 5, -5)
    with pytest.raises(ValueError, match="terminal"):
        VoltageChannel("force", "Dev1/ai0", terminal="open")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="excitation"):
        BridgeChannel("force", "Dev1/ai0", excitation=0)


def test_a_silent_device_is_no_reply_and_time_has_gone_on(daq: NIDaq, world: SignalWorld) -> None:
    daq.read(20)
    world.faults.add(Fault("daq", "silent", for_samples=400))
    with pytest.raises(NoReply, match="0 of 20 samples"):
        daq.read(20)
    assert world.sample == 20 + 520  # 20 ms for the samples and half a second of patience


def test_samples_of_a_partial_read_are_kept_for_the_next(server: EmulatedDaq, world: SignalWorld) -> None:
    world.force = lambda index: index * 1e-3
    other = SignalWorld()
    other.force = world.force
    with connect(server) as daq, EmulatedDaq(other) as second, connect(second) as undisturbed:
        parts = [daq.read(20)]
        world.faults.add(Fault("daq", "partial", value=7))
        with pytest.raises(NoReply, match="7 of 20 samples"):
            daq.read(20)
        with pytest.raises(NoReply, match="7 of 13 samples"):
            daq.read(20)
        world.faults.clear()
        parts += [daq.read(4), daq.read(40)]
        np.testing.assert_array_equal(np.concatenate(parts, axis=1), undisturbed.read(64))


def test_a_slow_device_delivers_every_sample_late(daq: NIDaq, world: SignalWorld) -> None:
    world.faults.add(Fault("daq", "slow", value=0.1, for_samples=1))
    daq.read(20)
    assert world.sample == 100  # the other 80 wait in the buffer
    daq.read(80)
    assert world.sample == 100
    daq.read(1)
    assert world.sample == 101


def test_a_device_slower_than_the_driver_is_patient_is_no_reply(daq: NIDaq, world: SignalWorld) -> None:
    world.faults.add(Fault("daq", "slow", value=3.0))
    with pytest.raises(NoReply):
        daq.read(20)


def test_an_overrun_is_lost_data_until_started_again(daq: NIDaq, world: SignalWorld) -> None:
    world.faults.add(Fault("daq", "overrun", for_samples=1))
    with pytest.raises(DataLost, match="-200279"):
        daq.read(20)
    world.faults.clear()
    with pytest.raises(DataLost):
        daq.read(20)
    daq.stop()
    daq.start()
    assert daq.read(20).shape == (3, 20)


def test_falling_behind_by_more_than_the_buffer_loses_data(server: EmulatedDaq, world: SignalWorld) -> None:
    with connect(server, buffer_seconds=2.0) as daq:
        world.faults.add(Fault("daq", "silent"))
        for _ in range(5):
            with pytest.raises((NoReply, DataLost)):
                daq.read(20)
        world.faults.clear()
        with pytest.raises(DataLost):
            daq.read(20)


def test_a_removed_device_is_not_connected_and_can_be_closed(server: EmulatedDaq, world: SignalWorld) -> None:
    daq = connect(server)
    world.faults.add(Fault("daq", "removed"))
    with pytest.raises(NotConnected, match="-201003"):
        daq.read(20)
    daq.close()
    with pytest.raises(NotConnected, match="no device 'Dev1'"):
        connect(server)
    world.faults.clear()
    connect(server).close()


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (-200361, DataLost),
        (-200222, DataLost),
        (-200019, DataLost),
        (-88709, NotConnected),
        (-50405, NotConnected),
        (-50103, NotConnected),
        (-200284, NoReply),
        (-200077, CommandRefused),
        (-12345, CommandRefused),
    ],
)
def test_every_daqmx_code_becomes_the_right_error(
    daq: NIDaq, world: SignalWorld, code: int, kind: type[DeviceError]
) -> None:
    world.faults.add(Fault("daq", "error_code", value=code))
    with pytest.raises(kind, match=str(code) if code != -200284 else "0 of 20") as failure:
        daq.read(20)
    assert failure.value.device == "daq"
    assert failure.value.remedy


def test_a_server_that_dies_is_not_connected(world: SignalWorld) -> None:
    server = EmulatedDaq(world).start()
    daq = connect(server)
    daq.read(20)
    server.stop()
    with pytest.raises(NotConnected):
        daq.read(20)
    with pytest.raises(NotConnected):
        daq.stop()
    daq.close()


def test_a_server_that_hangs_does_not_hang_the_rig(
    server: EmulatedDaq, world: SignalWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    with connect(server, patience=0.05) as daq:
        world.faults.add(Fault("daq", "hang"))
        with monkeypatch.context() as impatient:
            impatient.setattr(drivers.daq, "SLOWEST_ANSWER", 0.2)
            with pytest.raises(NoReply, match="DEADLINE_EXCEEDED"):
                daq.read(20)
        daq._deadline.seconds = 60.0
        world.faults.clear()
        with pytest.raises(DataLost, match="earlier read failed"):
            daq.read(20)
        daq.stop()
        daq.start()
        assert daq.read(20).shape == (3, 20)


def test_only_what_is_needed_travels_per_read(daq: NIDaq, server: EmulatedDaq) -> None:
    daq.read(20)
    before = server.calls.copy()
    daq.read(20)
    assert dict(server.calls - before) == {"ReadAnalogF64": 1}


def test_every_voltage_device_serves_the_rig(world: SignalWorld) -> None:
    with EmulatedDaq(world, usb_6009()) as server, connect(server) as daq:
        assert daq.identity.model == "USB-6009"
        volts = daq.read(2000)
        np.testing.assert_allclose(volts.mean(axis=1), [0.43, 2.406, 5.02], atol=0.01)
        assert np.unique(np.round(np.diff(np.unique(volts[0])) / (20 / 2**14))).size >= 1


class Liar:
    """A server that identifies itself like the device and then answers reads with whatever it is told."""

    def __init__(self, world: SignalWorld) -> None:
        self.answer = b""
        self._real = EmulatedDaq(world)
        service = self._real._service
        calls = self._real.calls
        handlers = drivers_handlers(service, calls, lambda _request, _context: self.answer)
        self._server = grpc.server(futures.ThreadPoolExecutor(4), handlers=[handlers])
        self.port = self._server.add_insecure_port("127.0.0.1:0")
        self._server.start()

    @property
    def connection(self) -> str:
        return f"grpc://127.0.0.1:{self.port}"

    def stop(self) -> None:
        self._server.stop(grace=0).wait()
        self._real.stop()


def drivers_handlers(service: object, calls: object, read: object) -> grpc.GenericRpcHandler:  # type: ignore[type-arg]
    from drivers.emulated.daq import _handlers

    truth = _handlers(service, calls)  # type: ignore[arg-type]

    class Handlers(grpc.GenericRpcHandler):  # type: ignore[type-arg, misc]
        def service(self, details: grpc.HandlerCallDetails) -> object:
            if details.method.endswith("/ReadAnalogF64"):
                return grpc.unary_unary_rpc_method_handler(read)  # type: ignore[arg-type]
            return truth.service(details)

    return Handlers()


@pytest.fixture(scope="module")
def liar() -> Iterator[Liar]:
    liar = Liar(SignalWorld())
    yield liar
    liar.stop()


def response(**fields: object) -> bytes:
    return nidaqmx_pb2.ReadAnalogF64Response(**fields).SerializeToString()  # type: ignore[arg-type]


doubles = st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=80)
answers = st.one_of(
    st.binary(max_size=200),
    st.builds(
        lambda status, array, count: response(status=status, read_array=array, samps_per_chan_read=count),
        st.one_of(st.just(0), st.just(-200284), st.integers(-(2**31), 0)),
        doubles,
        st.integers(-(2**31), 2**31 - 1),
    ),
)


@given(answer=answers)
@example(answer=response(status=0, read_array=[1.0] * 60, samps_per_chan_read=20))
@example(answer=response(status=0, read_array=[1.0] * 59, samps_per_chan_read=20))
@example(answer=response(status=0, read_array=[1.0] * 61, samps_per_chan_read=20))
@example(answer=response(status=1))
@example(answer=response(status=-200284, read_array=[1.0] * 2, samps_per_chan_read=7))
@example(answer=response(status=-200284, read_array=[1.0] * 60, samps_per_chan_read=-7))
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
def test_no_answer_of_a_server_crashes_the_driver_or_invents_data(liar: Liar, answer: bytes) -> None:
    if not hasattr(liar, "daq"):
        liar.daq = NIDaq(CHANNELS, rate=RATE, connection=liar.connection)  # type: ignore[attr-defined]
    daq: NIDaq = liar.daq  # type: ignore[attr-defined]
    daq.start()
    liar.answer = answer
    try:
        volts = daq.read(20)
    except (BadReply, NoReply, DataLost, NotConnected, CommandRefused) as error:
        assert error.device == "daq"
    else:
        sent = nidaqmx_pb2.ReadAnalogF64Response.FromString(answer)
        assert sent.samps_per_chan_read == 20
        np.testing.assert_array_equal(volts.ravel(), sent.read_array)
    finally:
        liar.answer = b""
        daq.stop()
