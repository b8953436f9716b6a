"""KD Scientific Legato syringe pump through pyserial.

Sources: KD Scientific Legato 200 series manual (command set, prompts, status flags p. 65).
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import threading
import time
from collections import deque
from collections.abc import Iterator
from decimal import ROUND_DOWN, ROUND_UP, Decimal
from typing import Any, NamedTuple

import serial
from serial.urlhandler import protocol_socket

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
from drivers.interfaces import Clock, Identity, PumpState, PumpStatus

DEVICE = "pump"
XON = b"\x11"
LONGEST_REPLY = 4096
FEMTOLITRE = 1e-18
UNITS = {"ml": 1e-6, "ul": 1e-9, "nl": 1e-12, "pl": 1e-15}
SECONDS = {"hr": 3600.0, "min": 60.0, "sec": 1.0, "h": 3600.0, "m": 60.0, "s": 1.0}
STATES = {
    ":": PumpState.IDLE,
    ">": PumpState.INFUSING,
    "<": PumpState.WITHDRAWING,
    "*": PumpState.STALLED,
    "T*": PumpState.TARGET_REACHED,
    ">*": PumpState.AT_LIMIT,
    "<*": PumpState.AT_LIMIT,
}
RUNNING = (PumpState.INFUSING, PumpState.WITHDRAWING)

ENDING = re.compile(r"(?:\A|(?<=\n))(?:\d\d)?(T\*|[<>]\*|[:<>*])\Z")
PREFIX = re.compile(r"\A\d\d:")
QUANTITY = re.compile(r"(\d+(?:\.\d*)?|\.\d+) ([munp]l)(?:/(hr|min|sec|h|m|s))?")
STATUS = re.compile(r"(\d{1,18}) (\d{1,18}) (\d{1,18}) ([iIwW])[iIwW.][S.][T.][iIwW.][T.]?", re.ASCII)

SAME = 5e-3
"""Relative difference at which a setting read back still counts as the one sent: the pump rounds."""
FEW_STEPS = 5e-11
"""Volume of a few motor steps of a large syringe, m^3."""
CABLES = "check the pump's power and cable, and the port in the bench file; then connect again"


class Reply(NamedTuple):
    """Lines of text and the state that the prompt behind them tells."""

    lines: tuple[str, ...]
    state: PumpState

    @property
    def text(self) -> str:
        """The first line, or nothing."""
        return self.lines[0] if self.lines else ""


class Request:
    """A command on its way; ``reply`` comes to it in the order in which the requests were sent."""

    def __init__(self, command: str) -> None:
        self.command = command
        self.reply: bytes | None = None


def parse_reply(data: bytes) -> Reply:
    """Take a reply apart: ``LF (text CR LF)* prompt``; lines and prompt may carry the pump's address.

    Raises
    ------
    ValueError
        It is not of this form.
    """
    text = data.removesuffix(XON).decode("ascii")
    ending = ENDING.search(text)
    if ending is None:
        raise ValueError(f"{data[-40:]!r} does not end with a prompt")
    lines = [PREFIX.sub("", line.strip("\r")) for line in text[: ending.start()].split("\n")]
    if not all(line.isprintable() for line in lines):
        raise ValueError(f"{data[:80]!r} holds control characters")
    return Reply(tuple(line for line in lines if line), STATES[ending[1]])


def parse_quantity(text: str) -> float:
    """Return a volume (m^3) or rate (m^3/s) written as the pump does, ``199.49 ul/min``.

    Raises
    ------
    ValueError
        It is not of this form.
    """
    match = QUANTITY.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"{text[:80]!r} is not a volume or rate")
    per = SECONDS[match[3]] if match[3] else 1.0
    return float(match[1]) * UNITS[match[2]] / per


def format_quantity(volume: float, *, up: bool = False) -> str:
    """Write a volume (m^3) for the pump: six digits, no exponent, rounded towards zero or ``up``.

    Examples
    --------
    >>> format_quantity(1.5e-9)
    '1.5 ul'
    >>> format_quantity(2e-6 / 3)
    '666.666 ul'
    """
    unit = next((unit for unit, size in UNITS.items() if volume >= size), "pl")
    value = Decimal(volume) / Decimal(str(UNITS[unit]))
    digits = Decimal(1).scaleb(max(value.adjusted() - 5, -3 if unit == "pl" else value.adjusted() - 5))
    # A binary fraction may lie a hair below the decimal it means.
    rounded = (value * (1 + Decimal("1e-14"))).quantize(digits, ROUND_UP if up else ROUND_DOWN)
    return f"{rounded.normalize():f} {unit}"


class LegatoPump:
    """One Legato with one syringe; fits ``drivers.interfaces.Pump``.

    On connection the pump is stopped, whatever it did, and told its syringe; settings are kept out of its memory.

    Parameters
    ----------
    connection
        ``socket://host:port`` or a serial device.
    baud
        Baud rate of a serial device.
    address
        The pump's address; 0 for a single pump.
    syringe_diameter
        Inner diameter of the syringe, m.
    force_percent
        Pusher force, 1 to 100 %; too little stalls, too much breaks glass.
    expected_model
        Must be part of the answer to ``ver``.
    reply_timeout
        Longest wait for a reply, s.
    settle
        Time the pump needs after loading its method, s.
    clock
        The bench's time base.

    Raises
    ------
    NotConnected
        The port cannot be opened.
    NoReply
        The port is open, but nobody answers.
    WrongDevice
        Another device answers.
    OutOfRange
        Diameter, force or address are impossible.
    """

    def __init__(
        self,
        connection: str,
        *,
        baud: int = 115200,
        address: int = 0,
        syringe_diameter: float,
        force_percent: int,
        expected_model: str = "Legato",
        reply_timeout: float = 0.5,
        settle: float = 0.2,
        clock: Clock = time.perf_counter,
    ) -> None:
        check_range("syringe diameter", syringe_diameter * 1e3, 0.1, 50.0, "mm")
        check_range("force", force_percent, 1, 100, "%")
        check_range("address", address, 0, 99, "")
        self._connection = connection
        self._prefix = f"{address:02d}" if address else ""
        self._diameter = syringe_diameter
        self._timeout = reply_timeout
        self._clock = clock
        self._lock = threading.RLock()
        self._writing = threading.Lock()
        self._awaited: deque[Request] = deque()
        self._out_of_step = True
        self._landmarks = 0
        self._version = ""
        self._finished = 0.0
        self._run: tuple[float, float] | None = None
        self._furthest = 0.0
        self._port = self._open(baud)
        try:
            self._identity = self._identify(expected_model)
            self._prepare(force_percent, settle)
            self._rate_limits = self._read_limits()
        except BaseException:
            self.close()
            raise

    @property
    def identity(self) -> Identity:
        """Get what the pump said on connection."""
        return self._identity

    @property
    def rate_limits(self) -> tuple[float, float]:
        """Get slowest and fastest rate for the syringe, m^3/s, valid both ways."""
        return self._rate_limits

    def status(self) -> PumpStatus:
        """Poll state, rate and delivered volume.

        Raises
        ------
        MotionFault
            The pump reports its target before it has delivered the volume, or its diameter has been changed.
        """
        with self._lock:
            sent = self._clock()
            reply, rate, volume = self._poll("@status")
            received = self._clock()
            self._check_target(reply.state, volume)
        return PumpStatus(sent, received, reply.state, rate, self._finished + volume)

    def dispense(self, volume: float, rate: float) -> None:
        """Start to infuse (``volume`` > 0) or withdraw (< 0), m^3, at ``rate``, m^3/s within ``rate_limits``.

        The volume is the pump's own target: it stops by itself if this program dies.
        """
        low, high = self._rate_limits
        check_range("volume", abs(volume) * 1e9, 1e-3, 1e6, "ul")
        check_range("rate", rate * 6e10, low * 6e10, high * 6e10, "ul/min")
        letter = "i" if volume > 0 else "w"
        target = format_quantity(abs(volume))
        speed = f"{format_quantity(rate * 60, up=rate < 1.001 * low)}/min"
        with self._lock:
            self._halt()
            self._check_diameter()
            for command in (f"c{letter}volume", "ctvolume", f"{letter}rate {speed}", f"tvolume {target}"):
                self._ask(command)
            self._check_setting(f"{letter}rate", rate)
            self._check_setting("tvolume", abs(volume))
            self._run = (math.copysign(parse_quantity(target), volume), rate)
            self._furthest = 0.0
            state = self._exchange(f"{letter}run").state
        wanted = PumpState.INFUSING if volume > 0 else PumpState.WITHDRAWING
        if state in RUNNING and state is not wanted:  # "irun" or "wrun" without its first letter runs either way
            self.stop()
        if state not in (wanted, PumpState.TARGET_REACHED):
            raise MotionFault(DEVICE, f"does not start: it is {state}", "look at the pump's screen and at the syringe")

    def stop(self) -> None:
        """Stop at once: the command goes out before any waiting, from any thread; then it is confirmed."""
        # The bare CR wakes a pump whose screen has been touched.
        request = self._send("", "stp")
        with self._lock:
            if not self._out_of_step:
                with contextlib.suppress(NoReply, ValueError):
                    if parse_reply(self._receive(request)).state not in RUNNING:
                        return
                self._out_of_step = True
            state = self._ask("stp").state
        if state in RUNNING:
            raise CommandRefused(DEVICE, f"was told to stop, but is {state}", "stop it at its screen or unplug it")

    def close(self) -> None:
        """Release the port; the pump is left as it is. Closing twice does no harm."""
        with self._lock, contextlib.suppress(OSError):
            self._port.close()

    # ------------------------------------------------------------------ connection

    def _open(self, baud: int) -> Any:
        with opening(DEVICE, self._connection):
            return open_port(self._connection, baud, self._timeout)

    def _identify(self, expected_model: str) -> Identity:
        remedy = "check the port in the bench file; the pump must speak its current command set at this baud rate"
        try:
            self._fall_into_step()
            self._ask("echo off")
            version = self._ask("ver").text
            details = dict(line.partition(":")[::2] for line in self._ask("version").lines)
        except (BadReply, CommandRefused) as error:
            raise WrongDevice(
                DEVICE, f"{self._connection} answers, but not as a pump: {error.message}", remedy
            ) from error
        if expected_model.casefold() not in version.casefold():
            raise WrongDevice(
                DEVICE, f"{self._connection} says it is {version[:80]!r}, the bench expects {expected_model!r}", remedy
            )
        self._version = version
        model, _, number = version.rpartition(" ")
        firmware = details.get("Firmware", number).strip()
        return Identity("KD Scientific", model, details.get("Serial number", "").strip(), firmware)

    def _prepare(self, force_percent: int, settle: float) -> None:
        """Stop what runs and apply every setting anew: power may have been lost since the last time."""
        self._ask("stp")
        self._keep_memory()
        self._ask("load qs iw")
        time.sleep(settle)
        self._ask(f"force {force_percent}")
        self._ask(f"diameter {self._diameter * 1e3:.4f}")
        self._check_diameter()
        for command in ("cvolume", "ctime", "ctvolume", "cttime"):
            self._ask(command)

    def _keep_memory(self) -> None:
        """Switch writing to the pump's memory off, which wears out; firmwares call it differently."""
        for word in ("off", "none"):
            with contextlib.suppress(CommandRefused):
                self._ask(f"nvram {word}")
                return
        logging.getLogger(__name__).warning(
            "pump: takes neither 'nvram off' nor 'nvram none'; every setting wears its memory"
        )

    def _read_limits(self) -> tuple[float, float]:
        """Read the limits both ways; a per mille inside them, since the pump may refuse its own rounded limits."""
        with self._understanding("irate lim"):
            ranges = [
                [parse_quantity(end) for end in self._ask(f"{letter}rate lim").text.split(" to ")] for letter in "iw"
            ]
            low, high = max(low for low, _ in ranges), min(high for _, high in ranges)
            if not 0 < low < high:
                raise ValueError(f"{low} .. {high} m^3/s is no range")
        return low * 1.001, high * 0.999

    # ------------------------------------------------------------------ state

    def _poll(self, command: str) -> tuple[Reply, float, float]:
        """Ask for the status, and again if the run's volume has shrunk: a number that has lost a digit is one still."""
        for _ in range(2):
            reply = self._ask(command)
            rate, volume = self._progress(reply)
            if abs(volume) >= self._furthest:
                break
        self._furthest = abs(volume)
        return reply, rate, volume

    def _progress(self, reply: Reply) -> tuple[float, float]:
        """Return signed rate (m^3/s) and signed volume of the present or last run (m^3)."""
        with self._understanding("status"):
            match = STATUS.fullmatch(reply.text.strip())
            if match is None:
                raise ValueError(f"{reply.text[:80]!r} is not a status")
            rate, volume = float(match[1]) * FEMTOLITRE, float(match[3]) * FEMTOLITRE
        if self._run is None:
            return 0.0, 0.0
        sign = 1.0 if match[4] in "iI" else -1.0
        return sign * rate if reply.state in RUNNING else 0.0, sign * volume

    def _check_target(self, state: PumpState, volume: float) -> None:
        if state is not PumpState.TARGET_REACHED or self._run is None:
            return
        target = self._run[0]
        if abs(volume - target) > 1e-2 * abs(target) + FEW_STEPS:
            raise MotionFault(
                DEVICE,
                f"reports its target after {volume * 1e9:.4g} of {target * 1e9:.4g} ul",
                "look at the pump's screen for another target, then run again",
            )

    def _halt(self) -> None:
        """Stop and add what the run has delivered to what earlier ones have."""
        self._ask("stp")
        if self._run is not None:
            self._finished += self._poll("status")[2]
            self._run = None

    def _check_diameter(self) -> None:
        with self._understanding("diameter"):
            number, _, unit = self._ask("diameter").text.partition(" ")
            if unit != "mm":
                raise ValueError(f"unit {unit!r}")
            diameter = float(number) * 1e-3
        if not abs(diameter - self._diameter) <= 1e-3 * self._diameter:
            raise MotionFault(
                DEVICE,
                f"counts with a syringe of {diameter * 1e3:g} mm, the bench says {self._diameter * 1e3:g} mm",
                "nobody may change the syringe at the pump's screen; connect again to set it",
            )

    def _check_setting(self, name: str, expected: float) -> None:
        with self._understanding(name):
            actual = parse_quantity(self._ask(name).text)
        if abs(actual - expected) > SAME * expected:
            raise CommandRefused(
                DEVICE, f"was given {name} {expected:g}, but keeps {actual:g} (SI units)", "connect to the pump again"
            )

    # ------------------------------------------------------------------ exchanges

    def _ask(self, command: str) -> Reply:
        """Send a command that may be repeated: after a touch of its screen the pump must be woken first."""
        try:
            return self._exchange(command)
        except NoReply:
            return self._exchange(command)

    def _exchange(self, command: str) -> Reply:
        with self._lock:
            if self._out_of_step:
                self._fall_into_step()
            with self._understanding(command):
                reply = parse_reply(self._receive(self._send(command)))
        if re.match(r"(Command|Argument) error", reply.text):
            words = " ".join(line.strip() for line in reply.lines)
            raise CommandRefused(DEVICE, f"refuses {command!r}: {words[:120]}", "look at the pump's screen")
        return reply

    @contextlib.contextmanager
    def _understanding(self, command: str) -> Iterator[None]:
        """Turn what cannot be understood into ``BadReply``."""
        try:
            yield
        except DeviceError:
            raise
        except ValueError as error:
            self._out_of_step = True
            raise BadReply(
                DEVICE, f"the reply to {command!r} makes no sense: {error}", "check cable and baud rate"
            ) from error

    def _send(self, *commands: str) -> Request:
        """Put commands on the wire and queue them for their replies; return the last one's request.

        The lock is held for this alone, so that a stop never waits for a reply.
        """
        requests = [Request(command) for command in commands]
        try:
            with self._writing:
                self._awaited.extend(requests)
                lines = (f"{self._prefix}{command}\r" if command else "\r" for command in commands)
                self._port.write("".join(lines).encode("ascii"))
        except OSError as error:
            raise self._lost(commands[-1], error) from error
        return requests[-1]

    def _receive(self, request: Request) -> bytes:
        """Read replies, each for the request it belongs to, until this one has its own."""
        deadline = time.monotonic() + self._timeout
        while request.reply is None:
            data = self._read(request.command, deadline)
            if self._awaited:
                self._awaited.popleft().reply = data
        return request.reply

    def _read(self, command: str, deadline: float) -> bytes:
        """Return the next bytes up to XON."""
        try:
            data: bytes = b"" if time.monotonic() > deadline else self._port.read_until(XON, LONGEST_REPLY)
        except OSError as error:
            raise self._lost(command, error) from error
        if not data.endswith(XON):
            self._out_of_step = True
            raise NoReply(
                DEVICE,
                f"no complete reply to {command.strip()!r} within {self._timeout:g} s on {self._connection}",
                CABLES,
            )
        return data

    def _lost(self, command: str, error: OSError) -> NotConnected:
        self._out_of_step = True
        return NotConnected(DEVICE, f"cannot exchange {command!r} with {self._connection}: {error}", CABLES)

    def _fall_into_step(self) -> None:
        """Wake the pump, switch its prompts to polling, and discard every late reply.

        The pump answers in order, and its version can be mistaken for nothing else: what comes before the last
        version asked for is stale. One that has been lost is not waited for longer than for any reply.
        """
        with self._writing:
            self._awaited.clear()
        try:
            # Not reset_input_buffer: on a lost terminal that raises termios.error, which is no OSError.
            for _ in range(LONGEST_REPLY):
                if not (waiting := self._port.in_waiting):
                    break
                self._port.read(waiting)
        except OSError as error:
            raise self._lost("ver", error) from error
        landmark = self._send("", "poll on", "ver")
        self._landmarks += 1
        deadline = time.monotonic() + self._timeout * (1 + self._landmarks)
        seen = 0
        while seen < self._landmarks:
            try:
                seen += self._is_version(self._read("ver", deadline))
            except NoReply:
                if not seen:
                    raise
                break
        self._landmarks = 0
        self._out_of_step = False
        # What another thread has sent since is still to be answered.
        with self._writing:
            while self._awaited and self._awaited.popleft() is not landmark:
                pass

    def _is_version(self, data: bytes) -> bool:
        text = data.decode("ascii", errors="replace")
        return self._version in text if self._version else bool(re.search(r"\d+\.\d+\.\d+", text))


class TcpPort(protocol_socket.Serial):
    """pyserial's TCP port without the 0.3 s it sleeps after closing."""

    def close(self) -> None:
        """Close the connection, also one that failed while it was being opened."""
        self.is_open = False
        if (connection := getattr(self, "_socket", None)) is not None:
            connection.close()


def open_port(connection: str, baud: int, timeout: float) -> serial.SerialBase:
    """Open ``socket://host:port`` or a serial device, for this program alone.

    Raises
    ------
    OSError
        It cannot be opened (``serial.SerialException`` is one).
    ValueError
        The name is malformed.
    """
    if connection.startswith("socket://"):
        port = TcpPort(timeout=timeout, write_timeout=timeout)
        port.port = connection
        try:
            port.open()
        except BaseException:
            port.close()
            raise
        return port
    return serial.Serial(connection, baud, timeout=timeout, write_timeout=timeout, exclusive=True)


def check_range(name: str, value: float, low: float, high: float, unit: str) -> None:
    """Raise ``OutOfRange`` unless ``low <= value <= high``."""
    if not low <= value <= high:
        raise OutOfRange(
            DEVICE, f"{name} {value:.6g} {unit} lies outside {low:.6g} .. {high:.6g} {unit}", f"correct the {name}"
        )
