"""The emulated controller, by its bytes and by PI's own client code."""

import itertools
import sys
import threading
import time
from unittest import mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from links import wait_until
from motion_world import MotionWorld

from drivers.emulated.server import LEAVING_PATIENCE, Line, serve_pty, serve_tcp
from drivers.emulated.stage import FAULTS, EmulatedController
from drivers.gateway import Gateway

PATIENCE = 60.0
"""Seconds for a reply that comes: a busy computer is no fault."""


class Host:
    """Talks to the controller without a wire."""

    def __init__(self, controller):
        self.controller = controller
        self._replies = []
        self._session = controller.connect(Line(self._replies.append))

    def send(self, *lines):
        for line in lines:
            self._session.receive(line if isinstance(line, bytes) else line.encode() + b"\n")

    def ask(self, line):
        self.send(line)
        reply = b"".join(self._replies)
        self._replies.clear()
        return reply.decode("latin-1")

    def error(self):
        return int(self.ask("ERR?"))

    def number(self, question):
        return float(self.ask(question).partition("=")[2])


@pytest.fixture
def world():
    return MotionWorld()


@pytest.fixture
def cold(world):
    """A controller as it is after power-up."""
    return Host(EmulatedController(world))


@pytest.fixture
def host(world):
    """A controller ready to move."""
    return Host(EmulatedController(world, referenced=True))


def test_powers_up_unreferenced_with_servo_off(cold):
    assert cold.ask("SVO?") == "1=0\n"
    assert cold.ask("FRF?") == "1=0\n"
    assert cold.number("POS?") == pytest.approx(0, abs=2e-4)
    cold.send("MOV 1 5")
    assert cold.error() == 5


def test_set_commands_are_silent_and_errors_are_read_once(host):
    assert host.ask("NIX 1") == ""
    assert host.ask(b"\x04") == "0x1100\n"
    assert [host.error(), host.error()] == [2, 0]


@pytest.mark.parametrize(("latch", "code"), [("first", 2), ("last", 23)])
def test_which_error_is_kept(world, latch, code):
    host = Host(EmulatedController(world, referenced=True, error_latch=latch))
    host.send("NIX", "MOV 3 1")
    assert host.error() == code


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("MOV 1 60", 7),
        ("MOV 1 -0.1", 7),
        ("MOV 2 1", 23),
        ("MOV 1", 24),
        ("MOV 1 abc", 25),
        ("MOV 1 nan", 25),
        ("VEL 1 1000", 8),
        ("VEL 1 0", 8),
        ("SVO 1 2", 17),
        ("SPA 1 0x999 1", 54),
        ("POS 1 3", 17),
        ("MOV 1 " + "1" * 300, 3),
    ],
)
def test_illegal_lines_do_nothing_but_set_their_error(host, world, line, code):
    host.send(line)
    assert host.error() == code
    assert not world.axis.moving


def test_multi_line_replies_end_with_space_and_line_feed_but_the_last(host):
    lines = host.ask("HLP?").split("\n")
    assert lines[-1] == ""
    assert all(line.endswith(" ") for line in lines[:-2])
    assert not lines[-2].endswith(" ")


def test_firmware_with_a_leading_nul(world):
    host = Host(EmulatedController(world, leading_nul=True))
    assert host.ask("HPA?").startswith("\0The following")


@pytest.mark.parametrize(
    ("line", "reply"), [("1 POS?", "0 1 1="), ("1 0 POS?", "0 1 1="), ("3 POS?", ""), ("255 POS?", "")]
)
def test_addressed_commands(host, line, reply):
    answer = host.ask(line)
    assert answer.startswith(reply)
    assert bool(answer) == bool(reply)


def test_trapezoidal_motion_with_status_bits(host, world):
    host.send("VEL 1 2", "ACC 1 10", "DEC 1 10", "MOV 1 24")
    assert host.ask(b"\x05") == "1\n"
    world.pass_time(0.1)
    assert host.number("POS?") == pytest.approx(22 + 10 * 0.1**2 / 2, abs=0.02)
    assert int(host.ask(b"\x04"), 16) & 0x2000
    assert host.ask("ONT?") == "1=0\n"
    world.pass_time(2.0)
    assert host.ask(b"\x05") == "0\n"
    assert host.number("POS?") == pytest.approx(24, abs=2e-4)
    assert host.ask("ONT?") == "1=0\n"
    world.pass_time(0.05)
    assert host.ask("ONT?") == "1=1\n"
    assert host.ask(b"\x04") == "0x9000\n"


def test_relative_moves_start_from_the_last_target(host, world):
    host.send("MOV 1 23", "MVR 1 0.5")
    world.pass_time(5)
    assert host.number("POS?") == pytest.approx(23.5, abs=2e-4)


def test_a_new_speed_acts_on_a_running_move(host, world):
    host.send("VEL 1 1", "MOV 1 30")
    world.pass_time(0.5)
    host.send("VEL 1 4")
    world.pass_time(0.5)
    assert world.axis.velocity == pytest.approx(4e-3)


def test_encoder_flickers_by_one_count_and_the_same_way_every_time(world, host):
    def readings():
        found = []
        for _ in range(40):
            found.append(host.number("POS?"))
            world.pass_time(0.01)
        return found

    counts = {round((value - 22) / 50e-6) for value in readings()}
    assert counts == {-1, 0, 1}
    twin = MotionWorld()
    other = Host(EmulatedController(twin, referenced=True))
    world.sample = twin.sample = 0
    assert host.ask("POS?") == other.ask("POS?")


@pytest.mark.parametrize(("command", "dead"), [("HLT 1", False), ("STP", True), (b"\x18", True)])
def test_stops_set_error_10_and_the_target_becomes_the_resting_place(host, world, command, dead):
    host.send("VEL 1 5", "DEC 1 50", "MOV 1 40")
    world.pass_time(1)
    before = world.axis.position
    host.send(command)
    world.pass_time(1)
    assert host.error() == 10
    travelled = world.axis.position - before
    assert travelled < 2e-5 if dead else 1e-4 < travelled < 1e-3
    assert host.number("MOV?") == pytest.approx(world.axis.position * 1e3, abs=1e-3)


def test_stop_byte_acts_in_the_middle_of_a_line(host, world):
    host.send("MOV 1 40", b"VEL \x181 3\n")
    assert not world.axis.moving
    assert host.error() == 10
    assert host.number("VEL?") == 3


def test_on_target_may_stay_down_after_a_stop(world):
    host = Host(EmulatedController(world, referenced=True, on_target_stuck=True))
    host.send("MOV 1 23", b"\x18", "ERR?")
    world.pass_time(1)
    host.ask("POS?")
    world.pass_time(1)
    assert host.ask("ONT?") == "1=0\n"


@pytest.mark.parametrize(("command", "end"), [("FRF", 26.0), ("FNL 1", 0.0), ("FPL", 52.0)])
def test_referencing_really_moves(cold, world, command, end):
    cold.send("SVO 1 1", command)
    assert cold.ask(b"\x07") == "\xb0\n"
    assert int(cold.ask(b"\x04"), 16) & 0x6000 == 0x6000
    cold.send("MOV 1 3")
    assert cold.error() == 53
    for _ in range(40):
        world.pass_time(0.5)
        cold.ask(b"\x04")
    assert cold.ask(b"\x07") == "\xb1\n"
    assert cold.ask("FRF?") == "1=1\n"
    assert cold.number("POS?") == pytest.approx(end, abs=2e-4)
    assert world.axis.position == pytest.approx(end * 1e-3, abs=1e-6)
    assert int(cold.ask(b"\x04"), 16) & 0b101 == 0


def test_declaring_a_position_references_without_motion(cold, world):
    cold.send("SVO 1 1", "RON 1 0", "POS 1 7")
    assert cold.error() == 0
    assert cold.ask("FRF?") == "1=1\n"
    assert cold.number("POS?") == pytest.approx(7, abs=2e-4)
    cold.send("MOV 1 8")
    world.pass_time(3)
    assert world.axis.position == pytest.approx(23e-3, abs=1e-6)


@pytest.mark.parametrize(("inverted", "idle", "pressed"), [(False, 0b000, 0b100), (True, 0b101, 0b001)])
def test_hard_limit_stops_the_motion_in_either_polarity(inverted, idle, pressed):
    world = MotionWorld()
    host = Host(EmulatedController(world, limit_bits_inverted=inverted))
    host.send("SVO 1 1", "RON 1 0", "POS 1 0")
    assert int(host.ask(b"\x04"), 16) & 0b101 == idle
    host.send("VEL 1 20", "MOV 1 40")
    for _ in range(400):
        world.pass_time(0.01)
        host.ask(b"\x04")
    assert int(host.ask(b"\x04"), 16) & 0b101 == pressed
    assert 52.5e-3 <= world.axis.position < 53e-3
    host.send("MOV 1 45")
    assert host.error() == 7
    host.send("MOV 1 20")
    assert host.error() == 0


def test_joystick_owns_the_axis(world):
    host = Host(EmulatedController(world, referenced=True, joystick=True))
    host.send("MOV 1 23")
    assert host.error() == 51


def test_reboot_forgets_and_is_deaf_for_a_while(world, monkeypatch):
    now = [5.0]
    monkeypatch.setattr("drivers.emulated.stage.time", mock.Mock(monotonic=lambda: now[0]))
    host = Host(EmulatedController(world, referenced=True, reboot_time=0.05))
    host.send("VEL 1 1", "RBT")
    assert host.ask("POS?") == ""
    now[0] += 0.06
    assert host.ask("FRF?") == "1=0\n"
    assert host.number("VEL?") == 5


def test_parameters_survive_a_reboot_only_if_written(world):
    host = Host(EmulatedController(world, reboot_time=0))
    host.send("SPA 1 0x49 2", "RBT")
    assert host.ask("SPA? 1 73") == "1 0x49=5.0000000\n"
    host.send("SPA 1 0x49 2", "WPA 100", "RBT")
    assert host.number("VEL?") == 2


def test_two_hosts_share_one_error_latch(host):
    second = Host(host.controller)
    host.send("NIX")
    assert [second.error(), host.error()] == [2, 0]


def test_every_fault_is_explained():
    assert set(FAULTS) >= {"silent", "slow", "unplugged", "garbage", "late", "error_code", "blocked", "limit_switch"}
    assert all(FAULTS.values())


def test_blocked_carriage_trips_the_servo(host, world):
    host.send("MOV 1 30")
    world.pass_time(0.5)
    world.fail("stage", "blocked")
    assert host.ask(b"\x04") == "0x0100\n"
    assert host.error() == -1024
    held = world.axis.position
    world.pass_time(1)
    assert world.axis.position == pytest.approx(held, abs=1e-5)


def test_lost_servo_stays_lost_while_the_fault_lasts(host, world):
    world.fail("stage", "servo_lost")
    host.send("SVO 1 1")
    assert host.ask("SVO?") == "1=0\n"
    world.faults.clear()
    host.send("SVO 1 1")
    assert host.ask("SVO?") == "1=1\n"


@pytest.mark.parametrize(("value", "bit"), [(-1.0, 0b001), (1.0, 0b100), (0.0, 0b100)])
def test_limit_switch_closes(host, world, value, bit):
    host.send("MOV 1 30")
    world.fail("stage", "limit_switch", value)
    assert int(host.ask(b"\x04"), 16) & 0b101 == bit
    assert not world.axis.moving


def test_error_code_is_latched_at_once_and_refuses_set_commands_but_no_stop(host, world):
    host.send("MOV 1 30")
    world.fail("stage", "error_code", 84)
    assert host.error() == 84
    host.send("MOV 1 40")
    assert host.error() == 84
    assert world.axis.target == pytest.approx(30e-3)
    host.send("HLT 1")
    assert host.error() == 10


def test_restart_happens_once_per_fault(host, world):
    world.fail("stage", "rebooted")
    assert host.ask("FRF?") == "1=0\n"
    host.send("SVO 1 1", "RON 1 0", "POS 1 22")
    assert host.ask("FRF?") == "1=1\n"
    world.faults.clear()
    host.ask("ERR?")
    world.fail("stage", "rebooted")
    assert host.ask("FRF?") == "1=0\n"


def test_silent_wire_still_obeys(host, world):
    world.fail("stage", "silent")
    assert host.ask("MOV?") == ""
    host.send("MOV 1 30")
    assert world.axis.moving


def test_late_replies_come_with_the_next_question(host, world):
    world.fail("stage", "late")
    assert host.ask("SVO?") == ""
    assert host.ask("FRF?") == "1=1\n"
    world.faults.clear()
    assert host.ask("CSV?") == "1=1\n2.0\n"


def test_garbage_differs_every_time(host, world):
    world.fail("stage", "garbage")
    replies = [host.ask("CSV?") for _ in range(8)]
    assert len(set(replies)) == 8
    assert all(reply != "2.0\n" for reply in replies)


def test_commands_are_counted(host):
    host.send("MOV 1 23", "mov 1 24", "NIX")
    host.ask(b"\x04")
    assert (host.controller.received["MOV"], host.controller.received["#4"]) == (2, 1)
    assert host.controller.received["unknown"] == 1


@settings(deadline=None)
@given(st.binary(max_size=200))
def test_no_bytes_upset_the_controller(data):
    host = Host(EmulatedController(MotionWorld(), referenced=True, reboot_time=0))
    host.ask(data)
    assert host.ask("\nCSV?").endswith("2.0\n")


LINES = st.lists(
    st.tuples(
        st.sampled_from(sorted(EmulatedController(MotionWorld())._commands)),
        st.lists(st.sampled_from(["1", "0", "2.5", "-3", "0x49", "1e400", "nan", "ALL", "ä"]), max_size=3),
    ),
    max_size=8,
)


@settings(deadline=None)
@given(LINES)
def test_no_sequence_of_commands_upsets_the_controller(lines):
    world = MotionWorld()
    host = Host(EmulatedController(world, referenced=True, reboot_time=0))
    for name, words in lines:
        host.ask(" ".join([name, *words]).encode("latin-1") + b"\n")
        world.pass_time(0.1)
    assert -1e-3 <= world.axis.target <= 53e-3
    assert host.ask("\nCSV?").endswith("2.0\n")


# ---------------------------------------------------------------- PI's own client


@pytest.fixture
def flowing(world):
    """Time passes by itself."""
    end = threading.Event()

    def flow():
        while not end.wait(1e-3):
            world.advance(20, 1000.0)

    thread = threading.Thread(target=flow)
    thread.start()
    yield world
    end.set()
    thread.join()


SERVERS = [serve_tcp, pytest.param(serve_pty, marks=pytest.mark.skipif(sys.platform == "win32", reason="POSIX"))]


@pytest.mark.parametrize("serve", SERVERS)
def test_pi_start_up_and_move_run_unmodified(flowing, serve):
    from pipython import pitools
    from pipython.pidevice.gcs2.gcs2commands import GCS2Commands
    from pipython.pidevice.gcsmessages import GCSMessages

    controller = EmulatedController(flowing)
    with serve(controller) as server:
        gateway = Gateway(server.url, 115200, PATIENCE)
        client = GCS2Commands(GCSMessages(gateway))
        pitools.startup(client, refmodes="FNL")
        pitools.moveandwait(client, "1", 10.0)
        assert client.qPOS("1")["1"] == pytest.approx(10.0, abs=1e-3)
        assert client.qSPA("1", 0x15) == {"1": {0x15: 52.0}}
        assert client.IsMoving("1") == {"1": False}
        assert client.qCST("1") == {"1": "LPS-65.2IN"}
        assert "MOV" in client.funcs
        gateway.close()
    assert {"FNL", "MOV", "#7", "#24", "HLP?", "HPA?", "ONT?"} <= set(controller.received)


def test_pi_socket_gateway_connects_too(flowing):
    from pipython.pidevice.gcs2.gcs2commands import GCS2Commands
    from pipython.pidevice.gcsmessages import GCSMessages
    from pipython.pidevice.interfaces.pisocket import PISocket

    with serve_tcp(EmulatedController(flowing, referenced=True)) as server:
        host, port = server.url.removeprefix("socket://").split(":")
        with PISocket(host, int(port)) as gateway:
            assert "C-863.12" in GCS2Commands(GCSMessages(gateway)).qIDN()


# ---------------------------------------------------------------- the server


def test_a_second_host_is_turned_away(world):
    with serve_tcp(EmulatedController(world)) as server:
        first = Gateway(server.url, 0, PATIENCE)
        second = Gateway(server.url, 0, PATIENCE)
        with pytest.raises(OSError, match=r"closed|reset|aborted|Broken pipe"):
            ask(second, "CSV?\n")
        assert ask(first, "CSV?\n") == "2.0\n"
        first.close()
        second.close()
        for _ in itertools.repeat(None, 5):
            again = Gateway(server.url, 0, PATIENCE)
            assert ask(again, "CSV?\n") == "2.0\n"
            again.close()


@pytest.mark.skipif(sys.platform == "win32", reason="there a busy computer may turn it away")
def test_a_host_is_served_however_long_the_one_before_takes_to_leave(world, monkeypatch):
    def close(line):
        time.sleep(2 * LEAVING_PATIENCE)

    monkeypatch.setattr(Line, "close", close)
    with serve_tcp(EmulatedController(world)) as server:
        for _ in range(2):
            gateway = Gateway(server.url, 0, PATIENCE)
            assert ask(gateway, "CSV?\n") == "2.0\n"
            gateway.close()


def test_several_hosts_if_asked_for(world):
    with serve_tcp(EmulatedController(world), hosts_at_once=2) as server:
        gateways = [Gateway(server.url, 0, PATIENCE) for _ in range(2)]
        assert [ask(gateway, "CSV?\n") for gateway in gateways] == ["2.0\n", "2.0\n"]
        for gateway in gateways:
            gateway.close()


def test_unplugged_cable_ends_the_connection_and_refuses_others(world):
    with serve_tcp(EmulatedController(world)) as server:
        gateway = Gateway(server.url, 0, PATIENCE)
        ask(gateway, "CSV?\n")
        world.fail("stage", "unplugged")
        for _ in range(2):
            with pytest.raises(OSError, match=r"closed|reset|aborted|Broken pipe"):
                ask(gateway, "CSV?\n")
            gateway.close()
            gateway = Gateway(server.url, 0, PATIENCE)
        gateway.close()
        world.faults.clear()
        gateway = Gateway(server.url, 0, PATIENCE)
        assert ask(gateway, "CSV?\n") == "2.0\n"
        gateway.close()


def test_a_host_that_dies_leaves_the_last_command_running(world):
    with serve_tcp(EmulatedController(world, referenced=True)) as server:
        gateway = Gateway(server.url, 0, PATIENCE)
        gateway.send("MOV 1 23\n")
        assert ask(gateway, "MOV?\n") == "1=23.0000000\n"
        gateway.close()
        world.pass_time(5)
        assert world.axis.position == pytest.approx(23e-3)


def test_delayed_replies_keep_their_order(world):
    with serve_tcp(EmulatedController(world, referenced=True, latency=0.02), fragment=1) as server:
        gateway = Gateway(server.url, 0, PATIENCE)
        gateway.send("CSV?\nSVO?\n")
        text = ""
        while text.count("\n") < 2:
            text += gateway.read()
        assert text == "2.0\n1=1\n"
        gateway.close()


def test_delayed_replies_do_not_delay_the_stop_byte(world):
    with serve_tcp(EmulatedController(world, referenced=True, latency=3600.0)) as server:
        gateway = Gateway(server.url, 0, PATIENCE)
        gateway.send("MOV 1 40\nCSV?\n")
        wait_until(lambda: world.axis.moving)
        gateway.send_urgent(b"\x18")
        wait_until(lambda: not world.axis.moving)
        gateway.close()


def ask(gateway, question):
    gateway.send(question)
    text = gateway.read()
    while not text.endswith("\n"):
        text += gateway.read()
    return text
