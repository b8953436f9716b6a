"""The way to a gRPC device server: on this computer unless allowed otherwise, and with a deadline on every call."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from urllib.parse import urlsplit

from drivers.errors import NotConnected

SLOWEST_ANSWER = 5.0  # s; deadline of a call over gRPC that does not wait for samples


def connect(connection: str, allow_remote: bool, deadline: Deadline, resources: ExitStack) -> Any:
    """Return nidaqmx's ``grpc_options`` for ``"grpc://host:port"``; ``None`` is the local runtime."""
    if connection == "local":
        return None
    target = _target(connection, allow_remote)
    try:
        import grpc
        from nidaqmx import GrpcSessionOptions
    except ModuleNotFoundError as error:
        raise NotConnected("daq", f"{error}.", "pip install 'nidaqmx[grpc]'.") from error
    channel = grpc.insecure_channel(target, options=_GRPC_OPTIONS)
    resources.callback(channel.close)
    return GrpcSessionOptions(BoundedChannel(channel, deadline), "")


_GRPC_OPTIONS = (
    ("grpc.max_receive_message_length", -1),
    ("grpc.enable_http_proxy", 0),
    ("grpc.use_local_subchannel_pool", 1),
)


class Deadline:
    """The deadline of the calls on one channel, s."""

    seconds = SLOWEST_ANSWER


class BoundedChannel:
    """A gRPC channel whose calls all end: nidaqmx sets no deadline, so a hung server would hang the rig."""

    def __init__(self, channel: Any, deadline: Deadline) -> None:
        self._channel = channel
        self._deadline = deadline

    def unary_unary(self, *arguments: Any, **options: Any) -> Callable[..., Any]:
        """Like ``grpc.Channel.unary_unary``."""
        call = self._channel.unary_unary(*arguments, **options)
        deadline = self._deadline
        return lambda request, metadata=None: call(request, timeout=deadline.seconds, metadata=metadata)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._channel, name)


def _target(connection: str, allow_remote: bool) -> str:
    try:
        parts = urlsplit(connection)
        scheme, host, port = parts.scheme, parts.hostname, parts.port
    except ValueError:
        scheme, host, port = "", None, None
    if scheme != "grpc" or not host or not port:
        raise NotConnected("daq", f"connection {connection!r} is not understood.", 'use "local" or "grpc://host:port".')
    if not allow_remote and not _is_loopback(host):
        raise NotConnected(
            "daq",
            f"{host} is not this computer; anyone on the network could read and drive the rig's DAQ.",
            "use a loopback address, or allow remote instruments in the bench.",
        )
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
