"""An emulated PI C-863.12 Mercury controller with one axis, answering GCS 2.0 byte by byte.

Sources: PI C-863.12 user manual MS249E (command syntax p. 116, status word p. 126, busy flag p. 127, parameters
p. 181). It executes a command when its bytes arrive and only the reply is delayed, so that a stop byte is never late.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

from drivers.emulated.server import WIRE_FAULTS, FaultyWire, Line, scrambled
from drivers.emulated.world import World

FAULTS: Mapping[str, str] = MappingProxyType(
    {
        **WIRE_FAULTS,
        "error_code": "the controller latches this error and refuses set commands with it (default 2)",
        "blocked": "the carriage is held: motion error -1024, servo off",
        "limit_switch": "a limit switch closes (value < 0 negative, > 0 positive, 0 the one ahead); motion stops",
        "servo_lost": "the servo switches itself off and cannot be switched on",
        "rebooted": "the controller restarts: servo off, unreferenced, deaf for so many seconds (default 0)",
    }
)

# Error codes (MS249E, appendix).
SYNTAX, UNKNOWN_COMMAND, TOO_LONG = 1, 2, 3
NO_REFERENCE_OR_SERVO, POSITION_LIMIT, VELOCITY_LIMIT, STOPPED = 5, 7, 8, 10
PARAMETER_RANGE, ILLEGAL_AXIS, ARGUMENT_COUNT, BAD_NUMBER = 17, 23, 24, 25
REFERENCING_NEEDS_RON, JOYSTICK, IN_MOTION, UNKNOWN_PARAMETER = 50, 51, 53, 54
MOTION_ERROR = -1024

CONTROL_BYTES = {0x04: "#4", 0x05: "#5", 0x07: "#7", 0x08: "#8", 0x18: "#24"}
LONGEST_LINE = 256
BROADCAST = 255
READY, BUSY = "\xb1", "\xb0"


class Refused(Exception):
    """A command that sets an error code instead of acting."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(code)


class Parameter(NamedTuple):
    """One line of ``HPA?``: number, type and meaning."""

    number: int
    kind: Literal["INT", "FLOAT", "CHAR"]
    meaning: str


PARAMETERS = (
    Parameter(0x8, "FLOAT", "Maximum Position Error"),
    Parameter(0xA, "FLOAT", "Maximum Closed-Loop Velocity"),
    Parameter(0xB, "FLOAT", "Current Closed-Loop Acceleration"),
    Parameter(0xC, "FLOAT", "Current Closed-Loop Deceleration"),
    Parameter(0xE, "INT", "Numerator Of The Counts-Per-Physical-Unit Factor"),
    Parameter(0xF, "INT", "Denominator Of The Counts-Per-Physical-Unit Factor"),
    Parameter(0x14, "INT", "Has Reference"),
    Parameter(0x15, "FLOAT", "Travel Range Maximum"),
    Parameter(0x16, "FLOAT", "Value At Reference Position"),
    Parameter(0x30, "FLOAT", "Travel Range Minimum"),
    Parameter(0x32, "INT", "Has No Limit Switches"),
    Parameter(0x36, "INT", "Settling Window"),
    Parameter(0x3C, "CHAR", "Stage Name"),
    Parameter(0x3F, "FLOAT", "Settling Time"),
    Parameter(0x49, "FLOAT", "Current Closed-Loop Velocity"),
    Parameter(0x4A, "FLOAT", "Maximum Closed-Loop Acceleration"),
    Parameter(0x4B, "FLOAT", "Maximum Closed-Loop Deceleration"),
)

Arguments = list[str]
Handler = Callable[[Arguments], "str | None"]


class EmulatedController:
    """The controller: many hosts may be connected, there is one axis and one error latch.

    Parameters
    ----------
    world
        The plant; its axis counts m in the controller's own direction.
    axis
        Name of the axis.
    travel
        Soft limits, m.
    switch_margin
        Limit switches close so far beyond the soft limits, m.
    encoder_step
        One count, m.
    referenced
        Whether the axis has been referenced (and its servo switched on) before anyone connects.
    latency
        Delay of every reply, s of real time.
    error_latch
        Which of several errors is kept until it is read.
    limit_bits_inverted
        Signal polarity of the limit switches: the status word shows a closed switch as 0.
    leading_nul
        Multi-line replies begin with a NUL byte, as some firmwares do.
    address
        Controller address for addressed commands (``1 0 POS?``), 1 to 16.
    joystick
        A joystick owns the axis: moves are refused.
    on_target_stuck
        After a stop the on-target flag stays down, as seen on some controllers.
    reboot_time
        Seconds of real time for which ``RBT`` makes the controller deaf.
    seed
        Chooses the encoder's flicker.

    Attributes
    ----------
    received : Counter
        How often each command has been received.
    """

    def __init__(
        self,
        world: World,
        *,
        axis: str = "1",
        travel: tuple[float, float] = (0.0, 52e-3),
        switch_margin: float = 0.5e-3,
        encoder_step: float = 50e-9,
        referenced: bool = False,
        latency: float = 0.0,
        error_latch: Literal["first", "last"] = "last",
        limit_bits_inverted: bool = False,
        leading_nul: bool = False,
        address: int = 1,
        joystick: bool = False,
        on_target_stuck: bool = False,
        reboot_time: float = 2.0,
        model: str = "C-863.12",
        stage: str = "LPS-65.2IN",
        seed: int = 0,
    ) -> None:
        self.received: Counter[str] = Counter()
        self.joystick = joystick
        self._world = world
        self._name = axis
        self._travel = travel
        self._switches = (travel[0] - switch_margin, travel[1] + switch_margin)
        self._step = encoder_step
        self._wire = FaultyWire(world.faults, "stage", latency, seed)
        self._error_latch = error_latch
        self._limits_idle = 0b101 if limit_bits_inverted else 0
        self._leading_nul = leading_nul
        self._address = address
        self._on_target_stuck = on_target_stuck
        self._reboot_time = reboot_time
        self._identity = f"(c)2015 Physik Instrumente (PI) GmbH & Co. KG, {model}, EMULATED, 1.2.1.0"
        self._stage = stage
        self._seed = seed
        self._parameters: dict[int, float | str] = {
            0x8: 0.5,
            0xA: 20.0,
            0xB: 100.0,
            0xC: 100.0,
            0xE: round(1e-3 / encoder_step),
            0xF: 1,
            0x14: 1,
            0x15: travel[1] * 1e3,
            0x16: (travel[0] + travel[1]) / 2 * 1e3,
            0x30: travel[0] * 1e3,
            0x32: 0,
            0x36: 10,
            0x3C: stage,
            0x3F: 0.02,
            0x49: 5.0,
            0x4A: 200.0,
            0x4B: 200.0,
        }
        self._stored = dict(self._parameters)
        self._commands = self._command_table()
        self._deaf_until = -math.inf
        with world.lock:
            self._power_up()
            if referenced:
                self._offset = 0.0
                self._is_referenced = self._servo = True

    def connect(self, line: Line) -> ControllerSession:
        """Begin a session with a host."""
        self._wire.check_plugged()
        return ControllerSession(self, line, self._wire)

    # ------------------------------------------------------------------ what arrives

    def control(self, byte: int) -> str | None:
        """Act on a single-byte command."""
        with self._world.lock:
            self._catch_up()
            if self._is_deaf:
                return None
            name = CONTROL_BYTES[byte]
            self.received[name] += 1
            return self._commands[name]([])

    def execute(self, text: str) -> str | None:
        """Act on a line (without its LF) and return the reply, if there is one."""
        with self._world.lock:
            self._catch_up()
            if self._is_deaf:
                return None
            if len(text) > LONGEST_LINE:
                self._latch(TOO_LONG)
                return None
            addressed, words = self._strip_address(text.split())
            if not words:
                return None
            reply = self._execute(words)
            if addressed == BROADCAST or reply is None:
                return None
            return reply if addressed is None else f"0 {addressed} {reply}"

    def poll(self) -> tuple[int, float] | None:
        """Return what ``#4`` and ``POS?`` say, without writing and reading the words: status, and position in mm."""
        with self._world.lock:
            self._catch_up()
            if self._is_deaf:
                return None
            self.received.update(("#4", "POS?"))
            return self._status(), float(shown(self._position))

    def _strip_address(self, words: list[str]) -> tuple[int | None, list[str]]:
        """Split ``addr [0] COMMAND ...``; lines for another controller are dropped."""
        if not words or not words[0].isdecimal():
            return None, words
        address = int(words[0])
        rest = words[2:] if len(words) > 1 and words[1] == "0" else words[1:]
        return (address, rest) if address in (self._address, BROADCAST) else (address, [])

    def _execute(self, words: list[str]) -> str | None:
        name = words[0].upper()
        handler = self._commands.get(name)
        is_set_command = not name.endswith("?") and name not in ("HLT", "STP", "RBT")
        self.received[name if handler else "unknown"] += 1
        try:
            if handler is None or name.startswith("#"):
                raise Refused(UNKNOWN_COMMAND)
            if is_set_command and (fault := self._wire.fault("error_code")):
                raise Refused(int(fault.value) or UNKNOWN_COMMAND)
            return handler(words[1:])
        except Refused as refusal:
            self._latch(refusal.code)
            return None

    # ------------------------------------------------------------------ state

    def _power_up(self) -> None:
        self._parameters = dict(self._stored)
        self._servo = False
        self._is_referenced = False
        self._reference_mode = True
        self._error = 0
        self._referencing: list[tuple[float, Callable[[], None]]] = []
        self._settled_since: float | None = None
        self._was_stopped = False
        self._pressed = 0
        self._world.axis.halt(math.inf)
        self._offset = self._world.axis.position

    @property
    def _is_deaf(self) -> bool:
        return time.monotonic() < self._deaf_until

    def _latch(self, code: int) -> None:
        if self._error_latch == "last" or self._error == 0:
            self._error = code

    def _catch_up(self) -> None:
        """Let happen what has happened since the last command: faults, trips, the end of a reference move."""
        axis = self._world.axis
        if fault := self._wire.fault_begins("rebooted"):
            self._power_up()
            self._deaf_until = time.monotonic() + fault.value
        if fault := self._wire.fault_begins("error_code"):
            self._latch(int(fault.value) or UNKNOWN_COMMAND)
        if self._wire.fault("servo_lost"):
            self._drop_servo()
        if self._servo and (self._held_fast or self._following_error > self._number(0x8)):
            self._drop_servo()
            self._latch(MOTION_ERROR)
        self._watch_switches()
        if self._referencing and not axis.moving:
            self._referencing.pop(0)[1]()
            self._start_referencing()
        self._watch_settling()

    @property
    def _following_error(self) -> float:
        """How far the carriage lags behind its trajectory, mm."""
        return abs(self._world.axis.commanded - self._world.axis.position) * 1e3

    @property
    def _held_fast(self) -> bool:
        return self._world.axis.moving and self._wire.fault("blocked") is not None

    def _drop_servo(self) -> None:
        if self._servo:
            self._world.axis.halt(math.inf)
        self._servo = False
        self._referencing.clear()

    def _watch_switches(self) -> None:
        axis = self._world.axis
        position = axis.position
        pressed = (0b001 if position <= self._switches[0] else 0) | (0b100 if position >= self._switches[1] else 0)
        if fault := self._wire.fault("limit_switch"):
            pressed |= self._pressed or (0b100 if (fault.value or axis.target - position) > 0 else 0b001)
        newly, self._pressed = pressed & ~self._pressed, pressed
        if not pressed:
            return
        velocity = axis.velocity
        heads_in = (pressed & 0b001 and velocity < 0) or (pressed & 0b100 and velocity > 0)
        if (newly or heads_in) and axis.moving and not self._referencing:
            axis.halt(math.inf)

    def _watch_settling(self) -> None:
        axis = self._world.axis
        window = self._number(0x36) * self._step
        is_still = self._servo and not axis.moving and abs(axis.position - axis.target) <= window
        if not is_still:
            self._settled_since = None
        elif self._settled_since is None:
            self._settled_since = self._world.time

    @property
    def _on_target(self) -> bool:
        if self._settled_since is None or (self._on_target_stuck and self._was_stopped):
            return False
        return self._world.time - self._settled_since >= self._number(0x3F)

    @property
    def _is_moving(self) -> bool:
        return self._world.axis.moving or bool(self._referencing)

    def _status(self) -> int:
        return (
            (self._pressed ^ self._limits_idle)
            | bool(self._error) << 8
            | self._servo << 12
            | self._is_moving << 13
            | bool(self._referencing) << 14
            | self._on_target << 15
        )

    def _number(self, parameter: int) -> float:
        return float(self._parameters[parameter])

    @property
    def _position(self) -> float:
        """What the encoder reads, mm: whole counts that flicker by one."""
        flicker = scrambled(self._world.sample, self._seed) % 3 - 1
        counts = round((self._world.axis.position - self._offset) / self._step) + flicker
        return counts * self._step * 1e3

    # ------------------------------------------------------------------ commands

    def _command_table(self) -> dict[str, Handler]:
        return {
            "#4": lambda _: f"0x{self._status():04X}",
            "#5": lambda _: f"{int(self._is_moving):X}",
            "#7": lambda _: BUSY if self._referencing else READY,
            "#8": lambda _: "0",
            "#24": self._stop_abruptly,
            "*IDN?": lambda _: self._identity,
            "CSV?": lambda _: "2.0",
            "VER?": lambda _: self._lines("FW_DSP: V1.2.1.0", "FW_BOOT: V1.0.0.0"),
            "HLP?": lambda _: self._lines(*self._help()),
            "HPA?": lambda _: self._lines(*self._parameter_help()),
            "SAI?": self._ask_axes,
            "CST?": self._ask(lambda: str(self._parameters[0x3C])),
            "CST": self._set_stage,
            "ERR?": self._ask_error,
            "SRG?": self._ask_register,
            "SVO": self._set_servo,
            "SVO?": self._ask(lambda: int(self._servo)),
            "RON": self._set_reference_mode,
            "RON?": self._ask(lambda: int(self._reference_mode)),
            "FRF": lambda words: self._reference(words, self._seek_reference_switch),
            "FNL": lambda words: self._reference(words, self._seek_negative_limit),
            "FPL": lambda words: self._reference(words, self._seek_positive_limit),
            "FRF?": self._ask(lambda: int(self._is_referenced)),
            "TRS?": self._ask(lambda: int(self._parameters[0x14])),
            "LIM?": self._ask(lambda: int(not self._parameters[0x32])),
            "MOV": lambda words: self._move(self._setting(words)),
            "MVR": lambda words: self._move(self._target + self._setting(words)),
            "MOV?": self._ask(lambda: self._target),
            "POS": self._set_position,
            "POS?": self._ask(lambda: self._position),
            "TMN?": self._ask(lambda: self._number(0x30)),
            "TMX?": self._ask(lambda: self._number(0x15)),
            "VEL": self._set_motion(0x49, 0xA, VELOCITY_LIMIT),
            "VEL?": self._ask(lambda: self._number(0x49)),
            "ACC": self._set_motion(0xB, 0x4A, PARAMETER_RANGE),
            "ACC?": self._ask(lambda: self._number(0xB)),
            "DEC": self._set_motion(0xC, 0x4B, PARAMETER_RANGE),
            "DEC?": self._ask(lambda: self._number(0xC)),
            "ONT?": self._ask(lambda: int(self._on_target)),
            "HLT": self._halt,
            "STP": self._stop_abruptly,
            "RBT": self._reboot,
            "SPA": self._set_parameter,
            "SPA?": self._ask_parameter,
            "WPA": self._write_parameters,
        }

    def _lines(self, *lines: str) -> str:
        return ("\0" if self._leading_nul else "") + " \n".join(lines)

    def _axes(self, words: Arguments) -> None:
        for word in words:
            if word != self._name:
                raise Refused(ILLEGAL_AXIS)

    def _ask(self, value: Callable[[], float | str]) -> Handler:
        """A question about axes; without arguments it is about all."""

        def answer(words: Arguments) -> str:
            self._axes(words)
            return " \n".join(f"{self._name}={shown(value())}" for _ in words or [self._name])

        return answer

    def _setting(self, words: Arguments) -> float:
        """Return the value of ``COMMAND axis value``."""
        if len(words) != 2:
            raise Refused(ARGUMENT_COUNT)
        self._axes(words[:1])
        try:
            value = float(words[1])
        except ValueError:
            raise Refused(BAD_NUMBER) from None
        if not math.isfinite(value):
            raise Refused(BAD_NUMBER)
        return value

    def _switch(self, words: Arguments) -> bool:
        value = self._setting(words)
        if value not in (0, 1):
            raise Refused(PARAMETER_RANGE)
        return bool(value)

    def _help(self) -> list[str]:
        commands = sorted(name for name in self._commands if not name.startswith("#"))
        control = [f"{name} Single-character command" for name in CONTROL_BYTES.values()]
        return ["The following commands are valid:", *control, *commands, "end of help"]

    def _parameter_help(self) -> list[str]:
        rows = [f"0x{p.number:X}=\t0\t1\t{p.kind}\tmotorcontroller\t{p.meaning}" for p in PARAMETERS]
        return ["The following parameters are valid:", *rows, "end of help"]

    def _ask_axes(self, words: Arguments) -> str:
        if words not in ([], ["ALL"]):
            raise Refused(SYNTAX)
        return self._name

    def _ask_error(self, words: Arguments) -> str:
        if words:
            raise Refused(ARGUMENT_COUNT)
        error, self._error = self._error, 0
        return str(error)

    def _ask_register(self, words: Arguments) -> str:
        if len(words) != 2 or words[1] != "1":
            raise Refused(ARGUMENT_COUNT)
        self._axes(words[:1])
        return f"{self._name} 1=0x{self._status():04X}"

    def _set_stage(self, words: Arguments) -> None:
        if len(words) != 2:
            raise Refused(ARGUMENT_COUNT)
        self._axes(words[:1])
        self._parameters[0x3C] = words[1]

    def _set_servo(self, words: Arguments) -> None:
        on = self._switch(words)
        if not on:
            self._drop_servo()
        elif not self._servo and not self._wire.fault("servo_lost"):
            self._world.axis.halt(math.inf)
            self._servo = True

    def _set_reference_mode(self, words: Arguments) -> None:
        self._reference_mode = self._switch(words)

    @property
    def _target(self) -> float:
        return (self._world.axis.target - self._offset) * 1e3

    def _go(self, target: float, speed: float) -> None:
        self._was_stopped = False
        self._settled_since = None
        acceleration, deceleration = self._number(0xB) * 1e-3, self._number(0xC) * 1e-3
        self._world.axis.move(target, speed * 1e-3, acceleration, deceleration)

    def _move(self, target: float) -> None:
        """Go to ``target`` (mm)."""
        if self.joystick:
            raise Refused(JOYSTICK)
        if self._referencing:
            raise Refused(IN_MOTION)
        if not self._servo or (self._reference_mode and not self._is_referenced):
            raise Refused(NO_REFERENCE_OR_SERVO)
        if not self._number(0x30) <= target <= self._number(0x15):
            raise Refused(POSITION_LIMIT)
        position = target * 1e-3 + self._offset
        ahead = position - self._world.axis.position
        if (self._pressed & 0b001 and ahead < 0) or (self._pressed & 0b100 and ahead > 0):
            raise Refused(POSITION_LIMIT)
        self._go(position, self._number(0x49))

    def _set_motion(self, parameter: int, maximum: int, error: int) -> Handler:
        """VEL, ACC and DEC; they take effect on a running move too."""

        def apply(words: Arguments) -> None:
            value = self._setting(words)
            if not 0 < value <= self._number(maximum):
                raise Refused(error)
            self._parameters[parameter] = value
            axis = self._world.axis
            if axis.moving and self._servo and not self._referencing and not self._was_stopped:
                self._go(axis.target, self._number(0x49))

        return apply

    def _set_position(self, words: Arguments) -> None:
        """Declare where the axis stands; the limits do not move with it."""
        value = self._setting(words)
        if self._reference_mode:
            raise Refused(PARAMETER_RANGE)
        self._offset = self._world.axis.position - value * 1e-3
        self._is_referenced = True

    def _reference(self, words: Arguments, seek: Callable[[], list[tuple[float, Callable[[], None]]]]) -> None:
        self._axes(words)
        if self.joystick:
            raise Refused(JOYSTICK)
        if not self._reference_mode:
            raise Refused(REFERENCING_NEEDS_RON)
        if not self._servo:
            raise Refused(NO_REFERENCE_OR_SERVO)
        if self._is_moving:
            raise Refused(IN_MOTION)
        self._is_referenced = False
        self._referencing = seek()
        self._start_referencing()

    def _start_referencing(self) -> None:
        if self._referencing:
            self._go(self._referencing[0][0], min(self._number(0x49), self._number(0xA) / 2))

    def _seek_reference_switch(self) -> list[tuple[float, Callable[[], None]]]:
        return [(self._number(0x16) * 1e-3, self._set_reference)]

    def _seek_negative_limit(self) -> list[tuple[float, Callable[[], None]]]:
        return [(self._switches[0], self._set_reference), (self._travel[0], lambda: None)]

    def _seek_positive_limit(self) -> list[tuple[float, Callable[[], None]]]:
        return [(self._switches[1], self._set_reference), (self._travel[1], lambda: None)]

    def _set_reference(self) -> None:
        self._offset = 0.0
        self._is_referenced = True

    def _halt(self, words: Arguments) -> None:
        self._axes(words)
        self._stop(self._number(0xC) * 1e-3)

    def _stop_abruptly(self, words: Arguments) -> None:
        del words
        self._stop(math.inf)

    def _stop(self, deceleration: float) -> None:
        self._world.axis.halt(deceleration)
        self._referencing.clear()
        self._was_stopped = True
        self._latch(STOPPED)

    def _reboot(self, words: Arguments) -> None:
        del words
        self._power_up()
        self._deaf_until = time.monotonic() + self._reboot_time

    def _parameter_number(self, word: str) -> int:
        try:
            number = int(word, 0)
        except ValueError:
            raise Refused(BAD_NUMBER) from None
        if number not in self._parameters:
            raise Refused(UNKNOWN_PARAMETER)
        return number

    def _set_parameter(self, words: Arguments) -> None:
        if len(words) != 3:
            raise Refused(ARGUMENT_COUNT)
        self._axes(words[:1])
        number = self._parameter_number(words[1])
        kind = type(self._parameters[number])
        self._parameters[number] = words[2] if kind is str else kind(self._setting([words[0], words[2]]))

    def _ask_parameter(self, words: Arguments) -> str:
        if len(words) != 2:
            raise Refused(ARGUMENT_COUNT)
        self._axes(words[:1])
        number = self._parameter_number(words[1])
        return f"{self._name} 0x{number:X}={shown(self._parameters[number])}"

    def _write_parameters(self, words: Arguments) -> None:
        if words != ["100"]:
            raise Refused(PARAMETER_RANGE)
        self._stored = dict(self._parameters)


class ControllerSession:
    """The bytes of one host: control bytes act at once, even in the middle of a line."""

    watch_interval: float | None = None

    def __init__(self, controller: EmulatedController, line: Line, wire: FaultyWire) -> None:
        self._controller = controller
        self._line = line
        self._wire = wire
        self._text = bytearray()

    def receive(self, data: bytes) -> None:
        """Act on bytes from the host."""
        self._wire.check_plugged()
        for byte in data:
            if byte in CONTROL_BYTES:
                self._answer(self._controller.control(byte))
            elif byte == 0x0A:
                text = self._text.decode("latin-1")
                self._text.clear()
                self._answer(self._controller.execute(text))
            elif len(self._text) <= LONGEST_LINE:
                self._text.append(byte)

    def watch(self) -> None:
        """The controller never speaks unasked."""

    def _answer(self, reply: str | None) -> None:
        if reply is not None:
            self._wire.deliver(reply.encode("latin-1") + b"\n", self._line)


def shown(value: float | str) -> str:
    """Write a value as the controller does: floats with seven decimals, the rest as it is."""
    return f"{value:.7f}" if isinstance(value, float) else str(value)
