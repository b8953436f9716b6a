"""The emulated NI DAQ: a gRPC device server that the unmodified ``nidaqmx`` client drives.

It answers as NI gRPC Device Server does (service ``nidaqmx_grpc.NiDAQmx``): a time-out is an OK response with a status
and zero-padded data, every other failure a gRPC error with its code in the trailing metadata, enumerations travel in
the ``*_raw`` fields. What it delivers comes from the plant by way of ``electronics``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from concurrent import futures
from typing import Any

import grpc
from nidaqmx._stubs import nidaqmx_pb2

from drivers.emulated import acquisition, electronics
from drivers.emulated.acquisition import AtOnce, RealTime
from drivers.emulated.daq_service import DaqService
from drivers.emulated.electronics import Device, Refusal, usb_6211
from drivers.emulated.world import World

FAULTS = {
    **electronics.FAULTS,
    "daq": {**acquisition.FAULTS, "hang": "the server never answers a read; the client's deadline passes"},
}

_SERVICE = nidaqmx_pb2.DESCRIPTOR.services_by_name["NiDAQmx"]


class EmulatedDaq:
    """An NI device on a loopback port.

    Parameters
    ----------
    world
        The plant behind it.
    device
        The hardware and its wiring; a USB-6211 by default.
    seed
        Of the electronics' noise.
    speed
        ``None``: reading n samples moves the plant on by n / rate at once. A number: the plant runs by itself, so many
        times as fast as real time.
    port
        TCP port; 0 takes a free one.

    Attributes
    ----------
    calls
        How often each RPC has been called.
    """

    def __init__(
        self,
        world: World,
        device: Device | None = None,
        *,
        seed: int = 0,
        speed: float | None = None,
        port: int = 0,
    ) -> None:
        self.calls: Counter[str] = Counter()
        self._pace = AtOnce() if speed is None else RealTime(world, speed)
        service = DaqService(world, device or usb_6211(), seed, self._pace)
        self._service = service
        self._workers = futures.ThreadPoolExecutor(16, thread_name_prefix="emulated-daq")
        self._server = grpc.server(
            self._workers,
            handlers=[_handlers(service, self.calls)],
            options=[("grpc.so_reuseport", 0), ("grpc.max_receive_message_length", -1)],
        )
        self.port = self._server.add_insecure_port(f"127.0.0.1:{port}")

    @property
    def address(self) -> str:
        """Where a client finds it: host and port."""
        return f"127.0.0.1:{self.port}"

    @property
    def connection(self) -> str:
        """What ``NIDaq`` takes as its connection."""
        return f"grpc://{self.address}"

    def start(self) -> EmulatedDaq:
        """Serve, and start the plant's time if it is real."""
        if isinstance(self._pace, RealTime):
            self._pace.start()
        self._server.start()
        return self

    def stop(self) -> None:
        """Stop serving; a second call does nothing. Raises what has gone wrong in a real-time plant."""
        self._service.stopping.set()
        try:
            if isinstance(self._pace, RealTime):
                self._pace.stop()
        finally:
            self._server.stop(grace=0.2).wait()
            self._workers.shutdown()

    def __enter__(self) -> EmulatedDaq:
        return self.start()

    def __exit__(self, *failure: object) -> None:
        self.stop()


def _handlers(service: DaqService, calls: Counter[str]) -> grpc.GenericRpcHandler[Any, Any]:
    """Bind every method of the service that has an RPC's name; gRPC answers UNIMPLEMENTED to the others."""
    handlers = {
        method.name: _handler(method, getattr(service, method.name), calls)
        for method in _SERVICE.methods
        if hasattr(service, method.name)
    }
    return grpc.method_handlers_generic_handler(_SERVICE.full_name, handlers)


def _handler(method: Any, action: Callable[[Any, Any], Any], calls: Counter[str]) -> Any:
    request = getattr(nidaqmx_pb2, method.input_type.name)
    response = getattr(nidaqmx_pb2, method.output_type.name)

    def perform(message: Any, context: Any) -> Any:
        calls[method.name] += 1
        try:
            return action(message, context)
        except Refusal as refusal:
            context.set_trailing_metadata(_trailer(refusal))
            context.abort(grpc.StatusCode.UNKNOWN, str(refusal))
            raise

    def answer(message: Any, context: Any) -> bytes:
        result = perform(message, context)
        return result if isinstance(result, bytes) else serialised(result)

    def stream(message: Any, context: Any) -> Iterator[bytes]:
        return map(serialised, perform(message, context))

    def serialised(result: dict[str, Any]) -> bytes:
        text: bytes = response(**result).SerializeToString()
        return text

    if method.server_streaming:
        return grpc.unary_stream_rpc_method_handler(stream, request_deserializer=request.FromString)
    return grpc.unary_unary_rpc_method_handler(answer, request_deserializer=request.FromString)


def _trailer(refusal: Refusal) -> tuple[tuple[str, str], ...]:
    trailer = (("ni-error", str(refusal.code)),)
    if refusal.samples is None:
        return trailer
    return (*trailer, ("ni-samps-per-chan-read", str(refusal.samples)))
