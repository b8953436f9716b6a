"""An emulated KD Scientific Legato 210P syringe pump, answering its command set byte by byte.

Sources: KD Scientific Legato 200 series manual (commands, prompts, status p. 65); recorded traffic of a Legato 100
with firmware 3.0.6. A command is executed when its bytes arrive; only the reply may be delayed.
"""

from __future__ import annotations

import math
import re
import time
from collections import Counter
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

from drivers.emulated.server import WIRE_FAULTS, FaultyWire, Line
from drivers.emulated.world import World

FAULTS: Mapping[str, str] = MappingProxyType(
    {
        **WIRE_FAULTS,
        "error": "every command but stop is refused",
        "stalled": "the pusher is held: the motor stops at once",
        "target_early": "the pump stops as if it had reached its target, after this fraction of it (default: at once)",
        "touched": "somebody touched the screen: deaf until a bare CR",
        "wrong_syringe": "another diameter was entered at the screen (mm, default 20), and stays",
        "restarted": "power came back after a cut: stopped, settings as stored",
    }
)

XON = b"\x11"
SLOWEST, FASTEST = 0.18e-6 / 60, 190.8e-3 / 60
"""Speed of the pusher block, m/s."""
STRONGEST = 334.0
"""Force at 100 %, N (75 lb)."""
LIQUID = {"m": 1e-6, "u": 1e-9, "n": 1e-12, "p": 1e-15}
SECONDS = {"h": 3600.0, "m": 60.0, "s": 1.0}
INFUSE, WITHDRAW = 1, -1
FEMTOLITRE = 1e-18


class Refused(Exception):
    """A command the pump answers with an error, in its two lines."""

    def __init__(self, *lines: str) -> None:
        self.lines = lines
        super().__init__(*lines)


def command_error(text: str) -> Refused:
    """Return the error for a command that is unknown or not possible now."""
    return Refused("Command error:", f"   {text}")


def argument_error(word: str, text: str = "Out of range") -> Refused:
    """Return the error for an argument."""
    return Refused(f"Argument error: {word}", f"   {text}")


class Reply(NamedTuple):
    """Lines of text and the prompt that follows them; ``address`` only if the command had one."""

    lines: tuple[str, ...]
    prompt: str
    address: int | None = None

    def encode(self, own_address: int) -> bytes:
        """Return the bytes: LF, lines with their prefix and CR LF, and the prompt without line end."""
        address = own_address if self.address is None else self.address
        tagged = address != 0 or self.address is not None
        prefix = f"{address:02d}:" if tagged else ""
        prompt = f"{address:02d}{self.prompt}" if tagged else self.prompt
        return ("\n" + "".join(f"{prefix}{line}\r\n" for line in self.lines) + prompt).encode("ascii", errors="replace")


class Family(NamedTuple):
    """What differs between the relatives that share this command set."""

    version: str
    switch_reply: Mapping[str, str]
    ticks_per_second: float
    flags: int


FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        "Legato": Family("Legato 210P 3.0.6", {"echo": "{}", "poll": "{}"}, 1e3, 6),
        "Elite": Family("11 ELITE I/W Single 3.0.4", {"echo": "Echo is {}", "poll": "Polling mode is {}"}, 56e6, 6),
        "PHD Ultra": Family("PHD ULTRA 2.0.2", {"echo": "{}", "poll": "{}"}, 1.0, 5),
    }
)

Arguments = list[str]
Handler = Callable[[Arguments], "tuple[str, ...]"]


class EmulatedLegato:
    """The pump.

    Parameters
    ----------
    world
        The plant; its syringe is the one in the pump.
    address
        Pump address, 0 to 99.
    latency
        Delay of every reply, s of real time.
    load_time
        Seconds of real time that ``load`` needs after its prompt.
    capacity, fill
        What the syringe holds at most and at power-up, m^3: its ends are the travel limits.
    family
        Whose texts and units the replies have.
    nvram_words
        Words that the command ``nvram`` accepts; firmwares differ.
    quick_start
        Whether the Quick Start method is loaded at power-up.
    resume_on_power_loss
        Whether a run goes on after a power cut.
    seed
        Chooses the random bytes of wire faults.

    Attributes
    ----------
    received : Counter
        How often each command has been received.
    nvram_writes : int
        How often a setting has been written to the memory that wears out.
    """

    def __init__(
        self,
        world: World,
        *,
        address: int = 0,
        latency: float = 0.0,
        load_time: float = 0.0,
        capacity: float = 60e-6,
        fill: float = 30e-6,
        family: Literal["Legato", "Elite", "PHD Ultra"] = "Legato",
        nvram_words: tuple[str, str] = ("off", "on"),
        quick_start: bool = False,
        resume_on_power_loss: bool = False,
        seed: int = 0,
    ) -> None:
        self.received: Counter[str] = Counter()
        self.nvram_writes = 0
        self._world = world
        self._wire = FaultyWire(world.faults, "pump", latency, seed)
        self._load_time = load_time
        self._capacity = capacity
        self._fill = fill
        self._family = FAMILIES[family]
        self._nvram_words = nvram_words
        self._resume = resume_on_power_loss
        self._stored: dict[str, object] = {
            "address": address,
            "diameter": 14.43e-3,
            "irate": 1e-6 / 60,
            "wrate": 1e-6 / 60,
            "force": 50,
            "directions": "iw" if quick_start else "",
        }
        self._commands = self._command_table()
        self._touched = False
        with world.lock:
            self._origin = world.syringe.volume
            self._power_up()

    def connect(self, line: Line) -> LegatoSession:
        """Begin a session with a host."""
        self._wire.check_plugged()
        return LegatoSession(self, line, self._wire)

    @property
    def polled(self) -> bool:
        """Whether ``poll on`` is set: no prompts unasked, XON after every prompt."""
        return self._poll == "ON"

    @property
    def echoes(self) -> bool:
        """Whether commands come back."""
        return self._echo == "ON"

    @property
    def address(self) -> int:
        """The pump's address."""
        return self._address

    # ------------------------------------------------------------------ what arrives

    def execute(self, text: str) -> Reply | None:
        """Act on a command (without its CR) and return the reply; ``None`` if the pump does not answer."""
        with self._world.lock:
            self._catch_up()
            match = re.match(r"\s*(\d*):?@?(.*)", text, re.DOTALL)
            assert match is not None
            address = int(match[1]) if match[1] else None
            if self._touched:
                self._touched = bool(text.strip())
                if self._touched:
                    return None
            if address is not None and address != self._address:
                return None
            self._announced = self._prompt
            try:
                lines = self._execute(match[2].casefold().split())
            except Refused as refusal:
                lines = refusal.lines
            self._announced = self._prompt
            return Reply(lines, self._prompt, address)

    def unasked(self) -> Reply | None:
        """Return the prompt that a run's end brings up, once, while polling is off."""
        with self._world.lock:
            self._catch_up()
            if self.polled or self._touched or not self._ended or self._prompt == self._announced:
                return None
            self._announced = self._prompt
            return Reply((), self._prompt)

    def cut_power(self) -> None:
        """Switch the pump off and on again."""
        with self._world.lock:
            self._account()
            direction = self._running
            self._power_up()
            if self._resume and direction:
                self._run(direction)

    def _execute(self, words: list[str]) -> tuple[str, ...]:
        if not words:
            return ()
        name = self._full_name(words[0])
        self.received[name or "unknown"] += 1
        if name is None:
            raise command_error("Unknown command")
        if self._wire.fault("error") and name not in ("stop", "stp"):
            raise command_error("Not possible now")
        if name in GATED and not (self._directions and time.monotonic() >= self._ready_at):
            raise command_error("Command not allowed in this method")
        return self._commands[name](words[1:])

    def _full_name(self, word: str) -> str | None:
        """Commands may be cut, but not below four letters."""
        if word in self._commands:
            return word
        if len(word) < 4:
            return None
        return next((name for name in self._commands if name.startswith(word)), None)

    # ------------------------------------------------------------------ state

    def _power_up(self) -> None:
        self._world.syringe.stop()
        self._address = int(str(self._stored["address"]))
        self._diameter = float(str(self._stored["diameter"]))
        self._rates = {INFUSE: float(str(self._stored["irate"])), WITHDRAW: float(str(self._stored["wrate"]))}
        self._force = int(str(self._stored["force"]))
        self._directions = str(self._stored["directions"])
        self._echo, self._poll, self._nvram = "OFF", "OFF", True
        self._target_volume: float | None = None
        self._target_time: float | None = None
        self._volumes = {INFUSE: 0.0, WITHDRAW: 0.0}
        self._times = {INFUSE: 0.0, WITHDRAW: 0.0}
        self._running = 0
        self._direction = INFUSE
        self._ending = ""
        self._ended = ""
        self._run_target = math.inf
        self._run_volume = 0.0
        self._touched = False
        self._ready_at = -math.inf
        self._announced = ":"
        self._screen = 100
        self._counted = self._world.syringe.volume
        self._world.syringe.set_diameter(self._diameter)

    def _store(self, name: str, value: object) -> None:
        """Settings go to the memory that wears out, unless the host has switched that off."""
        if self._nvram:
            self._stored[name] = value
            self.nvram_writes += 1

    @property
    def _prompt(self) -> str:
        if self._running:
            return ">" if self._running == INFUSE else "<"
        limit = ">*" if self._direction == INFUSE else "<*"
        return {"stalled": "*", "target": "T*", "limit": limit}.get(self._ended, ":")

    def _catch_up(self) -> None:
        """Let happen what has happened since the last command: faults, stall, the end of a run."""
        if self._wire.fault_begins("restarted"):
            self.cut_power()
        if self._wire.fault_begins("touched"):
            self._touched = True
        if fault := self._wire.fault_begins("wrong_syringe"):
            self._set_diameter((fault.value or 20.0) * 1e-3)
        self._account()
        if not self._running:
            return
        resistance = abs(self._world.syringe.force_on_plunger)
        early = self._wire.fault("target_early")
        if self._wire.fault("stalled") or resistance > STRONGEST * self._force / 100:
            self._end("stalled")
        elif early and self._run_volume >= early.value * self._run_target:
            self._end("target")
        elif self._world.syringe.rate == 0.0:
            self._end(self._ending)

    def _account(self) -> None:
        """Count what has been displaced since the last look."""
        volume = self._world.syringe.volume
        displaced, self._counted = volume - self._counted, volume
        if displaced:
            direction = INFUSE if displaced > 0 else WITHDRAW
            self._volumes[direction] += abs(displaced)
            self._run_volume += abs(displaced)
            self._times[direction] += abs(displaced) / self._rates[direction]

    def _end(self, reason: str) -> None:
        self._world.syringe.stop()
        self._running = 0
        self._ended = reason

    def _run(self, direction: int) -> None:
        """Run until target volume, target time or the end of the syringe, whichever comes first."""
        self._account()
        rate = self._rates[direction]
        position = self._world.syringe.volume - self._origin
        ends = {"limit": self._fill - position if direction == INFUSE else self._capacity - self._fill + position}
        if self._target_volume is not None:
            ends["target"] = self._target_volume - self._volumes[direction]
        elif self._target_time is not None:
            ends["target"] = (self._target_time - self._times[direction]) * rate
        self._ending = min(ends, key=lambda reason: ends[reason])
        remaining = ends[self._ending]
        if self._ending == "limit" and remaining < FEMTOLITRE:
            self._direction, self._ended = direction, "limit"
            raise command_error("Limit switch is active")
        self._direction, self._running, self._ended = direction, direction, ""
        self._run_target, self._run_volume = ends.get("target", math.inf), 0.0
        if remaining < FEMTOLITRE:
            self._end("target")
            return
        self._world.syringe.run(direction * rate, remaining)

    # ------------------------------------------------------------------ commands

    def _command_table(self) -> dict[str, Handler]:
        table: dict[str, Handler] = {
            "ver": lambda _: (self._family.version,),
            "version": self._version,
            "address": self._address_command,
            "baud": lambda _: ("115200",),
            "echo": self._switch("echo"),
            "poll": self._switch("poll"),
            "nvram": self._nvram_command,
            "dim": self._dim,
            "force": self._force_command,
            "time": lambda _: ("01/01/26 12:00:00 AM",),
            "metrics": self._metrics,
            "cat": lambda _: ("Quick Start",),
            "config": lambda _: ("Twin syringe, infuse/withdraw",),
            "load": self._load,
            "run": lambda _: self._start(self._direction),
            "irun": lambda _: self._start(INFUSE),
            "wrun": lambda _: self._start(WITHDRAW),
            "rrun": lambda _: self._start(-self._direction),
            "stop": self._stop,
            "stp": self._stop,
            "irate": lambda words: self._rate(INFUSE, words),
            "wrate": lambda words: self._rate(WITHDRAW, words),
            "crate": self._current_rate,
            "diameter": self._diameter_command,
            "svolume": lambda _: (liquid(self._capacity),),
            "ivolume": lambda _: (liquid(self._volumes[INFUSE]),),
            "wvolume": lambda _: (liquid(self._volumes[WITHDRAW]),),
            "tvolume": self._target_volume_command,
            "civolume": lambda _: self._clear(self._volumes, INFUSE),
            "cwvolume": lambda _: self._clear(self._volumes, WITHDRAW),
            "cvolume": lambda _: self._clear(self._volumes, INFUSE, WITHDRAW),
            "ctvolume": self._clear_target,
            "itime": lambda _: (duration(self._times[INFUSE]),),
            "wtime": lambda _: (duration(self._times[WITHDRAW]),),
            "ttime": self._target_time_command,
            "citime": lambda _: self._clear(self._times, INFUSE),
            "cwtime": lambda _: self._clear(self._times, WITHDRAW),
            "ctime": lambda _: self._clear(self._times, INFUSE, WITHDRAW),
            "cttime": self._clear_target,
            "iramp": lambda _: ("Ramp not set up.",),
            "wramp": lambda _: ("Ramp not set up.",),
            "input": lambda _: ("Low.",),
            "output": lambda _: (),
            "status": self._status,
        }
        return table

    def _version(self, words: Arguments) -> tuple[str, ...]:
        del words
        return ("Firmware:      v3.0.6", f"Pump address:  {self._address}", "Serial number: EMULATED")

    def _address_command(self, words: Arguments) -> tuple[str, ...]:
        if not words:
            return (f"Pump address is {self._address}",)
        if not words[0].isdecimal() or int(words[0]) > 99:
            raise argument_error(words[0])
        self._address = int(words[0])
        self._store("address", self._address)
        return (f"Pump address set to {self._address}",)

    def _switch(self, name: Literal["echo", "poll"]) -> Handler:
        attribute = f"_{name}"
        allowed = ("on", "off", "remote") if name == "poll" else ("on", "off")

        def command(words: Arguments) -> tuple[str, ...]:
            if not words:
                return (self._family.switch_reply[name].format(getattr(self, attribute)),)
            if words[0] not in allowed:
                raise argument_error(words[0], "Invalid argument")
            setattr(self, attribute, words[0].upper())
            return ()

        return command

    def _nvram_command(self, words: Arguments) -> tuple[str, ...]:
        if not words:
            return ("ON" if self._nvram else "OFF",)
        if words[0] not in self._nvram_words:
            raise argument_error(words[0], "Invalid argument")
        self._nvram = words[0] == "on"
        return ()

    def _dim(self, words: Arguments) -> tuple[str, ...]:
        if not words:
            return (f"{self._screen}%",)
        self._screen = round(self._number(words[0], 0, 100))
        return ()

    def _force_command(self, words: Arguments) -> tuple[str, ...]:
        if not words:
            return (f"{self._force}%",)
        self._force = round(self._number(words[0], 1, 100))
        self._store("force", self._force)
        return ()

    def _metrics(self, words: Arguments) -> tuple[str, ...]:
        del words
        return (
            f"Pump type:            {self._family.version}",
            "Pump type string:     Twin syringe, infuse/withdraw",
            "Command set:          Ultra",
            "Steps per rev:        400",
            "Microsteps:           16",
            "Gear ratio:           2.4:1",
            "Lead screw:           24 tpi",
            "Force range:          20%-80%",
            "Direction port:       Yes",
            "Infuse limit switch:  Yes",
            "Withdraw limit switch: Yes",
        )

    def _load(self, words: Arguments) -> tuple[str, ...]:
        if not words:
            return (f"Quick Start ({self._directions or 'none'})",)
        if words[0] != "qs" or len(words) != 2 or words[1] not in ("i", "w", "iw", "wi"):
            raise argument_error(words[-1], "Unknown method")
        self._forbid_while_running()
        self._directions = words[1]
        self._ready_at = time.monotonic() + self._load_time
        self._store("directions", self._directions)
        name = {"i": "Infuse Only", "w": "Withdraw Only", "iw": "Infuse/Withdraw", "wi": "Withdraw/Infuse"}[words[1]]
        return (f"Quick Start - {name} (qs {words[1]})",)

    def _forbid_while_running(self) -> None:
        if self._running:
            raise command_error("Not possible while the pump is running")

    def _number(self, word: str, low: float, high: float) -> float:
        try:
            value = float(word)
        except ValueError:
            raise argument_error(word, "Not a number") from None
        # The firmware knows no exponents.
        if not re.fullmatch(r"[+-]?\d*\.?\d*", word):
            raise argument_error(word, "Not a number")
        if not low <= value <= high:
            raise argument_error(word)
        return value

    def _limits(self) -> tuple[float, float]:
        area = math.pi / 4 * self._diameter**2
        return SLOWEST * area, FASTEST * area

    def _rate(self, direction: int, words: Arguments) -> tuple[str, ...]:
        low, high = self._limits()
        if not words:
            return (f"{liquid(self._rates[direction] * 60)}/min",)
        if words == ["lim"]:
            return (f"{liquid(low * 60)}/min to {liquid(high * 60)}/min",)
        rate = {"max": high, "min": low}.get(words[0]) or self._given_rate(words)
        if not low <= rate <= high:
            raise argument_error(words[0])
        self._account()
        self._rates[direction] = rate
        self._store("irate" if direction == INFUSE else "wrate", rate)
        if self._running == direction:
            target, done = self._run_target, self._run_volume
            self._run(direction)
            self._run_target, self._run_volume = target, done
        return ()

    def _given_rate(self, words: Arguments) -> float:
        if len(words) != 2 or words[1].count("/") != 1:
            raise argument_error(words[-1], "Unknown units")
        volume_unit, time_unit = words[1].split("/")
        value = self._number(words[0], 0, math.inf)
        try:
            return value * LIQUID[volume_unit[:1]] / SECONDS[time_unit[:1]]
        except KeyError:
            raise argument_error(words[1], "Unknown units") from None

    def _current_rate(self, words: Arguments) -> tuple[str, ...]:
        del words
        if not self._running:
            raise command_error("Pump is not running")
        verb = "Infusing" if self._running == INFUSE else "Withdrawing"
        return (f"{verb} at {liquid(self._rates[self._running] * 60)}/min",)

    def _diameter_command(self, words: Arguments) -> tuple[str, ...]:
        if not words:
            return (f"{self._diameter * 1e3:.4f} mm",)
        self._forbid_while_running()
        diameter = self._number(words[0], 0.1, 50) * 1e-3
        if not self._wire.fault("wrong_syringe"):
            self._set_diameter(diameter)
        return ()

    def _set_diameter(self, diameter: float) -> None:
        """Tell the motor the new diameter and bring the rates into its range."""
        self._account()
        self._diameter = diameter
        self._world.syringe.set_diameter(diameter)
        low, high = self._limits()
        self._rates = {direction: min(max(rate, low), high) for direction, rate in self._rates.items()}
        self._store("diameter", diameter)

    def _target_volume_command(self, words: Arguments) -> tuple[str, ...]:
        if not words:
            return ("Target volume not set" if self._target_volume is None else liquid(self._target_volume),)
        if len(words) != 2 or words[1][:1] not in LIQUID:
            raise argument_error(words[-1], "Unknown units")
        volume = self._number(words[0], 0, math.inf) * LIQUID[words[1][0]]
        if not 1e-15 <= volume <= 1e-3:
            raise argument_error(words[0], "Target volume out of range")
        self._target_volume, self._target_time = volume, None
        return ()

    def _target_time_command(self, words: Arguments) -> tuple[str, ...]:
        if not words:
            return ("Target time not set" if self._target_time is None else duration(self._target_time),)
        self._target_volume, self._target_time = None, self._number(words[0], 1e-3, 1e6)
        return ()

    def _clear_target(self, words: Arguments) -> tuple[str, ...]:
        del words
        self._target_volume = self._target_time = None
        self._forget_end()
        return ()

    def _clear(self, counters: dict[int, float], *directions: int) -> tuple[str, ...]:
        for direction in directions:
            counters[direction] = 0.0
        self._forget_end()
        return ()

    def _forget_end(self) -> None:
        if self._ended == "target":
            self._ended = ""

    def _start(self, direction: int) -> tuple[str, ...]:
        if ("i" if direction == INFUSE else "w") not in self._directions:
            raise command_error("Direction not allowed in this method")
        if self._running != direction:
            self._run(direction)
        return ()

    def _stop(self, words: Arguments) -> tuple[str, ...]:
        del words
        if self._running:
            self._end("")
        return ()

    def _status(self, words: Arguments) -> tuple[str, ...]:
        del words
        direction = self._running or self._direction
        rate = self._rates[direction] if self._running else 0.0
        letter = "i" if direction == INFUSE else "w"
        flags = "".join(
            (
                letter.upper() if self._running else letter,
                letter if self._ended == "limit" else ".",
                "S" if self._ended == "stalled" else ".",
                ".",
                letter,
                "T" if self._ended == "target" else ".",
            )
        )
        numbers = (
            rate / FEMTOLITRE,
            self._times[direction] * self._family.ticks_per_second,
            self._volumes[direction] / FEMTOLITRE,
        )
        return (" ".join(f"{number:.0f}" for number in numbers) + f" {flags[: self._family.flags]}",)


GATED = frozenset(
    f"{prefix}{quantity}"
    for quantity, prefixes in {
        "rate": ("i", "w", "c"),
        "ramp": ("i", "w"),
        "diameter": ("",),
        "volume": ("s", "i", "w", "t", "ci", "cw", "c", "ct"),
        "time": ("i", "w", "t", "ci", "cw", "c", "ct"),
    }.items()
    for prefix in prefixes
)
"""Commands that need the Quick Start method."""


class LegatoSession:
    """The bytes of one host: commands end with CR, LF is overlooked."""

    def __init__(self, pump: EmulatedLegato, line: Line, wire: FaultyWire) -> None:
        self._pump = pump
        self._line = line
        self._wire = wire
        self._text = bytearray()

    @property
    def watch_interval(self) -> float | None:
        """With polling off the pump speaks unasked."""
        return None if self._pump.polled else 0.05

    def receive(self, data: bytes) -> None:
        """Act on bytes from the host."""
        self._wire.check_plugged()
        for byte in data:
            if self._pump.echoes:
                self._line.send(bytes([byte]))
            if byte == 0x0D:
                text = self._text.decode("latin-1")
                self._text.clear()
                self.watch()
                self._say(self._pump.execute(text))
            elif byte != 0x0A and len(self._text) < 256:
                self._text.append(byte)

    def watch(self) -> None:
        """Send the prompt of a run that has ended, if polling is off."""
        self._say(self._pump.unasked())

    def _say(self, reply: Reply | None) -> None:
        if reply is not None:
            self._wire.deliver(reply.encode(self._pump.address) + (XON if self._pump.polled else b""), self._line)


def liquid(volume: float) -> str:
    """Write a volume (m^3) as the pump does: six digits and the unit that suits."""
    for letter, unit in LIQUID.items():
        if volume >= unit or letter == "p":
            break
    return f"{volume / unit:.6g} {letter}l" if volume >= FEMTOLITRE else "0 ul"


def duration(seconds: float) -> str:
    """Write a time as the pump does."""
    if seconds < 60:
        return f"{seconds:.6g} seconds"
    whole = round(seconds)
    return f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d}"
