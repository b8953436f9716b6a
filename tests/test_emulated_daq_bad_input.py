"""The emulated DAQ answers whatever it is sent: a response or a DAQmx error, and goes on serving."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import grpc
import pytest
from daq_world import SignalWorld, connect
from hypothesis import given, settings
from hypothesis import strategies as st
from nidaqmx._stubs import nidaqmx_pb2

from drivers.emulated.daq import EmulatedDaq
from drivers.emulated.daq_service import DaqService

SERVICE = nidaqmx_pb2.DESCRIPTOR.services_by_name["NiDAQmx"]
CALLS = sorted(
    method.name for method in SERVICE.methods if hasattr(DaqService, method.name) and not method.server_streaming
)
REFUSALS = (grpc.StatusCode.ALREADY_EXISTS, grpc.StatusCode.FAILED_PRECONDITION, grpc.StatusCode.UNIMPLEMENTED)

texts = st.sampled_from(
    ["", "task", "Dev1", "Dev1/ai0", "Dev1/ai0:2", "Dev1/ai9:99", "scale", "a, b", "\n", "cDAQ1Mod1/ai0"]
)
integers = st.one_of(
    st.sampled_from([0, 1, 2, 10123, 10178, 15875, 15896, 15897, 0x1344, 0x186C, 0x1276, 0x217B, 0x0631]),
    st.integers(-(2**31), 2**31 - 1),
)
numbers = st.one_of(st.sampled_from([0.0, -10.0, 10.0, 1000.0, 1e-3]), st.floats())


class Client:
    """A client with one session called ``task``, that sends what it likes."""

    def __init__(self) -> None:
        self.server = EmulatedDaq(SignalWorld()).start()
        self.channel = grpc.insecure_channel(self.server.address)

    def send(self, name: str, request: bytes) -> None:
        call = self.channel.unary_unary(f"/{SERVICE.full_name}/{name}")
        try:
            call(request, timeout=20.0)
        except grpc.RpcError as error:
            trailer = dict(error.trailing_metadata() or ())
            assert "ni-error" in trailer or error.code() in REFUSALS, f"{name}: {error.code()} {error.details()}"

    def close(self) -> None:
        self.channel.close()
        self.server.stop()


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    client = Client()
    yield client
    client.close()


def filled(message: Any, data: st.DataObject) -> Any:
    """Set every field of a request to something."""
    for field in message.DESCRIPTOR.fields:
        if field.name == "task":
            message.task.name = data.draw(st.sampled_from(["task", "task", "task", "none"]))
        elif field.enum_type is not None or field.message_type is not None or field.is_repeated:
            continue
        elif field.type == field.TYPE_STRING:
            setattr(message, field.name, data.draw(texts))
        elif field.type == field.TYPE_DOUBLE:
            setattr(message, field.name, data.draw(numbers))
        elif field.type == field.TYPE_BOOL:
            setattr(message, field.name, data.draw(st.booleans()))
        elif field.name in ("num_samps_per_chan", "array_size_in_samps", "samps_per_chan"):
            setattr(message, field.name, data.draw(st.integers(0, 500)))
        else:
            limit = 2**31 - 1 if field.type in (field.TYPE_UINT32, field.TYPE_UINT64) else None
            value = data.draw(integers)
            setattr(message, field.name, abs(value) if limit else value)
    return message


@given(data=st.data())
@settings(max_examples=300, deadline=None)
def test_any_request_gets_an_answer(client: Client, data: st.DataObject) -> None:
    client.send("CreateTask", nidaqmx_pb2.CreateTaskRequest(session_name="task").SerializeToString())
    for name in data.draw(st.lists(st.sampled_from(CALLS), min_size=1, max_size=6)):
        request = getattr(nidaqmx_pb2, SERVICE.methods_by_name[name].input_type.name)()
        client.send(name, filled(request, data).SerializeToString())


@given(name=st.sampled_from(CALLS), garbage=st.binary(max_size=60))
@settings(max_examples=100, deadline=None)
def test_garbage_harms_nobody_else(client: Client, name: str, garbage: bytes) -> None:
    call = client.channel.unary_unary(f"/{SERVICE.full_name}/{name}")
    try:
        call(garbage, timeout=20.0)
    except grpc.RpcError as error:
        assert error.code() != grpc.StatusCode.DEADLINE_EXCEEDED


def test_after_all_that_it_still_serves(client: Client) -> None:
    """Runs after the two above, on the same server."""
    client.send("ClearTask", nidaqmx_pb2.ClearTaskRequest(task={"name": "task"}).SerializeToString())
    with connect(client.server) as daq:
        assert daq.read(20).shape == (3, 20)
