"""The instruments without a wire: the drivers' interfaces straight on the plant, for thousands of runs.

The emulated controller, pump and electronics are the same as behind the wire-level servers, and are asked the same
questions; so a recording made here equals one made over the wire, bit for bit. Faults of a wire become the error
its driver would raise.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from drivers.emulated.acquisition import Acquisition, AtOnce, Pace, RealTime, check_present
from drivers.emulated.electronics import Device, Electronics, Input, Refusal
from drivers.emulated.stage import EmulatedController
from drivers.emulated.world import World
from drivers.errors import (
    BadReply,
    CommandRefused,
    DeviceError,
    MotionFault,
    NoReply,
    NotConnected,
    OutOfRange,
)
from drivers.interfaces import Clock, Identity, StageStatus, Volts
from drivers.stage import (
    ERROR,
    LIMITS,
    MOTION_ERRORS,
    MOVING,
    NEGATIVE_LIMIT,
    ON_TARGET,
    POSITIVE_LIMIT,
    REFERENCING,
    SERVO_ON,
    STOPPED,
)

if TYPE_CHECKING:
    from drivers.daq_channels import Channel

REMEDY = "this is the emulated bench: look at its fault script"


def check_wire(world: World, device: str) -> None:
    """Raise what a driver would if the fault script has hurt the wire to this instrument."""
    check_plugged(world, device)
    faults = world.faults
    if not faults.scheduled:
        return
    if faults.active(device, "silent"):
        raise NoReply(device, "no reply", REMEDY)
    if faults.active(device, "garbage"):
        raise BadReply(device, "the reply makes no sense", REMEDY)


def check_plugged(world: World, device: str) -> None:
    """Raise what a driver would where nothing reaches the instrument."""
    if world.faults.scheduled and world.faults.active(device, "unplugged"):
        raise NotConnected(device, "the connection has been closed by the far end", REMEDY)


class DirectStage:
    """The axis of an emulated controller; fits ``drivers.interfaces.Stage``.

    Parameters
    ----------
    world
        The plant.
    controller
        The emulated controller on its axis.
    clock
        The bench's time base.
    minimum, maximum
        Narrower limits of the travel, m.
    inverted
        The controller's positive direction points towards the sample.
    """

    def __init__(
        self,
        world: World,
        controller: EmulatedController,
        *,
        clock: Clock,
        minimum: float | None = None,
        maximum: float | None = None,
        inverted: bool = False,
    ) -> None:
        self._world = world
        self._controller = controller
        self._clock = clock
        self._scale = -1e-3 if inverted else 1e-3
        self._stop_pressed = False
        self._motion_error = 0
        self._servo_expected = bool(self._status_word() & SERVO_ON)
        self._limits_accepted = self._limits_seen = 0
        ends = sorted(self._scale * self._number(question) for question in ("TMN?", "TMX?"))
        self._travel = (
            ends[0] if minimum is None else max(ends[0], minimum),
            ends[1] if maximum is None else min(ends[1], maximum),
        )
        self._position = self._travel[0]
        self._ask("ERR?")

    @property
    def identity(self) -> Identity:
        """What the controller says of itself."""
        return Identity(*(field.strip() for field in self._ask("*IDN?").split(",")))

    @property
    def travel(self) -> tuple[float, float]:
        """Lowest and highest allowed position, m."""
        return self._travel

    @property
    def referenced(self) -> bool:
        """Whether the axis knows its absolute position."""
        return self._number("FRF?") == 1

    def reference(self) -> None:
        """Start the reference move to the limit switch away from the sample."""
        self.servo(True)
        self._refuse_if_stopped()
        self._motion_error = 0
        self._command("RON 1 1")
        self._command("FPL" if self._scale > 0 else "FNL")

    def servo(self, on: bool) -> None:
        """Switch the servo."""
        self._command(f"SVO 1 {int(on)}")
        self._servo_expected = on
        self._motion_error = 0

    def status(self) -> StageStatus:
        """Poll position and state.

        Raises
        ------
        MotionFault
            The controller stopped the motion by itself or lost its servo.
        CommandRefused
            Another error is pending in the controller.
        """
        sent = self._clock()
        word, position = self._poll()
        self._position = self._scale * position
        received = self._clock()
        error = int(self._ask("ERR?")) if word & ERROR else 0
        self._check_health(word, error)
        towards, away = (NEGATIVE_LIMIT, POSITIVE_LIMIT) if self._scale > 0 else (POSITIVE_LIMIT, NEGATIVE_LIMIT)
        return StageStatus(
            sent=sent,
            received=received,
            position=self._position,
            moving=bool(word & (MOVING | REFERENCING)),
            on_target=bool(word & ON_TARGET),
            servo_on=bool(word & SERVO_ON),
            negative_limit=bool(word & towards),
            positive_limit=bool(word & away),
            error=error,
        )

    def set_speed(self, speed: float) -> None:
        """Set the closed-loop speed, m/s."""
        if not (math.isfinite(speed) and speed > 0):
            raise OutOfRange("stage", f"speed {speed!r} m/s is not a positive number", "choose a speed above 0")
        self._command(f"VEL 1 {speed * 1e3}")

    def move_to(self, position: float) -> None:
        """Start or redirect a move to ``position`` (m, within ``travel``, or on the way back to it)."""
        low, high = self._travel
        if not min(low, self._position) <= position <= max(high, self._position):
            raise OutOfRange(
                "stage",
                f"target {position * 1e3:.6g} mm lies outside the travel {low * 1e3:.6g} .. {high * 1e3:.6g} mm",
                "choose a target within the travel, or widen the limits in the bench file",
            )
        self._refuse_if_stopped()
        self._limits_accepted = self._limits_seen
        self._motion_error = 0
        self._command(f"MOV 1 {position / self._scale}")

    def stop(self) -> None:
        """Halt with the controller's deceleration and clear the 'stopped' error it leaves."""
        self._ask("HLT 1", answers=False)
        self._stop_pressed = False
        error = int(self._ask("ERR?"))
        self._motion_error = error if error in MOTION_ERRORS else 0

    def emergency_stop(self) -> None:
        """Stop dead, from any thread; moves are refused until ``stop`` acknowledges."""
        self._stop_pressed = True
        check_plugged(self._world, "stage")
        self._controller.control(0x18)

    def close(self) -> None:
        """Nothing to release."""

    def _poll(self) -> tuple[int, float]:
        check_wire(self._world, "stage")
        answer = self._controller.poll()
        if answer is None:
            raise NoReply("stage", "the controller is restarting", REMEDY)
        return answer

    def _status_word(self) -> int:
        check_wire(self._world, "stage")
        reply = self._controller.control(0x04)
        if reply is None:
            raise NoReply("stage", "the controller is restarting", REMEDY)
        return int(reply, 16)

    def _ask(self, text: str, *, answers: bool = True) -> str:
        check_wire(self._world, "stage")
        reply = self._controller.execute(text)
        if answers and reply is None:
            raise NoReply("stage", f"no reply to {text}", REMEDY)
        return reply or ""

    def _number(self, question: str) -> float:
        return float(self._ask(question).rpartition("=")[2])

    def _command(self, text: str) -> None:
        self._ask(text, answers=False)
        error = int(self._ask("ERR?"))
        if error:
            raise self._error_of(error, f"{text}: ")

    def _check_health(self, word: int, error: int) -> None:
        """Raise what the operator must know, as ``drivers.stage`` does."""
        if error in MOTION_ERRORS or (error == STOPPED and not self._stop_pressed):
            self._motion_error = error
        self._limits_seen = word & LIMITS
        if word & REFERENCING:
            self._limits_accepted = self._limits_seen
        if self._servo_expected and not word & SERVO_ON:
            raise MotionFault("stage", "the servo has switched itself off", "free the carriage, then switch it on")
        if self._limits_seen & ~self._limits_accepted:
            raise MotionFault("stage", "a limit switch is pressed", "move away from the switch")
        if self._motion_error:
            raise self._error_of(self._motion_error)
        if error not in (0, STOPPED):
            raise self._error_of(error)

    @staticmethod
    def _error_of(code: int, context: str = "") -> DeviceError:
        kind = MotionFault if code in (STOPPED, *MOTION_ERRORS) else CommandRefused
        return kind("stage", f"{context}controller error {code}", "look the code up in the controller's manual")

    def _refuse_if_stopped(self) -> None:
        if self._stop_pressed:
            raise MotionFault("stage", "the emergency stop was pressed", "call stop() to acknowledge it, then move")


class DirectDaq:
    """The rig's channels on emulated electronics; fits ``drivers.interfaces.Daq``.

    Parameters
    ----------
    world
        The plant.
    channels
        As for ``drivers.daq.NIDaq``.
    rate
        Sample rate asked for, Hz.
    device
        The hardware and its wiring.
    seed
        Of the electronics' noise.
    pace
        How time passes while a reader waits.
    starts
        Counts the starts of all tasks of one device, which get different noise.
    buffer_seconds, patience
        As for ``drivers.daq.NIDaq``.
    """

    def __init__(
        self,
        world: World,
        channels: Sequence[Channel],
        *,
        rate: float,
        device: Device,
        seed: int = 0,
        pace: Pace | None = None,
        starts: Iterator[int] | None = None,
        buffer_seconds: float = 10.0,
        patience: float = 0.5,
    ) -> None:
        self._world = world
        self._names = tuple(channel.name for channel in channels)
        self._units = tuple(channel.unit for channel in channels)
        self._device = device
        self._seed = seed
        self._pace = AtOnce() if pace is None else pace
        self._starts = itertools.count() if starts is None else starts
        self._patience = patience
        self._inputs = [Input.of(channel) for channel in channels]
        try:
            for wanted in self._inputs:
                device.check(wanted)
            self._rate = device.coerce_rate(rate, len(channels))
        except Refusal as refusal:
            raise _error_of(refusal) from refusal
        self._buffer = math.ceil(self._rate * buffer_seconds)
        self._running: Acquisition | None = None
        self._partial: Volts = np.empty((len(channels), 0))

    @property
    def identity(self) -> Identity:
        """Product and serial of the device."""
        module = self._device.module(self._inputs[0].physical)
        return Identity("National Instruments", module.product, f"{module.serial:08X}", "emulated, direct")

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the rows of ``read``."""
        return self._names

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the rows of ``read``."""
        return self._units

    @property
    def rate(self) -> float:
        """The sample rate the device really uses, Hz."""
        return self._rate

    def start(self) -> None:
        """Start the sample clock."""
        try:
            check_present(self._world)
        except Refusal as refusal:
            raise _error_of(refusal) from refusal
        electronics = Electronics(
            self._device,
            self._inputs,
            self._rate,
            seed=self._seed,
            run=next(self._starts),
            faults=self._world.faults,
            start=self._world.sample,
        )
        self._running = Acquisition(self._world, electronics, self._pace, self._rate, self._buffer)
        self._partial = self._partial[:, :0]
        if isinstance(self._pace, RealTime):
            self._pace.attach(self._running)

    def read(self, samples: int) -> Volts:
        """Return ``samples`` columns; see ``drivers.interfaces.Daq.read``."""
        running = self._running
        if running is None:
            raise CommandRefused("daq", "the task is not running", "call start() first")
        kept = min(self._partial.shape[1], samples)
        missing = samples - kept
        try:
            volts = running.read(missing, missing / self._rate + self._patience)
        except Refusal as refusal:
            raise _error_of(refusal) from refusal
        if kept or volts.shape[1] < missing:
            volts = np.concatenate((self._partial[:, :kept], volts.reshape(len(self._names), -1)), axis=1)
        if volts.shape[1] < samples:
            self._partial = volts
            raise NoReply("daq", f"{volts.shape[1]} of {samples} samples came in time", REMEDY)
        self._partial = self._partial[:, kept:]
        return np.ascontiguousarray(volts)

    def stop(self) -> None:
        """Stop the sample clock."""
        if self._running is not None and isinstance(self._pace, RealTime):
            self._pace.attach(None)
        self._running = None

    def close(self) -> None:
        """Release the task."""
        self.stop()


def _error_of(refusal: Refusal) -> DeviceError:
    """The rig's error for a DAQmx error code, the same as over the wire."""
    from drivers.daq_errors import daqmx_error

    return daqmx_error(refusal.code, str(refusal))
