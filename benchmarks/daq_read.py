"""What one read of the DAQ costs: over the wire, straight from the acquisition, and what an empty gRPC call costs.

    python benchmarks/daq_read.py [--reads N] [--json]

The share of gRPC itself is measured in the same run, since it is most of the whole and varies with the machine.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from collections.abc import Callable
from concurrent import futures

import grpc
import numpy as np

from drivers.calibration import Calibration
from drivers.daq import NIDaq, VoltageChannel
from drivers.emulated.acquisition import Acquisition, AtOnce
from drivers.emulated.daq import EmulatedDaq
from drivers.emulated.electronics import Cell, Electronics, Input, usb_6211
from drivers.emulated.faults import Faults
from drivers.force import LoadCell
from drivers.pressure import HoneywellHSC

RATE = 1000.0
CHANNELS = (
    VoltageChannel("force", "Dev1/ai0"),
    VoltageChannel("pressure", "Dev1/ai1", -5.0, 5.0),
    VoltageChannel("supply", "Dev1/ai2"),
)


class StillWorld:
    """Constant signals: the cost of the plant is not what is measured here."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.faults = Faults()
        self.sample = 0
        self.time = 0.0

    def advance(self, samples: int, rate: float) -> dict[str, np.ndarray]:
        """See ``drivers.emulated.world.World``."""
        self.sample += samples
        self.time += samples / rate
        return {
            "force": np.full(samples, 0.5),
            "pressure": np.full(samples, -3200.0),
            "supply": np.full(samples, 5.0),
        }


def quantiles(action: Callable[[], object], repetitions: int) -> dict[str, float]:
    """Median, 99th percentile and mean, in microseconds."""
    for _ in range(100):
        action()
    times = np.empty(repetitions)
    for i in range(repetitions):
        begin = time.perf_counter()
        action()
        times[i] = time.perf_counter() - begin
    return {"p50_us": 1e6 * np.median(times), "p99_us": 1e6 * np.quantile(times, 0.99), "mean_us": 1e6 * times.mean()}


def empty_call(repetitions: int) -> dict[str, float]:
    handler = grpc.unary_unary_rpc_method_handler(lambda request, _context: bytes(500))
    server = grpc.server(
        futures.ThreadPoolExecutor(16), handlers=[grpc.method_handlers_generic_handler("empty", {"Call": handler})]
    )
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
        call = channel.unary_unary("/empty/Call")
        result = quantiles(lambda: call(b"request", timeout=5.0), repetitions)
    server.stop(0).wait()
    return result


def wire(samples: int, repetitions: int) -> dict[str, float]:
    with EmulatedDaq(StillWorld()) as server, NIDaq(CHANNELS, rate=RATE, connection=server.connection) as daq:
        daq.start()
        return quantiles(lambda: daq.read(samples), repetitions)


def acquisition(samples: int, repetitions: int) -> dict[str, float]:
    world = StillWorld()
    electronics = Electronics(usb_6211(), [Input.of(channel) for channel in CHANNELS], RATE, faults=world.faults)
    running = Acquisition(world, electronics, AtOnce(), RATE, 10_000)
    return quantiles(lambda: running.read(samples, 1.0), repetitions)


def conversion(samples: int, repetitions: int) -> dict[str, float]:
    record: Calibration = Cell().calibration()
    cell, sensor = LoadCell("GSO-1K", Cell().capacity, record), HoneywellHSC(rate=RATE)
    force, pressure, supply = np.full((3, samples), [[0.4], [2.4], [5.0]])
    return quantiles(lambda: (cell.convert(force), sensor.convert(pressure, supply)), repetitions)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--reads", type=int, default=3000, help="reads per case")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    floor = empty_call(options.reads)
    results = {"empty gRPC call": floor}
    for samples in (20, 100, 1000):
        reads = max(options.reads * 20 // (samples + 20), 100)
        results[f"wire, 3 x {samples}"] = wire(samples, reads)
        results[f"acquisition, 3 x {samples}"] = acquisition(samples, reads)
        results[f"conversion, 3 x {samples}"] = conversion(samples, reads)
    if options.json:
        print(json.dumps(results))
        return 0
    print(f"{'':26}{'p50':>9}{'p99':>9}{'mean':>9}   us   (p50 / empty call)")
    for name, row in results.items():
        times = "".join(f"{row[key]:9.1f}" for key in ("p50_us", "p99_us", "mean_us"))
        print(f"{name:26}{times}   {row['p50_us'] / floor['p50_us']:9.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
