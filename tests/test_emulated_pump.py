"""The emulated pump, by its bytes."""

import sys
from unittest import mock

import pytest
import serial
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_world import MotionWorld

from drivers.emulated.pump import FAULTS, EmulatedLegato
from drivers.emulated.server import Line, serve_pty, serve_tcp


class Host:
    """Talks to the pump without a wire."""

    def __init__(self, pump):
        self.pump = pump
        self._replies = []
        self.session = pump.connect(Line(self._replies.append))

    def ask(self, *commands):
        """Send commands and return the bytes that come back."""
        for command in commands:
            self.session.receive(command.encode("latin-1") + b"\r")
        return self.heard()

    def heard(self):
        reply = b"".join(self._replies)
        self._replies.clear()
        return reply


@pytest.fixture
def world():
    return MotionWorld()


@pytest.fixture
def host(world):
    """A pump in Quick Start that is polled and has a rate of 1 ml/min both ways."""
    host = Host(EmulatedLegato(world))
    host.ask("poll on", "load qs iw", "irate 1 ml/min", "wrate 1 ml/min")
    return host


def test_prompts_have_no_line_end_and_xon_only_when_polled(world):
    host = Host(EmulatedLegato(world))
    assert host.ask("") == b"\n:"
    assert host.ask("poll") == b"\nOFF\r\n:"
    assert host.ask("poll on") == b"\n:\x11"
    assert host.ask("poll") == b"\nON\r\n:\x11"
    assert host.ask("irun") == b"\nCommand error:\r\n   Direction not allowed in this method\r\n:\x11"


def test_recorded_dialogue(host):
    assert host.ask("diameter 14.43") == b"\n:\x11"
    assert host.ask("@irate 199.49 ul/min") == b"\n:\x11"
    assert host.ask("@irate") == b"\n199.49 ul/min\r\n:\x11"
    assert host.ask("@irun") == b"\n>\x11"
    assert host.ask("@stp") == b"\n:\x11"
    assert host.ask("@wrun") == b"\n<\x11"


@pytest.mark.parametrize("command", ["DIAM", "diameter", "@diam", "0diameter", "00@Diame", "diameter\n", " diameter "])
def test_ways_to_write_a_command(host, command):
    assert b"14.4300 mm\r\n" in host.ask(command)


@pytest.mark.parametrize("command", ["dia", "nix", "diameterx"])
def test_unknown_commands(host, command):
    assert host.ask(command) == b"\nCommand error:\r\n   Unknown command\r\n:\x11"


def test_addresses(host):
    assert host.ask("00irate") == b"\n00:1 ml/min\r\n00:\x11"
    assert host.ask("address 2") == b"\n02:Pump address set to 2\r\n02:\x11"
    assert host.ask("irate") == b"\n02:1 ml/min\r\n02:\x11"
    assert host.ask("3irate") == b""
    assert host.ask("02:irate") == b"\n02:1 ml/min\r\n02:\x11"


def test_echo(host):
    host.ask("echo on")
    assert host.ask("irate") == b"irate\r\n1 ml/min\r\n:\x11"


def test_quick_start_gate(world):
    host = Host(EmulatedLegato(world))
    for command in ("irate 1 ml/min", "diameter 10", "tvolume 1 ml", "civolume"):
        assert b"Command error" in host.ask(command)
    assert b"Legato 210P" in host.ask("ver")
    assert b"(qs iw)" in host.ask("load qs iw")
    assert host.ask("irate 1 ml/min") == b"\n:"


def test_loading_takes_its_time(world, monkeypatch):
    now = [5.0]
    monkeypatch.setattr("drivers.emulated.pump.time", mock.Mock(monotonic=lambda: now[0]))
    host = Host(EmulatedLegato(world, load_time=0.05))
    host.ask("load qs iw")
    assert b"Command error" in host.ask("irate")
    now[0] += 0.06
    assert b"l/min" in host.ask("irate")


def test_only_the_loaded_direction(host):
    host.ask("load qs i")
    assert host.ask("irun") == b"\n>\x11"
    host.ask("stop")
    assert b"Command error" in host.ask("wrun")


def test_rate_limits_follow_the_diameter(host):
    def limits():
        low, high = host.ask("irate lim").split(b"\r\n")[0].split(b" to ")
        return low.strip(), high

    host.ask("diameter 14.43")
    assert limits() == (b"29.4371 nl/min", b"31.2033 ml/min")
    host.ask("diameter 4.61")
    low, high = limits()
    assert low.endswith(b"nl/min")
    assert float(high.split()[0]) == pytest.approx(31.2033 * (4.61 / 14.43) ** 2, rel=1e-4)
    assert host.ask("irate 4 ml/min") == b"\nArgument error: 4\r\n   Out of range\r\n:\x11"
    host.ask("irate max")
    assert host.ask("irate").strip(b"\n").split(b"\r")[0] == high


@pytest.mark.parametrize(
    ("command", "text"),
    [
        ("irate 1e-3 ml/min", b"Not a number"),
        ("irate abc ml/min", b"Not a number"),
        ("irate 1 furlong", b"Unknown units"),
        ("irate 1", b"Unknown units"),
        ("tvolume 0 ml", b"Target volume out of range"),
        ("tvolume 5 kg", b"Unknown units"),
        ("diameter 99", b"Out of range"),
        ("force 101", b"Out of range"),
        ("load qs x", b"Unknown method"),
        ("poll maybe", b"Invalid argument"),
        ("nvram none", b"Invalid argument"),
    ],
)
def test_bad_arguments(host, command, text):
    reply = host.ask(command)
    assert reply.startswith(b"\nArgument error: ")
    assert text in reply


@pytest.mark.parametrize(
    ("rate", "shown"), [("2000 ul/m", b"2 ml/min"), ("6 ml/h", b"100 ul/min"), ("1 n/s", b"60 nl/min")]
)
def test_units_are_chosen_by_the_pump(host, rate, shown):
    host.ask(f"irate {rate}")
    assert host.ask("irate") == b"\n" + shown + b"\r\n:\x11"


def test_a_run_ends_at_its_target(host, world):
    host.ask("tvolume 100 ul", "irun")
    world.pass_time(3)
    assert host.ask("status") == b"\n16666666667 3000 50000000000 I...i.\r\n>\x11"
    world.pass_time(4)
    assert host.ask("status") == b"\n0 6000 100000000000 i...iT\r\nT*\x11"
    assert world.syringe.volume == pytest.approx(100e-9)
    assert host.ask("ivolume") == b"\n100 ul\r\nT*\x11"
    assert host.ask("itime") == b"\n6 seconds\r\nT*\x11"
    assert host.ask("civolume") == b"\n:\x11"


def test_without_clearing_the_counter_the_next_run_ends_at_once(host, world):
    host.ask("tvolume 100 ul", "irun")
    world.pass_time(7)
    assert host.ask("irun") == b"\nT*\x11"
    host.ask("civolume")
    assert host.ask("irun") == b"\n>\x11"


def test_counters_go_by_direction(host, world):
    host.ask("irun")
    world.pass_time(6)
    host.ask("stop", "wrun")
    world.pass_time(3)
    assert host.ask("ivolume") == b"\n100 ul\r\n<\x11"
    assert host.ask("wvolume") == b"\n50 ul\r\n<\x11"
    assert world.syringe.volume == pytest.approx(50e-9)
    host.ask("cvolume")
    assert host.ask("wvolume") == b"\n0 ul\r\n<\x11"


def test_target_time(host, world):
    host.ask("ttime 3", "irun")
    world.pass_time(5)
    assert host.ask("ivolume") == b"\n50 ul\r\nT*\x11"


def test_a_new_rate_acts_at_once_and_the_target_stays(host, world):
    host.ask("tvolume 100 ul", "irun")
    world.pass_time(3)
    assert host.ask("irate 2 ml/min") == b"\n>\x11"
    assert host.ask("crate") == b"\nInfusing at 2 ml/min\r\n>\x11"
    world.pass_time(2)
    assert host.ask("") == b"\nT*\x11"
    assert world.syringe.volume == pytest.approx(100e-9)


def test_end_of_the_syringe(world):
    host = Host(EmulatedLegato(world, capacity=2e-6, fill=1e-6, quick_start=True))
    host.ask("poll on", "irate 10 ml/min", "irun")
    world.pass_time(10)
    assert host.ask("status").endswith(b"ii..i.\r\n>*\x11")
    assert b"Limit switch" in host.ask("irun")
    assert host.ask("wrun") == b"\n<\x11"


def test_stall_by_force(host, world):
    host.ask("force 1", "irun")
    world.pressure = 50e3
    assert host.ask("") == b"\n*\x11"
    assert b"S" in host.ask("status")
    world.pressure = 0.0
    assert host.ask("irun") == b"\n>\x11"


def test_unasked_prompts_with_polling_off(world):
    host = Host(EmulatedLegato(world, quick_start=True))
    host.ask("irate 1 ml/min", "tvolume 10 ul", "irun")
    host.session.watch()
    assert host.heard() == b""
    world.pass_time(1)
    host.session.watch()
    host.session.watch()
    assert host.heard() == b"\nT*"
    host.ask("civolume", "irun")
    world.pass_time(1)
    assert host.ask("ver") == b"\nT*\nLegato 210P 3.0.6\r\nT*"


def test_memory_that_wears_out_is_counted(host):
    before = host.pump.nvram_writes
    host.ask("irate 2 ml/min")
    assert host.pump.nvram_writes == before + 1
    host.ask("nvram off", "irate 3 ml/min", "diameter 10")
    assert host.pump.nvram_writes == before + 1


def test_power_cut_reverts_to_what_was_stored(host, world):
    host.ask("nvram off", "diameter 10", "irun")
    host.pump.cut_power()
    assert not world.syringe.rate
    assert host.ask("diameter") == b"\n14.4300 mm\r\n:"
    assert host.ask("poll") == b"\nOFF\r\n:"


def test_run_resumed_after_a_power_cut(world):
    host = Host(EmulatedLegato(world, quick_start=True, resume_on_power_loss=True))
    host.ask("irate 1 ml/min", "irun")
    host.pump.cut_power()
    assert host.ask("") == b"\n>"


@pytest.mark.parametrize(("family", "time"), [("Legato", b"3000"), ("Elite", b"168000000"), ("PHD Ultra", b"3")])
def test_relatives_count_time_differently(world, family, time):
    host = Host(EmulatedLegato(world, family=family, quick_start=True))
    host.ask("irate 1 ml/min", "irun")
    world.pass_time(3)
    assert host.ask("status").split()[1] == time


# ---------------------------------------------------------------- faults


def test_every_fault_is_explained():
    assert {"silent", "slow", "unplugged", "garbage", "late", "error", "stalled"} <= set(FAULTS)
    assert all(FAULTS.values())


def test_held_pusher(host, world):
    host.ask("irun")
    world.fail("pump", "stalled")
    assert host.ask("") == b"\n*\x11"
    assert host.ask("irun", "") == b"\n>\x11\n*\x11"


def test_target_reached_early(host, world):
    world.fail("pump", "target_early", 0.25)
    host.ask("tvolume 100 ul", "irun")
    world.pass_time(1)
    assert host.ask("") == b"\n>\x11"
    world.pass_time(1)
    assert host.ask("") == b"\nT*\x11"
    assert world.syringe.volume < 40e-9


def test_touched_screen_needs_a_bare_return(host, world):
    world.fail("pump", "touched")
    assert host.ask("irate") == b""
    assert host.ask("", "irate") == b"\n:\x11\n1 ml/min\r\n:\x11"


def test_wrong_syringe_entered_at_the_screen(host, world):
    world.fail("pump", "wrong_syringe", 10.0)
    host.ask("diameter 14.43")
    assert host.ask("diameter") == b"\n10.0000 mm\r\n:\x11"
    host.ask("tvolume 10 ul", "irun")
    world.pass_time(1)
    assert world.syringe.volume == pytest.approx(10e-9)
    assert world.syringe.delivered_at(world.time) == pytest.approx(10e-9 * 1.443**2)


def test_refusals_leave_stop_alone(host, world):
    host.ask("irun")
    world.fail("pump", "error")
    assert b"Command error" in host.ask("status")
    assert host.ask("stp") == b"\n:\x11"


def test_restart(host, world):
    host.ask("irun")
    world.fail("pump", "restarted")
    assert host.ask("") == b"\n:"
    assert not world.syringe.rate


@settings(deadline=None)
@given(st.binary(max_size=100))
def test_no_bytes_upset_the_pump(data):
    host = Host(EmulatedLegato(MotionWorld()))
    host.session.receive(data)
    assert b"Legato" in host.ask("", "ver")


COMMANDS = st.lists(
    st.tuples(
        st.sampled_from(sorted(EmulatedLegato(MotionWorld())._commands)),
        st.lists(
            st.sampled_from(["on", "off", "1", "0", "2.5", "-3", "ml/min", "ul", "lim", "max", "qs", "iw", "1e9", "é"]),
            max_size=3,
        ),
    ),
    max_size=10,
)


@settings(deadline=None)
@given(COMMANDS)
def test_no_sequence_of_commands_upsets_the_pump(commands):
    world = MotionWorld()
    host = Host(EmulatedLegato(world, quick_start=True))
    for name, words in commands:
        host.ask(" ".join([name, *words]))
        world.pass_time(0.1)
    assert host.ask("ver")
    assert abs(world.syringe.volume) <= 30.001e-6


# ---------------------------------------------------------------- over a wire, by pyserial alone


@pytest.mark.parametrize(
    "serve", [serve_tcp, pytest.param(serve_pty, marks=pytest.mark.skipif(sys.platform == "win32", reason="POSIX"))]
)
@pytest.mark.parametrize("fragment", [None, 1])
def test_pyserial_reads_until_xon(world, serve, fragment):
    with serve(EmulatedLegato(world), fragment=fragment) as server:
        port = serial.serial_for_url(server.url, timeout=60)
        port.write(b"poll on\rver\r")
        assert port.read_until(b"\x11") == b"\n:\x11"
        assert port.read_until(b"\x11") == b"\nLegato 210P 3.0.6\r\n:\x11"
        port.close()


def test_unasked_prompt_comes_by_itself(world):
    with serve_tcp(EmulatedLegato(world, quick_start=True)) as server:
        port = serial.serial_for_url(server.url, timeout=60)
        port.write(b"irate 1 ml/min\rtvolume 1 ul\rirun\r")
        assert port.read_until(b">") == b"\n:\n:\n>"
        world.pass_time(1)
        assert port.read_until(b"*") == b"\nT*"
        port.close()
