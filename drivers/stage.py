"""PI stage on a GCS 2.0 controller (C-863 class), through pipython's command layer.

Sources: PI C-863.12 user manual MS249E; pipython 2.11.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from drivers.errors import (
    BadReply,
    CommandRefused,
    DeviceError,
    MotionFault,
    NoReply,
    NotConnected,
    OutOfRange,
    WrongDevice,
    opening,
)
from drivers.gateway import Gateway
from drivers.interfaces import Clock, Identity, StageStatus

DEVICE = "stage"
STOP_EVERYTHING = b"\x18"

# Bits of the status word answered to #4 (MS249E p. 126).
NEGATIVE_LIMIT = 1 << 0
POSITIVE_LIMIT = 1 << 2
LIMITS = NEGATIVE_LIMIT | POSITIVE_LIMIT
ERROR = 1 << 8
SERVO_ON = 1 << 12
MOVING = 1 << 13
REFERENCING = 1 << 14
ON_TARGET = 1 << 15

NO_ERROR = 0
STOPPED = 10
MALFORMED = -1004
MOTION_ERRORS = (-1024, 45, 49, 84, 200, 215, 216)

REMEDIES = {
    5: "reference the axis and switch its servo on",
    7: "choose a target within the travel",
    8: "choose a lower speed",
    51: "switch the joystick off",
    53: "wait for the end of the motion, or stop it",
    200: "check the cable between controller and stage",
    215: "check the cable between controller and stage",
    10: "another program or the joystick stopped the stage; stop it here too, then move",
    -1024: "free the carriage, then switch the servo on again",
}
CABLES = "check power and cable of the controller, and its baud rate; then connect again"
LOOK_UP = "look the code up in the controller's manual, then stop and connect again"

SURPRISE, ASTRAY = 5e-6, 20e-6
"""m. A position so much further than the stage can have come is asked again; one so far off its way is not believed."""
KEPT = 0.1
"""Relative difference at which a speed read back still counts as the one sent: the controller may round."""
SAME_PLACE, SAME_SPEED = 1e-3, 1e-3
"""mm, mm/s: what a target and a speed may differ from those sent, beyond that."""
GARBLED = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, SystemError)
"""What pipython raises on replies it cannot parse."""


class PIStage:
    """One axis of a PI controller; fits ``drivers.interfaces.Stage``.

    Parameters
    ----------
    connection
        ``socket://host:port`` or a serial device (``COM3``, ``/dev/ttyUSB0``, ``/dev/serial/by-id/...``).
    axis
        The controller's name of the axis.
    baud
        Baud rate of a serial device.
    minimum, maximum
        Narrower limits of the travel, m, in the driver's direction; ``None`` leaves the controller's.
    inverted
        The controller's positive direction points towards the sample. Positions here always rise away from it.
    expected_model
        Must be part of the model the controller names in ``*IDN?``.
    reply_timeout
        Longest wait for a reply, s.
    clock
        The bench's time base.

    Raises
    ------
    NotConnected
        The port cannot be opened.
    NoReply
        The port is open, but nobody answers.
    WrongDevice
        Another device answers, or the axis is not there.
    """

    def __init__(
        self,
        connection: str,
        *,
        axis: str = "1",
        baud: int = 115200,
        minimum: float | None = None,
        maximum: float | None = None,
        inverted: bool = False,
        expected_model: str = "C-863",
        reply_timeout: float = 0.4,
        clock: Clock = time.perf_counter,
    ) -> None:
        from pipython.pidevice.gcs2.gcs2commands import GCS2Commands
        from pipython.pidevice.gcserror import GCSError
        from pipython.pidevice.gcsmessages import GCSMessages

        self._gcs_error: type[Exception] = GCSError
        self._connection = connection
        self._axis = axis
        self._direction = -1e-3 if inverted else 1e-3
        self._clock = clock
        self._lock = threading.RLock()
        # A plain flag: the emergency stop may come from a signal handler while this thread holds an event's lock.
        self._stop_pressed = False
        self._halting = False
        self._out_of_step = False
        self._landmarks = 0
        self._identity_line = ""
        self._fault = NO_ERROR
        self._servo_expected = False
        self._was_referenced = False
        self._limits_idle = 0
        self._limits_seen = 0
        self._limits_accepted = 0
        self._last: tuple[float, float] | None = None
        self._targets: list[float] = []
        self._speed = self._fastest = 0.0
        with opening(DEVICE, connection):
            self._gateway = Gateway(connection, baud, reply_timeout)
        self._messages: Any = GCSMessages(self._gateway)
        self._gcs: Any = GCS2Commands(self._messages)
        try:
            self._identity = self._identify(expected_model)
            self._travel = self._find_travel(minimum, maximum)
            self._position = self._travel[0]
            self._find_state()
        except BaseException:
            self.close()
            raise

    @property
    def identity(self) -> Identity:
        """Get what the controller said on connection."""
        return self._identity

    @property
    def travel(self) -> tuple[float, float]:
        """Get lowest and highest allowed position, m."""
        return self._travel

    @property
    def referenced(self) -> bool:
        """Ask whether the axis knows its absolute position."""
        with self._exchange("ask whether the axis is referenced"):
            referenced = bool(self._gcs.qFRF()[self._axis])
        self._was_referenced = self._was_referenced or referenced
        return referenced

    def reference(self) -> None:
        """Start the reference move to the limit switch away from the sample: it may run the full travel.

        Without limit switches the reference switch is sought, in a direction the controller chooses.
        """
        self.servo(True)
        with self._exchange("start the reference move"), self._unless_stopped():
            self._was_referenced = False
            self._targets.clear()
            self._fault = NO_ERROR
            self._gcs.RON(self._axis, 1)
            if not self._gcs.qLIM()[self._axis]:
                self._gcs.FRF(self._axis)
            elif self._direction > 0:
                self._gcs.FPL(self._axis)
            else:
                self._gcs.FNL(self._axis)

    def servo(self, on: bool) -> None:
        """Switch the servo."""
        with self._exchange("switch the servo"):
            self._gcs.SVO(self._axis, int(on))
            self._servo_expected = on
            self._fault = NO_ERROR

    def status(self) -> StageStatus:
        """Poll position and state: two questions, the error code only if the error flag is up.

        Raises
        ------
        MotionFault
            The controller stopped the motion by itself, lost its servo or restarted.
        CommandRefused
            Another error is pending in the controller.
        BadReply
            A reply makes no sense, or the position lies off the way, also when asked again.
        """
        last, self._last = self._last, None
        with self._exchange("poll the status", check=False):
            sent = self._clock()
            word = self._status_word()
            position = self._ask_position(last if word & SERVO_ON and not word & REFERENCING else None)
            received = self._clock()
            self._position = position
            error = self._gcs.qERR() if word & ERROR else NO_ERROR
            limits = (word & LIMITS) ^ self._limits_idle
            self._check_health(word, limits, error)
        self._targets, self._fastest = self._targets[-1:], self._speed
        if not word & REFERENCING:
            self._last = sent, position
        return StageStatus(
            sent=sent,
            received=received,
            position=position,
            moving=bool(word & (MOVING | REFERENCING)),
            on_target=bool(word & ON_TARGET),
            servo_on=bool(word & SERVO_ON),
            negative_limit=bool(limits & (NEGATIVE_LIMIT if self._direction > 0 else POSITIVE_LIMIT)),
            positive_limit=bool(limits & (POSITIVE_LIMIT if self._direction > 0 else NEGATIVE_LIMIT)),
            error=error,
        )

    def set_speed(self, speed: float) -> None:
        """Set the closed-loop speed (m/s, strictly positive)."""
        if not (math.isfinite(speed) and speed > 0):
            raise OutOfRange(DEVICE, f"speed {speed!r} m/s is not a positive number", "choose a speed above 0")
        with self._exchange(f"set the speed to {speed * 1e3:g} mm/s"):
            self._gcs.VEL(self._axis, speed * 1e3)
            self._insist("speed", speed * 1e3, self._gcs.qVEL, KEPT * speed * 1e3 + SAME_SPEED)
            self._fastest, self._speed = max(self._fastest, speed), speed

    def move_to(self, position: float) -> None:
        """Start or redirect a move to ``position`` (m, within ``travel``, or on the way back to it).

        After an emergency stop every move is refused until ``stop`` has acknowledged it.
        """
        low, high = self._travel
        if not min(low, self._position) <= position <= max(high, self._position):
            raise OutOfRange(
                DEVICE,
                f"target {position * 1e3:.6g} mm lies outside the travel {low * 1e3:.6g} .. {high * 1e3:.6g} mm",
                "choose a target within the travel, or widen the limits in the bench file",
            )
        with self._exchange(f"move to {position * 1e3:.6g} mm"), self._unless_stopped():
            self._limits_accepted = self._limits_seen
            self._fault = NO_ERROR
            self._targets.append(position)
            self._gcs.MOV(self._axis, position / self._direction)
            self._insist("target", position / self._direction, self._gcs.qMOV, SAME_PLACE)

    def stop(self) -> None:
        """Halt with the controller's deceleration and clear the 'stopped' error it leaves.

        The halt goes out before any waiting; what follows only confirms it.
        """
        self._halting = True
        try:
            self._send_urgent(f"HLT {self._axis}\n".encode())
            self._confirm_halt()
        finally:
            self._halting = False

    def _confirm_halt(self) -> None:
        pressed = self._stop_pressed
        try:
            with self._exchange("confirm the halt", check=False):
                self._stop_pressed = False
                self._insist_on_halt()
        except DeviceError:
            if pressed:
                self._stop_pressed = True
            self._send_urgent(STOP_EVERYTHING)
            raise

    def _insist_on_halt(self) -> None:
        """A halt that has arrived leaves its error code; without it the stop byte is sent after it."""
        if STOPPED in self._read_errors_away():
            return
        self._send_urgent(STOP_EVERYTHING)
        if STOPPED not in self._read_errors_away() and self._status_word() & (MOVING | REFERENCING):
            raise MotionFault(DEVICE, "moves on though it was told twice to stop", "switch the controller off by hand")

    def emergency_stop(self) -> None:
        """Write the stop byte past every lock and queue, from any thread.

        Moves are refused from now on, until ``stop`` acknowledges.
        """
        self._stop_pressed = True
        self._send_urgent(STOP_EVERYTHING)

    def close(self) -> None:
        """Release the port; no motion is commanded. Closing twice does no harm."""
        with self._lock:
            self._gateway.close()

    def _identify(self, expected_model: str) -> Identity:
        remedy = "check the port in the bench file, the controller's label and its baud rate"
        try:
            with self._exchange("ask for the identity", check=False):
                # Ends whatever half line an earlier program left behind.
                self._gateway.send("\n")
                self._identity_line = self._gcs.qIDN().strip("\0\r\n ")
        except BadReply as error:
            raise WrongDevice(DEVICE, f"{self._connection} answers, but not in GCS: {error.message}", remedy) from error
        fields = [field.strip() for field in self._identity_line.split(",")]
        if len(fields) != 4 or expected_model.casefold() not in fields[1].casefold():
            raise WrongDevice(
                DEVICE,
                f"{self._connection} says it is {self._identity_line[:80]!r}, the bench expects {expected_model!r}",
                remedy,
            )
        return Identity(*fields)

    def _find_travel(self, minimum: float | None, maximum: float | None) -> tuple[float, float]:
        with self._exchange("read axes and limits", check=False):
            self._read_errors_away()
            axes = self._gcs.qSAI()
            if self._axis not in axes:
                raise WrongDevice(
                    DEVICE,
                    f"the controller has the axes {axes}, the bench names {self._axis!r}",
                    "correct the axis in the bench file",
                )
            ends = [self._direction * self._value(limit) for limit in (self._gcs.qTMN(), self._gcs.qTMX())]
        low, high = min(ends), max(ends)
        low = low if minimum is None else max(low, minimum)
        high = high if maximum is None else min(high, maximum)
        if low >= high:
            raise OutOfRange(
                DEVICE,
                f"the controller's travel {min(ends) * 1e3:g} .. {max(ends) * 1e3:g} mm and the bench's limits "
                f"{minimum} .. {maximum} m have nothing in common",
                "correct the stage limits in the bench file",
            )
        return low, high

    def _find_state(self) -> None:
        self._was_referenced = self.referenced
        with self._exchange("read the state", check=False):
            word = self._status_word()
        self._servo_expected = bool(word & SERVO_ON)
        # Both switches cannot be pressed at once: then their signals are active low.
        self._limits_idle = LIMITS if word & LIMITS == LIMITS else 0
        self._limits_seen = self._limits_accepted = (word & LIMITS) ^ self._limits_idle

    def _ask_position(self, last: tuple[float, float] | None) -> float:
        """Ask where the stage is, m; ``last`` is when (s) and where (m) it was, if it can be held against that.

        A number that has lost a digit on the wire is a number still. What comes as a surprise is asked again; then no
        time counts, which a busy computer may take, but the way: from the last position to what was commanded since.
        """
        position = self._direction * self._value(self._gcs.qPOS())
        if last is None or abs(position - last[1]) <= self._fastest * (self._clock() - last[0]) + SURPRISE:
            return position
        position = self._direction * self._value(self._gcs.qPOS())
        way = (last[1], *self._targets)
        if self._targets and not min(way) - ASTRAY <= position <= max(way) + ASTRAY:
            raise ValueError(
                f"it says {position * 1e3:.4f} mm, but was at {last[1] * 1e3:.4f} mm and was sent to "
                f"{self._targets[-1] * 1e3:.4f} mm"
            )
        return position

    def _insist(self, name: str, sent: float, ask: Callable[[], dict[str, Any]], tolerance: float) -> None:
        """Read a setting back: a command that has lost a digit on the wire is a command still."""
        self._messages.errcheck = False
        for _ in range(2):
            kept = self._value(ask())
            if abs(kept - sent) <= tolerance:
                return
        self._send_urgent(STOP_EVERYTHING)
        raise ValueError(f"the {name} is {kept:.7g} after {sent:.7g} was sent")

    def _status_word(self) -> int:
        word = int(self._gcs.GetStatus())
        if not 0 <= word <= 0xFFFF:
            raise ValueError(f"status word {word:#x} has more than 16 bits")
        return word

    def _value(self, row: dict[str, Any]) -> float:
        """Return this axis's number from a reply; the reply must name the axis."""
        value = float(row[self._axis])
        if not math.isfinite(value):
            raise ValueError(f"{value} for axis {self._axis}")
        return value

    def _check_health(self, word: int, limits: int, error: int) -> None:
        """Raise what the operator must know; it is raised again by every poll until a new command mends it."""
        if error in MOTION_ERRORS or (error == STOPPED and not self._stop_is_ours):
            self._fault = error
        self._limits_seen = limits
        if word & REFERENCING:
            self._limits_accepted = limits
        if self._servo_expected and not word & SERVO_ON:
            raise self._servo_lost()
        if pressed := limits & ~self._limits_accepted:
            side = "negative" if pressed & NEGATIVE_LIMIT else "positive"
            raise MotionFault(
                DEVICE,
                f"the controller's {side} limit switch is pressed",
                "find out what drove the stage there, then move away from the switch",
            )
        if self._fault != NO_ERROR:
            raise self._error_of(self._fault)
        if error not in (NO_ERROR, STOPPED):
            raise self._error_of(error)

    @property
    def _stop_is_ours(self) -> bool:
        return self._halting or self._stop_pressed

    def _servo_lost(self) -> MotionFault:
        if self._was_referenced and not self.referenced:
            reason = "the controller has restarted: the servo is off and the axis has lost its reference"
            return MotionFault(DEVICE, reason, "check its power supply, then reference the axis again")
        reason = f" ({self._describe(self._fault)})" if self._fault != NO_ERROR else ""
        return MotionFault(
            DEVICE,
            f"the servo has switched itself off{reason}",
            "free the carriage, then switch the servo on again",
        )

    def _describe(self, code: int) -> str:
        return f"controller error {self._gcs_error(code)}"

    def _error_of(self, code: int, purpose: str = "") -> DeviceError:
        """Return the error to raise for a code of the controller."""
        message = f"cannot {purpose}: {self._describe(code)}" if purpose else self._describe(code)
        if code == STOPPED and self._stop_pressed:
            return self._stop_was_pressed()
        kind = MotionFault if code in (STOPPED, *MOTION_ERRORS) else CommandRefused
        return kind(DEVICE, message, REMEDIES.get(code, LOOK_UP))

    @staticmethod
    def _stop_was_pressed() -> MotionFault:
        return MotionFault(DEVICE, "the emergency stop was pressed", "call stop() to acknowledge it, then move")

    def _refuse_if_stopped(self) -> None:
        if self._stop_pressed:
            raise self._stop_was_pressed()

    @contextlib.contextmanager
    def _unless_stopped(self) -> Iterator[None]:
        """Refuse a move after an emergency stop; stop again behind a move that the stop has overtaken."""
        self._refuse_if_stopped()
        try:
            yield
        finally:
            if self._stop_pressed:
                self._send_urgent(STOP_EVERYTHING)
                raise self._stop_was_pressed()

    def _send_urgent(self, data: bytes) -> None:
        try:
            self._gateway.send_urgent(data)
        except OSError as error:
            raise NotConnected(DEVICE, f"the stop could not be sent to {self._connection}: {error}", CABLES) from error

    def _read_errors_away(self) -> list[int]:
        """Empty the error latch and return what was in it; a motion error found there is kept for ``status``."""
        if self._fault == STOPPED:
            self._fault = NO_ERROR
        found: list[int] = []
        while len(found) < 3 and (error := self._gcs.qERR()) != NO_ERROR:
            found.append(error)
            if error in MOTION_ERRORS:
                self._fault = error
        return found

    @contextlib.contextmanager
    def _exchange(self, purpose: str, *, check: bool = True) -> Iterator[None]:
        """Hold the link for one exchange and let nothing but this project's errors out.

        ``check`` makes pipython ask for the error code after every command.
        """
        with self._lock:
            try:
                self._fall_into_step()
                self._messages.errcheck = check
                yield
            except DeviceError:
                raise
            except TimeoutError as error:
                self._out_of_step = True
                raise NoReply(DEVICE, f"cannot {purpose}: {error} on {self._connection}", CABLES) from error
            except OSError as error:
                raise NotConnected(DEVICE, f"cannot {purpose}: {self._connection}: {error}", CABLES) from error
            except GARBLED as error:
                raise self._garbled(purpose, error) from error
            except self._gcs_error as error:
                code: int = error.val  # type: ignore[attr-defined]
                if code == MALFORMED:
                    raise self._garbled(purpose, error) from error
                raise self._error_of(code, purpose) from error

    def _garbled(self, purpose: str, error: Exception) -> BadReply:
        self._out_of_step = True
        return BadReply(DEVICE, f"cannot {purpose}: the reply makes no sense: {error}", "check cable and baud rate")

    def _fall_into_step(self) -> None:
        """After a missing or garbled reply, discard every late one.

        The controller answers in order, and its identity can be mistaken for nothing else: whatever comes before the
        last identity asked for is stale. One that has been lost is not waited for longer than for any reply.
        """
        if not self._gateway.connected:
            raise ConnectionError("the port was closed")
        if not self._out_of_step:
            return
        self._gateway.send("*IDN?\n")
        self._landmarks += 1
        received = ""
        while not (received.count(self._identity_line) >= self._landmarks and received.endswith("\n")):
            try:
                received += self._gateway.read()
            except TimeoutError:
                if self._identity_line not in received:
                    raise
                break
        self._landmarks = 0
        self._out_of_step = False
