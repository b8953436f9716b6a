"""What the pump driver says on the wire, byte by byte, and how it reads what comes back."""

import contextlib

import pytest
from dialogue import dialogue
from hypothesis import given, settings
from hypothesis import strategies as st
from links import Script, SerialWire

from drivers.errors import BadReply, CommandRefused, MotionFault, NoReply, OutOfRange, WrongDevice
from drivers.interfaces import PumpState
from drivers.pump import LegatoPump, Reply, format_quantity, parse_quantity, parse_reply

OK = b"\n:\x11"
WAKE = (b"\rpoll on\rver\r", b"\n:" + OK + b"\nLegato 210P 3.0.6\r\n:\x11")
LIMITS = b"\n25.0404 nl/min to 26.0035 ml/min\r\n:\x11"
CONNECT = [
    WAKE,
    (b"echo off\r", OK),
    (b"ver\r", b"\nLegato 210P 3.0.6\r\n:\x11"),
    (b"version\r", b"\nFirmware:      v3.0.6\r\nPump address:  0\r\nSerial number: D101754\r\n:\x11"),
    (b"stp\r", OK),
    (b"nvram off\r", OK),
    (b"load qs iw\r", b"\nQuick Start - Infuse/Withdraw (qs iw)\r\n:\x11"),
    (b"force 50\r", OK),
    (b"diameter 14.4300\r", OK),
    (b"diameter\r", b"\n14.4300 mm\r\n:\x11"),
    (b"cvolume\r", OK),
    (b"ctime\r", OK),
    (b"ctvolume\r", OK),
    (b"cttime\r", OK),
    (b"irate lim\r", LIMITS),
    (b"wrate lim\r", LIMITS),
]
START = [
    (b"stp\r", OK),
    (b"diameter\r", b"\n14.4300 mm\r\n:\x11"),
    (b"cwvolume\r", OK),
    (b"ctvolume\r", OK),
    (b"wrate 1.5 ml/min\r", OK),
    (b"tvolume 250 ul\r", OK),
    (b"wrate\r", b"\n1.5 ml/min\r\n:\x11"),
    (b"tvolume\r", b"\n250 ul\r\n:\x11"),
]
RUNNING = [*START, (b"wrun\r", b"\n<\x11")]


def open_pump(url, **options):
    settings = {"syringe_diameter": 14.43e-3, "force_percent": 50, "settle": 0.0, "reply_timeout": 60.0, **options}
    return LegatoPump(url, **settings)


@pytest.fixture
def talk():
    """Run a dialogue with a connected pump."""

    def run(exchanges, action, **options):
        with dialogue([*CONNECT, *exchanges]) as url:
            pump = open_pump(url, **options)
            try:
                return action(pump)
            finally:
                pump.close()

    return run


@pytest.fixture
def talk_past_silence(monkeypatch):
    """The same in virtual time, for replies that stay away."""

    def run(exchanges, action):
        script = Script([*CONNECT, *exchanges])
        wire = SerialWire(script, 0.5)
        monkeypatch.setattr("drivers.pump.open_port", lambda connection, baud, timeout: wire)
        monkeypatch.setattr("drivers.pump.time", wire)
        try:
            return action(open_pump("fake", reply_timeout=0.5))
        finally:
            script.check()

    return run


def withdraw(pump):
    pump.dispense(-250e-9, 25e-9)


def test_connection_stops_the_pump_and_applies_every_setting(talk):
    def look(pump):
        assert pump.identity.model == "Legato 210P"
        assert pump.identity.serial == "D101754"
        assert pump.identity.firmware == "v3.0.6"
        low, high = pump.rate_limits
        assert low == pytest.approx(25.0404e-12 / 60, rel=2e-3)
        assert high == pytest.approx(26.0035e-6 / 60, rel=2e-3)

    talk([], look)


def test_firmware_that_calls_it_nvram_none():
    refusal = (b"nvram off\r", b"\nArgument error: off\r\n   Invalid argument\r\n:\x11")
    with dialogue([*CONNECT[:5], refusal, (b"nvram none\r", OK), *CONNECT[6:]]) as url:
        open_pump(url).close()


def test_an_addressed_pump():
    def addressed(exchange):
        sent, reply = exchange
        lines = [b"02:" + line + b"\r\n" for line in reply[1:].split(b"\r\n")[:-1]]
        return b"02" + sent, b"\n" + b"".join(lines) + b"02:\x11"

    wake = (b"\r02poll on\r02ver\r", b"\n02:\n02:\x11\n02:Legato 210P 3.0.6\r\n02:\x11")
    with dialogue([wake, *map(addressed, CONNECT[1:])]) as url:
        pump = open_pump(url, address=2)
        assert pump.identity.model == "Legato 210P"
        pump.close()


@pytest.mark.parametrize("version", [b"11 ELITE I/W Single 3.0.4", b"PHD ULTRA 2.0.2"])
def test_another_pump_is_refused(version):
    reply = b"\n" + version + b"\r\n:\x11"
    exchanges = [(WAKE[0], OK + reply), CONNECT[1], (b"ver\r", reply), CONNECT[3]]
    with dialogue(exchanges) as url, pytest.raises(WrongDevice, match="expects 'Legato'"):
        open_pump(url)


def test_a_run_clears_the_counter_and_gives_the_pump_its_target(talk):
    talk(RUNNING, withdraw)


@pytest.mark.parametrize(
    ("reply", "state", "rate", "volume"),
    [
        (b"\n25000000 1000 100000000000 W...w.\r\n<\x11", PumpState.WITHDRAWING, -25e-12, -1e-7),
        (b"\n0 10000 250000000000 w...wT\r\nT*\x11", PumpState.TARGET_REACHED, 0, -2.5e-7),
        (b"\n0 500 1000000000 w.S.w.\r\n*\x11", PumpState.STALLED, 0, -1e-9),
        (b"\n0 500 1000000000 wW..w.\r\n<*\x11", PumpState.AT_LIMIT, 0, -1e-9),
        (b"\n0 0 0 i...i.\r\n:\x11", PumpState.IDLE, 0, 0),
        (b"\n0 0 0 i...i\r\n:\x11", PumpState.IDLE, 0, 0),
    ],
)
def test_status(talk, reply, state, rate, volume):
    def run(pump):
        withdraw(pump)
        return pump.status()

    status = talk([*RUNNING, (b"@status\r", reply)], run)
    assert status.state is state
    assert status.rate == pytest.approx(rate)
    assert status.volume == pytest.approx(volume)


def test_volumes_of_several_runs_add_up(talk):
    finished = (b"status\r", b"\n0 10000 250000000000 w...wT\r\nT*\x11")
    infusion = [(sent.replace(b"w", b"i"), reply) for sent, reply in START[2:]]
    exchanges = [
        *RUNNING,
        START[0],
        finished,
        START[1],
        *infusion,
        (b"irun\r", b"\n>\x11"),
        (b"@status\r", b"\n25000000 1000 100000000000 I...i.\r\n>\x11"),
    ]

    def run(pump):
        withdraw(pump)
        pump.dispense(250e-9, 25e-9)
        return pump.status()

    assert talk(exchanges, run).volume == pytest.approx(-1.5e-7)


def test_a_target_reached_too_early_is_a_fault(talk):
    early = (b"@status\r", b"\n0 10000 100000000000 w...wT\r\nT*\x11")

    def run(pump):
        withdraw(pump)
        with pytest.raises(MotionFault, match="after -100 of -250 ul"):
            pump.status()

    talk([*RUNNING, early], run)


def test_a_run_that_does_not_start_is_a_fault(talk):
    with pytest.raises(MotionFault, match="stalled"):
        talk([*START, (b"wrun\r", b"\n*\x11")], withdraw)


def test_a_setting_that_is_not_kept_is_refused(talk):
    other = (b"wrate\r", b"\n1.4 ml/min\r\n:\x11")
    with pytest.raises(CommandRefused, match="given wrate"):
        talk([*START[:6], other], withdraw)


def test_a_changed_diameter_is_a_fault(talk):
    with pytest.raises(MotionFault, match=r"syringe of 20 mm, the bench says 14\.43 mm"):
        talk([START[0], (b"diameter\r", b"\n20.0000 mm\r\n:\x11")], withdraw)


def test_an_error_text_is_passed_on(talk):
    refusal = (b"wrun\r", b"\nCommand error:\r\n   Not possible now\r\n:\x11")
    with pytest.raises(CommandRefused, match="refuses 'wrun': Command error: Not possible now"):
        talk([*START, refusal], withdraw)


@pytest.mark.parametrize(
    ("volume", "rate"),
    [(0.0, 1e-9), (float("nan"), 1e-9), (1e-9, 0.0), (1e-9, -1e-9), (1e-9, 1e-3), (1e-9, float("nan")), (2e-3, 1e-9)],
)
def test_impossible_runs_are_not_sent(talk, volume, rate):
    with pytest.raises(OutOfRange, match="lies outside"):
        talk([], lambda pump: pump.dispense(volume, rate))


@pytest.mark.parametrize(
    ("options", "name"),
    [({"syringe_diameter": 0.0}, "diameter"), ({"force_percent": 0}, "force"), ({"address": 100}, "address")],
)
def test_impossible_settings(options, name):
    with pytest.raises(OutOfRange, match=name):
        open_pump("socket://127.0.0.1:1", **options)


def test_stop_wakes_the_pump_and_is_confirmed_by_the_prompt(talk):
    talk([*RUNNING, (b"\rstp\r", b"\n<\x11\n:\x11")], lambda pump: (withdraw(pump), pump.stop()))


def test_a_pump_that_runs_on_is_reported(talk):
    exchanges = [(b"\rstp\r", b"\n<\x11\n<\x11"), WAKE, (b"stp\r", b"\n<\x11")]
    with pytest.raises(CommandRefused, match="told to stop, but is withdrawing"):
        talk(exchanges, LegatoPump.stop)


def test_a_question_is_repeated_once_behind_a_wake_up(talk_past_silence):
    exchanges = [(b"@status\r", b""), WAKE, (b"@status\r", b"\n0 0 0 i...i.\r\n:\x11")]
    assert talk_past_silence(exchanges, LegatoPump.status).state is PumpState.IDLE


def test_a_late_reply_is_discarded(talk_past_silence):
    late = b"\n9 9 9000000000 I...i.\r\n>\x11"
    exchanges = [(b"@status\r", b""), (WAKE[0], late + WAKE[1]), (b"@status\r", b"\n0 0 0 i...i.\r\n:\x11")]
    assert talk_past_silence(exchanges, LegatoPump.status).state is PumpState.IDLE


def test_a_start_is_never_repeated(talk_past_silence):
    with pytest.raises(NoReply, match="'wrun'"):
        talk_past_silence([*START, (b"wrun\r", b"")], withdraw)


@pytest.mark.parametrize(
    "reply", [b"\n1 2 I...i.\r\n:\x11", b"\n:\x11", b"\n-1 2 3 i...i.\r\n:\x11", b"\n1 2 3 i...i.\r\n\x11", b"\x11"]
)
def test_a_status_that_makes_no_sense_is_refused(talk, reply):
    with pytest.raises(BadReply, match="makes no sense"):
        talk([(b"@status\r", reply)], LegatoPump.status)


# ---------------------------------------------------------------- parsing


@pytest.mark.parametrize(
    ("data", "lines", "state"),
    [
        (b"\n:\x11", (), PumpState.IDLE),
        (b"\n>\x11", (), PumpState.INFUSING),
        (b"\nT*\x11", (), PumpState.TARGET_REACHED),
        (b"\n199.49 ul/min\r\n:\x11", ("199.49 ul/min",), PumpState.IDLE),
        (b"\n02:199.49 ul/min\r\n02:\x11", ("199.49 ul/min",), PumpState.IDLE),
        (b"\n00T*\x11", (), PumpState.TARGET_REACHED),
        (b"\nArgument error: 2\r\n   Target volume out of range\r\nT*\x11",
         ("Argument error: 2", "   Target volume out of range"), PumpState.TARGET_REACHED),
        (b"\n12<*\x11", (), PumpState.AT_LIMIT),
    ],
)  # fmt: skip
def test_replies(data, lines, state):
    assert parse_reply(data) == Reply(lines, state)


@settings(deadline=None)
@given(st.binary())
def test_any_bytes_are_a_reply_or_a_value_error(data):
    try:
        reply = parse_reply(data)
    except ValueError:
        return
    assert all(line.isprintable() for line in reply.lines)


@settings(deadline=None)
@given(st.text())
def test_any_text_is_a_quantity_or_a_value_error(text):
    with contextlib.suppress(ValueError):
        assert 0 <= parse_quantity(text) < float("inf")


@pytest.mark.parametrize(
    ("text", "value"),
    [("199.49 ul/min", 199.49e-9 / 60), ("1 ml/min", 1e-6 / 60), ("3 nl/hr", 3e-12 / 3600), ("1.69023 ul", 1.69023e-9)],
)
def test_quantities(text, value):
    assert parse_quantity(text) == pytest.approx(value)


@pytest.mark.parametrize(
    ("volume", "text"),
    [
        (1e-6, "1 ml"),
        (0.25e-6, "250 ul"),
        (2e-6 / 3, "666.666 ul"),
        (1e-9, "1 ul"),
        (123.4567891e-6, "123.456 ml"),
        (1e-12, "1 nl"),
        (1.23456e-16, "0.123 pl"),
    ],
)
def test_quantities_for_the_pump(volume, text):
    assert format_quantity(volume) == text


@settings(deadline=None)
@given(st.floats(1e-14, 1e-3))
def test_quantities_survive_the_way_to_the_pump_without_exponent(volume):
    below, above = format_quantity(volume), format_quantity(volume, up=True)
    assert "e" not in (below + above).casefold()
    assert parse_quantity(below) == pytest.approx(volume, rel=2e-5)
    assert parse_quantity(below) * (1 - 1e-11) <= volume <= parse_quantity(above) * (1 + 1e-11)
