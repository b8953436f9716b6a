"""The pump driver against the emulated pump, over TCP and a pseudo-terminal, and against nonsense."""

import contextlib
import threading

import pytest
from dialogue import flood
from hypothesis import given, settings
from hypothesis import strategies as st
from links import PTY, TERMINALS, BabblingPort, SerialWire, believed, outcomes, stopping, wait_until
from motion_world import MotionWorld

import drivers.pump
from drivers.emulated.pump import EmulatedLegato
from drivers.emulated.server import serve_pty, serve_tcp
from drivers.emulated.stage import EmulatedController
from drivers.errors import BadReply, CommandRefused, DeviceError, MotionFault, NoReply, NotConnected, WrongDevice
from drivers.interfaces import PumpState
from drivers.pump import LegatoPump

PATIENCE = 60.0
"""Seconds for a reply that comes: a busy computer is no fault."""


def connect(url, **options):
    settings = {"syringe_diameter": 14.43e-3, "force_percent": 50, "settle": 0.0, "reply_timeout": PATIENCE, **options}
    return LegatoPump(url, **settings)


@pytest.fixture
def world():
    return MotionWorld()


@pytest.fixture
def legato(world):
    return EmulatedLegato(world)


@pytest.fixture
def server(legato):
    with serve_tcp(legato) as server:
        yield server


@pytest.fixture
def pump(server):
    pump = connect(server.url)
    yield pump
    pump.close()


@pytest.fixture
def virtual(legato, monkeypatch):
    """Return a pump in virtual time, for replies that stay away."""
    wire = SerialWire(legato, 0.2)
    monkeypatch.setattr("drivers.pump.open_port", lambda connection, baud, timeout: wire)
    monkeypatch.setattr("drivers.pump.time", wire)
    return connect("fake", reply_timeout=0.2)


@pytest.mark.parametrize("serve", [serve_tcp, PTY])
@pytest.mark.parametrize("fragment", [None, 1])
def test_runs_there_and_back(world, legato, serve, fragment):
    with serve(legato, fragment=fragment) as server:
        pump = connect(server.url, clock=lambda: world.time)
        assert pump.status().state is PumpState.IDLE
        pump.dispense(-300e-9, 100e-9)
        world.pass_time(1)
        status = pump.status()
        assert (status.state, status.sent) == (PumpState.WITHDRAWING, world.time)
        assert status.rate == pytest.approx(-100e-9)
        assert status.volume == pytest.approx(-100e-9)
        world.pass_time(3)
        assert pump.status().state is PumpState.TARGET_REACHED
        pump.dispense(200e-9, 100e-9)
        world.pass_time(1)
        assert pump.status().volume == pytest.approx(-200e-9)
        world.pass_time(2)
        status = pump.status()
        assert (status.state, status.rate) == (PumpState.TARGET_REACHED, 0)
        assert status.volume == world.syringe.volume == pytest.approx(-100e-9)
        pump.close()


def test_a_run_replaces_one_that_is_under_way(pump, world):
    pump.dispense(300e-9, 100e-9)
    world.pass_time(1)
    pump.dispense(-50e-9, 50e-9)
    world.pass_time(5)
    assert pump.status().volume == pytest.approx(50e-9)


def test_volume_counts_from_the_connection(pump, server, world):
    pump.dispense(100e-9, 100e-9)
    world.pass_time(2)
    pump.close()
    again = connect(server.url)
    assert again.status().volume == 0
    again.close()


def test_connecting_stops_a_pump_that_runs(world, legato, server):
    legato.execute("load qs iw")
    legato.execute("irun")
    assert world.syringe.rate
    connect(server.url).close()
    assert not world.syringe.rate


def test_nothing_is_written_to_the_memory_that_wears_out(pump, legato, world):
    for volume in (1e-9, -2e-9, 3e-9):
        pump.dispense(volume, 10e-9)
        world.pass_time(1)
        pump.status()
    assert legato.nvram_writes == 0


def test_firmware_that_knows_nvram_none_only(world):
    legato = EmulatedLegato(world, nvram_words=("none", "on"))
    with serve_tcp(legato) as server:
        connect(server.url).close()
    assert legato.nvram_writes == 0


def test_a_pump_left_echoing_and_unpolled(world, legato, server):
    legato.execute("echo on")
    pump = connect(server.url)
    assert pump.status().state is PumpState.IDLE
    assert not legato.echoes
    pump.close()


def test_an_addressed_pump(world):
    with serve_tcp(EmulatedLegato(world, address=7)) as server:
        pump = connect(server.url, address=7)
        assert pump.status().state is PumpState.IDLE
        pump.close()
        with pytest.raises(NoReply):
            connect(server.url, address=8, reply_timeout=0.05)


def test_rates_reach_to_both_limits(pump, world):
    for rate in pump.rate_limits:
        pump.dispense(1e-9, rate)
        assert pump.status().rate == pytest.approx(rate, rel=1e-4)


def test_every_rate_between_the_limits_is_accepted(pump):
    low, high = pump.rate_limits
    for step in range(40):
        pump.dispense(-123.456789e-9, low * (high / low) ** (step / 39))


def test_stop(pump, world):
    pump.dispense(300e-9, 100e-9)
    world.pass_time(1)
    pump.stop()
    assert not world.syringe.rate
    status = pump.status()
    assert (status.state, status.rate) == (PumpState.IDLE, 0)
    assert status.volume == pytest.approx(100e-9)


def test_stop_does_not_queue_behind_a_transaction_that_waits(world, legato, server):
    pump = connect(server.url)
    pump.dispense(1e-6, 100e-9)
    world.fail("pump", "slow", 30)

    def wait():
        with contextlib.suppress(DeviceError):
            pump.status()

    waiting = threading.Thread(target=wait)
    waiting.start()
    wait_until(lambda: legato.received["status"] > 0)
    stopping = threading.Thread(target=wait_for_stop, args=(pump,))
    stopping.start()
    wait_until(lambda: not world.syringe.rate)
    assert waiting.is_alive()
    world.fail("pump", "unplugged")
    pump._port.write(b"\r")
    waiting.join()
    stopping.join()
    pump.close()


def wait_for_stop(pump):
    with contextlib.suppress(DeviceError):
        pump.stop()


def test_stops_from_another_thread_never_mix_up_replies(pump, world):
    with stopping(pump.stop) as done:
        while not done.is_set():
            low, high = pump._read_limits()
            assert low < high
            assert pump.status().state is PumpState.IDLE
    assert not pump._awaited


def test_stall(pump, world):
    pump.dispense(300e-9, 100e-9)
    world.fail("pump", "stalled")
    assert pump.status().state is PumpState.STALLED
    pump.dispense(300e-9, 100e-9)
    assert pump.status().state is PumpState.STALLED
    assert world.syringe.volume == 0
    world.faults.clear()
    pump.dispense(300e-9, 100e-9)
    assert pump.status().state is PumpState.INFUSING


def test_end_of_the_syringe(world):
    with serve_tcp(EmulatedLegato(world, capacity=2e-6, fill=1e-6)) as server:
        pump = connect(server.url)
        pump.dispense(1.5e-6, 500e-9)
        world.pass_time(5)
        assert pump.status().state is PumpState.AT_LIMIT
        with pytest.raises(CommandRefused, match="Limit switch"):
            pump.dispense(1e-6, 500e-9)
        pump.dispense(-1e-6, 500e-9)
        pump.close()


def test_the_stage_on_the_pumps_port(world):
    with serve_tcp(EmulatedController(world)) as server, pytest.raises((NoReply, WrongDevice), match="'ver'"):
        connect(server.url, reply_timeout=0.05)


def test_another_pump(world):
    with serve_tcp(EmulatedLegato(world, family="Elite")) as server, pytest.raises(WrongDevice, match="ELITE"):
        connect(server.url)


@pytest.mark.parametrize("name", ["socket://127.0.0.1:1", "socket://", "socket://x:y", "/dev/nowhere", ""])
def test_impossible_ports(name):
    with pytest.raises(NotConnected, match=r"cannot open .* Remedy"):
        connect(name)


def test_a_second_program_is_refused(pump, server):
    with pytest.raises((NotConnected, NoReply)):
        connect(server.url)
    assert pump.status().state is PumpState.IDLE


@TERMINALS
def test_a_second_program_on_the_serial_port_is_refused(legato):
    with serve_pty(legato) as server:
        pump = connect(server.url)
        with pytest.raises(NotConnected, match="exclusively lock"):
            connect(server.url)
        pump.close()


def test_closing_twice_and_using_it_afterwards(pump):
    pump.close()
    pump.close()
    for call in (pump.status, pump.stop):
        with pytest.raises(NotConnected):
            call()


# ---------------------------------------------------------------- faults


@pytest.mark.parametrize(
    ("kind", "value", "error"),
    [
        ("silent", 0, NoReply),
        ("slow", 1.0, NoReply),
        ("late", 0, NoReply),
        ("garbage", 0, (BadReply, NoReply)),
        ("unplugged", 0, NotConnected),
        ("error", 0, CommandRefused),
        ("target_early", 0, MotionFault),
    ],
)
def test_every_fault_becomes_one_clear_error(virtual, world, kind, value, error):
    pump = virtual
    pump.dispense(300e-9, 100e-9)
    world.pass_time(0.5)
    world.fail("pump", kind, value)
    with pytest.raises(error, match=r"^pump: .+ Remedy: .+"):
        pump.status()


@pytest.mark.parametrize("kind", ["error", "target_early", "touched", "stalled", "wrong_syringe", "late", "restarted"])
def test_stop_works_whatever_ails_the_pump(virtual, world, kind):
    pump = virtual
    pump.dispense(300e-9, 100e-9)
    world.pass_time(0.5)
    world.fail("pump", kind)
    with contextlib.suppress(NoReply):
        pump.stop()
    assert not world.syringe.rate


@pytest.mark.parametrize("kind", ["silent", "slow", "garbage"])
def test_stop_reaches_a_pump_whose_replies_go_astray(virtual, world, kind):
    pump = virtual
    pump.dispense(300e-9, 100e-9)
    world.fail("pump", kind)
    with contextlib.suppress(NoReply, BadReply):
        pump.stop()
    assert not world.syringe.rate


def test_a_touched_screen_is_overcome(virtual, world):
    pump = virtual
    pump.dispense(300e-9, 100e-9)
    world.fail("pump", "touched")
    assert pump.status().state is PumpState.INFUSING


def test_a_diameter_changed_at_the_screen_is_noticed_before_the_next_run(virtual, world):
    pump = virtual
    world.fail("pump", "wrong_syringe", 10.0)
    with pytest.raises(MotionFault, match="10 mm"):
        pump.dispense(300e-9, 100e-9)
    assert not world.syringe.rate


def test_a_diameter_that_cannot_be_set_is_noticed_on_connection(world, server):
    world.fail("pump", "wrong_syringe", 10.0)
    with pytest.raises(MotionFault, match="10 mm"):
        connect(server.url)


@pytest.mark.usefixtures("virtual")
def test_a_pump_that_has_restarted_is_not_run_with_the_settings_it_woke_up_with(world):
    pump = connect("fake", syringe_diameter=10e-3, reply_timeout=0.2)
    world.fail("pump", "restarted")
    with pytest.raises(DeviceError):
        pump.dispense(300e-9, 100e-9)
    assert not world.syringe.rate


@pytest.mark.parametrize("kind", ["silent", "slow", "late", "garbage"])
def test_no_stale_reply_is_ever_believed(virtual, world, kind):
    pump = virtual
    pump.dispense(10e-6, 100e-9)

    def poll():
        world.pass_time(0.1)
        return pump.status()

    volumes = 0
    for status in believed(poll, lambda: world.fail("pump", kind, 0.25), world.faults, last=4):
        volumes += 1
        assert status.volume == pytest.approx(world.syringe.volume, rel=1e-6)
    assert volumes >= 5


# ---------------------------------------------------------------- nonsense


class BabblingPump(BabblingPort):
    """Read as pyserial reads."""

    def read_until(self, expected, size):
        data, found, self._pending = self._pending.partition(expected)
        return (data + found)[:size]

    @property
    def in_waiting(self):
        return len(self._pending)

    def read(self, size):
        data, self._pending = self._pending[:size], self._pending[size:]
        return data


OK = b"\n:\x11"
VERSION = b"\nLegato 210P 3.0.6\r\n:\x11"
LIMITS = b"\n25.0404 nl/min to 26.0035 ml/min\r\n:\x11"
GOOD_START = [b"\n:" + OK + VERSION, OK, VERSION, b"\nFirmware: v3\r\n:\x11", *[OK] * 5, b"\n14.4300 mm\r\n:\x11"]
GOOD_START += [*[OK] * 4, LIMITS, LIMITS]
PLAUSIBLE = st.sampled_from(
    [
        OK,
        VERSION,
        LIMITS,
        b"\n>\x11",
        b"\n*\x11",
        b"\nT*\x11",
        b"\n14.4300 mm\r\n:\x11",
        b"\n1 2 3 I...i.\r\n>\x11",
        b"\n1 2 3 w...wT\r\nT*\x11",
        b"\n6 ml/min\r\n:\x11",
        b"\n100 ul\r\n:\x11",
        b"\nCommand error:\r\n   x\r\n:\x11",
    ]
)
FRAMED = st.binary(max_size=30).map(lambda data: b"\n" + data + b"\r\n:\x11")
REPLIES = st.lists(st.one_of(PLAUSIBLE, FRAMED, st.binary(max_size=30)), max_size=40)
CALLS = (
    LegatoPump.status,
    LegatoPump.stop,
    lambda pump: pump.dispense(100e-9, 100e-9),
    lambda pump: pump.dispense(-100e-9, 100e-9),
)


def babble(replies):
    patch = pytest.MonkeyPatch()
    with patch.context() as context:
        context.setattr(drivers.pump, "open_port", lambda connection, baud, timeout: BabblingPump(replies))
        return connect("fake")


@pytest.mark.parametrize("data", [b"\x00\xff" * 500, b"\n:\x11" * 100, b"x" * 999, b"\n1.2.3\r\n:\x11" * 50])
def test_a_device_that_babbles_without_end(data):
    with flood(data) as url, pytest.raises(DeviceError):
        connect(url, reply_timeout=0.05)


@settings(deadline=None)
@given(REPLIES)
def test_connecting_to_nonsense_is_a_device_error(replies):
    with pytest.raises(DeviceError):
        babble(replies)


@settings(max_examples=200, deadline=None)
@given(REPLIES, st.lists(st.sampled_from(CALLS), max_size=8))
def test_nonsense_in_operation_is_a_device_error_or_a_finite_volume(replies, calls):
    pump = babble(GOOD_START + replies)
    for call, result in outcomes(pump, "pump", calls):
        if call is LegatoPump.status:
            assert abs(result.volume) < float("inf")


# ---------------------------------------------------------------- a lost character


@pytest.mark.parametrize("digit", range(9))
def test_a_volume_that_has_lost_a_digit_is_asked_again(virtual, world, monkeypatch, digit):
    """Whichever digit it is, the number is ten times smaller: a stroke taken up again would go that much too far."""
    pump = virtual
    pump.dispense(0.5e-6, 0.1e-6)
    for _ in range(3):
        world.pass_time(1.0)
        before = pump.status().volume
    hurt, read = [], pump._port.read_until

    def garbled(expected, size):
        data = read(expected, size)
        words = data.split(b" ")
        if len(words) == 4 and not hurt:
            hurt.append(data)
            words[2] = words[2][:digit] + words[2][digit + 1 :]
        return b" ".join(words)

    monkeypatch.setattr(pump._port, "read_until", garbled)
    world.pass_time(0.1)
    assert pump.status().volume > before
    assert hurt
    pump.stop()
    hurt.clear()
    pump.dispense(-0.1e-6, 0.1e-6)
    assert hurt
    world.pass_time(2.0)
    assert pump.status().volume == pytest.approx(0.31e-6 - 0.1e-6, rel=1e-3)


@pytest.mark.parametrize("volume", [0.1e-6, -0.1e-6])
def test_a_pump_that_runs_the_wrong_way_is_stopped(virtual, world, monkeypatch, volume):
    pump = virtual
    pump.dispense(-volume / 10, 0.1e-6)
    world.pass_time(1.0)
    write = pump._port.write
    monkeypatch.setattr(pump._port, "write", lambda data: write(data.replace(b"irun", b"run").replace(b"wrun", b"run")))
    try:
        pump.dispense(volume, 0.1e-6)
    except MotionFault as error:
        assert "does not start: it is" in str(error)
        assert world.syringe.rate == 0
    else:
        assert world.syringe.rate * volume > 0
