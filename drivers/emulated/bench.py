"""The emulated bench: one plant and, on its own wire or straight on the plant, every instrument a run needs.

What a run does not need is neither started nor imported.
"""

from __future__ import annotations

import itertools
import os
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

from drivers.emulated.faults import Faults
from drivers.emulated.plant import Plant
from drivers.emulated.truth import Truth
from drivers.interfaces import Clock

if TYPE_CHECKING:
    from drivers.daq_channels import Channel
    from drivers.emulated.acquisition import Pace
    from drivers.emulated.direct import DirectDaq, DirectStage
    from drivers.emulated.direct_pump import DirectPump
    from drivers.emulated.electronics import Device
    from drivers.emulated.pump import EmulatedLegato
    from drivers.emulated.stage import EmulatedController


SYRINGE, SYRINGE_FILL = 10e-6, 2e-6
"""What the syringe holds, and what is in it at the start, m^3: most of its travel is for suction."""


@dataclass(frozen=True, slots=True)
class Endpoints:
    """Where the drivers connect to: ``socket://host:port`` or a terminal's path, and ``grpc://host:port``."""

    stage: str
    pump: str | None
    daq: str


class EmulatedBench:
    """The emulated instruments of one run; a context manager.

    Parameters
    ----------
    truth
        What the world is made of.
    seed
        Of all noise: one seed, one run.
    speed
        ``None``: the DAQ moves time on as fast as it is read. A number: so many times real time.
    faults
        The fault script.
    wire
        Serve every instrument as bytes on a loopback port; otherwise ``stage``, ``pump`` and ``daq`` are to be used.
    pressure
        Whether there is a pump and a closed chamber; otherwise the chamber is vented and nothing of it is imported.
    device
        The DAQ hardware; by default a USB-6211 with a GSO-500 cell (4.903 N at 10 V) and the HSC on Dev1/ai0 to ai2.
    referenced
        Whether the stage has been referenced (servo on) before anyone connects.
    latency
        Of the stage's and the pump's replies, s of real time.

    Attributes
    ----------
    plant
        The world behind the instruments.
    clock
        The bench's time base: the plant's time, or ``time.perf_counter`` in real time.
    """

    def __init__(
        self,
        truth: Truth,
        *,
        seed: int = 0,
        speed: float | None = None,
        faults: Faults | None = None,
        wire: bool = True,
        pressure: bool = True,
        device: Device | None = None,
        referenced: bool = False,
        latency: float = 0.0,
    ) -> None:
        if not pressure:
            truth = replace(truth, chamber=replace(truth.chamber, vented=True))
        self.plant = Plant(truth, seed=seed, faults=faults)
        self.clock: Clock = self._plant_time if speed is None else time.perf_counter
        self._seed, self._speed, self._wire, self._pressure = seed, speed, wire, pressure
        self._referenced, self._latency = referenced, latency
        self._device = device
        self._resources = ExitStack()
        self._endpoints: Endpoints | None = None
        self._controller: EmulatedController | None = None
        self._legato: EmulatedLegato | None = None
        self._pace: Pace | None = None
        self._starts = itertools.count()

    @property
    def faults(self) -> Faults:
        """The fault script being played."""
        return self.plant.faults

    @property
    def virtual(self) -> bool:
        """Whether time is the plant's."""
        return self._speed is None

    @property
    def endpoints(self) -> Endpoints:
        """Where the drivers connect to; the servers start when this is first asked."""
        if not self._wire:
            raise RuntimeError("this bench has no wires: use stage(), pump() and daq()")
        if self._endpoints is None:
            self._endpoints = self._serve()
        return self._endpoints

    def serve_terminals(self) -> tuple[str, str | None]:
        """Serve stage and pump on pseudo-terminals too (POSIX only); return their paths."""
        from drivers.emulated.server import serve_pty

        stage = self._resources.enter_context(serve_pty(self.controller)).url
        pump = self._resources.enter_context(serve_pty(self.legato)).url if self._pressure else None
        return stage, pump

    def stage(self, **options: Any) -> DirectStage:
        """Return the stage, straight on the plant; ``options`` as for ``DirectStage``."""
        from drivers.emulated.direct import DirectStage

        self._check_direct()
        return DirectStage(self.plant, self.controller, clock=self.clock, **options)

    def pump(self, **options: Any) -> DirectPump:
        """Return the pump, straight on the plant; ``options`` as for ``DirectPump``."""
        from drivers.emulated.direct_pump import DirectPump

        self._check_direct()
        return DirectPump(self.legato, clock=self.clock, **options)

    def daq(self, *channels: str | Channel, rate: float = 1000.0, **options: Any) -> DirectDaq:
        """Return a DAQ task, straight on the plant; ``options`` as for ``DirectDaq``.

        A channel may be given by its name alone: then it is the input its signal is wired to, in that signal's range.
        """
        from drivers.emulated.direct import DirectDaq

        self._check_direct()
        return DirectDaq(
            self.plant,
            [self._channel(channel) if isinstance(channel, str) else channel for channel in channels],
            rate=rate,
            device=self.device,
            seed=self._seed,
            pace=self._direct_pace(),
            starts=self._starts,
            **options,
        )

    @property
    def device(self) -> Device:
        """The DAQ hardware and its wiring."""
        if self._device is None:
            self._device = standard_device()
        return self._device

    @property
    def controller(self) -> EmulatedController:
        """The emulated stage controller."""
        if self._controller is None:
            from drivers.emulated.stage import EmulatedController

            self._controller = EmulatedController(
                self.plant, referenced=self._referenced, latency=self._latency, seed=self._seed
            )
        return self._controller

    @property
    def legato(self) -> EmulatedLegato:
        """The emulated pump.

        Raises
        ------
        RuntimeError
            This bench has none.
        """
        if not self._pressure:
            raise RuntimeError("this bench has no pump: it was made with pressure=False")
        if self._legato is None:
            from drivers.emulated.pump import EmulatedLegato

            self._legato = EmulatedLegato(
                self.plant, latency=self._latency, capacity=SYRINGE, fill=SYRINGE_FILL, seed=self._seed
            )
        return self._legato

    def step_started(self, name: str) -> None:
        """Tell the fault script that a step of the sequence has begun."""
        self.plant.faults.step_started(name)

    def close(self) -> None:
        """End every server and the plant's time; a second call does nothing."""
        self._resources.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _plant_time(self) -> float:
        return self.plant.time

    def _serve(self) -> Endpoints:
        from drivers.emulated.daq import EmulatedDaq
        from drivers.emulated.server import serve_tcp

        if self._speed is None:
            self._resources.enter_context(_on_one_core())
        stage = self._resources.enter_context(serve_tcp(self.controller)).url
        pump = self._resources.enter_context(serve_tcp(self.legato)).url if self._pressure else None
        daq = EmulatedDaq(self.plant, self.device, seed=self._seed, speed=self._speed)
        return Endpoints(stage, pump, self._resources.enter_context(daq).connection)

    def _direct_pace(self) -> Pace:
        from drivers.emulated.acquisition import AtOnce, RealTime

        if self._pace is None:
            if self._speed is None:
                self._pace = AtOnce()
            else:
                self._pace = running = RealTime(self.plant, self._speed)
                running.start()
                self._resources.callback(running.stop)
        return self._pace

    def _channel(self, name: str) -> Channel:

        from drivers.daq_channels import signal_channel

        physical = {signal: terminal for terminal, signal in self.device.wiring.items()}
        return signal_channel(name, physical[name])

    def _check_direct(self) -> None:
        if self._wire:
            raise RuntimeError("this bench is on wires: connect the drivers to its endpoints")


@contextmanager
def _on_one_core() -> Iterator[None]:
    """Keep this thread, and those started meanwhile, on one processor core.

    In virtual time host and instruments only ever wait for each other; waking another core for each byte takes longer
    than the work itself.
    """
    if sys.platform != "linux":
        yield
        return
    import psutil

    allowed = os.sched_getaffinity(0)
    here = psutil.Process().cpu_num()
    os.sched_setaffinity(0, {here if here in allowed else min(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def standard_device() -> Device:
    """Return the DAQ of the emulated bench file: USB-6211, GSO-500 amplified to 10 V at 4.903 N, HSC and supply."""
    from drivers.emulated.electronics import Cell, usb_6211

    capacity = 4.903325
    return usb_6211(cell=Cell(name="GSO-500", capacity=capacity, sensitivity=1 / 0.4903, noise=2e-4))
