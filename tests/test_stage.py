"""The stage driver against the emulated controller, over TCP and a pseudo-terminal, and against nonsense."""

import contextlib
import threading
from unittest import mock

import pytest
from dialogue import flood
from hypothesis import given, settings
from hypothesis import strategies as st
from links import PTY, TERMINALS, BabblingPort, GatewayWire, believed, outcomes, stopping, wait_until
from motion_world import MotionWorld

import drivers.gateway
from drivers.emulated.server import serve_pty, serve_tcp
from drivers.emulated.stage import EmulatedController
from drivers.errors import (
    BadReply,
    CommandRefused,
    DeviceError,
    MotionFault,
    NoReply,
    NotConnected,
    OutOfRange,
    WrongDevice,
)
from drivers.stage import PIStage

PATIENCE = 60.0
"""Seconds for a reply that comes: a busy computer is no fault."""


def patient(url, **options):
    return PIStage(url, reply_timeout=PATIENCE, **options)


@pytest.fixture
def world():
    return MotionWorld()


@pytest.fixture
def controller(world):
    return EmulatedController(world, referenced=True)


@pytest.fixture
def server(controller):
    with serve_tcp(controller) as server:
        yield server


@pytest.fixture
def stage(server):
    stage = patient(server.url)
    yield stage
    stage.close()


@pytest.fixture
def virtual(controller, monkeypatch):
    """A stage in virtual time, for replies that stay away."""
    wire = GatewayWire(controller)
    monkeypatch.setattr("drivers.gateway.open_port", lambda connection, baud: wire)
    monkeypatch.setattr("drivers.gateway.time", wire)
    return PIStage("fake", reply_timeout=0.2)


@pytest.mark.parametrize("serve", [serve_tcp, PTY])
@pytest.mark.parametrize("fragment", [None, 1])
def test_a_move_from_start_to_end(world, controller, serve, fragment):
    with serve(controller, fragment=fragment) as server:
        stage = patient(server.url, clock=lambda: world.time)
        stage.set_speed(2e-3)
        stage.move_to(24e-3)
        world.pass_time(0.5)
        assert stage.status().moving
        world.pass_time(2)
        stage.status()
        world.pass_time(0.1)
        status = stage.status()
        assert (status.moving, status.on_target, status.servo_on) == (False, True, True)
        assert status.position == pytest.approx(24e-3, abs=1e-7)
        assert status.sent == status.received == world.time
        stage.close()


def test_look_ahead_extends_a_running_move(stage, world):
    stage.set_speed(100e-6)
    for _ in range(50):
        stage.move_to(stage.status().position - 50e-6)
        world.pass_time(0.02)
    assert world.axis.velocity == pytest.approx(-100e-6)
    world.pass_time(10)
    assert stage.status().position == pytest.approx(22e-3 - 100e-6 - 50e-6, abs=5e-6)


def test_from_outside_the_travel_the_axis_may_come_back_and_go_no_further(server, world):
    stage = patient(server.url, minimum=10e-3, maximum=20e-3)
    with pytest.raises(OutOfRange):
        stage.move_to(21e-3)  # nobody has asked where it is
    assert stage.status().position == pytest.approx(22e-3)
    stage.move_to(21e-3)
    for target in (22.1e-3, 9e-3):
        with pytest.raises(OutOfRange):
            stage.move_to(target)
    stage.close()


def test_stop_brakes_and_leaves_no_error(stage, world):
    stage.move_to(40e-3)
    world.pass_time(1)
    stage.stop()
    world.pass_time(1)
    assert stage.status().error == 0
    assert not world.axis.moving
    stage.move_to(23e-3)


def test_emergency_stop_stops_dead_and_is_acknowledged_by_stop(stage, world):
    stage.move_to(40e-3)
    world.pass_time(1)
    stage.emergency_stop()
    assert stage.status().error == 10
    assert world.axis.velocity == 0
    with pytest.raises(MotionFault, match="emergency stop was pressed"):
        stage.move_to(40e-3)
    stage.stop()
    stage.move_to(40e-3)
    assert world.axis.moving


def test_emergency_stop_passes_a_transaction_that_waits_for_its_reply(world, controller, server):
    stage = patient(server.url)
    stage.move_to(40e-3)
    world.fail("stage", "silent")

    def wait():
        with pytest.raises(NotConnected):
            stage.status()

    waiting = threading.Thread(target=wait)
    waiting.start()
    wait_until(lambda: controller.received["#4"] > 1)
    stage.emergency_stop()
    wait_until(lambda: controller.received["#24"] == 1)
    with world.lock:
        assert not world.axis.moving
    assert waiting.is_alive()
    world.fail("stage", "unplugged")
    stage._gateway.send_urgent(b"\n")
    waiting.join()
    stage.close()


def test_no_move_slips_through_between_check_and_stop(stage, world, controller, monkeypatch):
    """The stop byte overtakes a move that has already been checked: it is sent again behind it."""
    send = stage._gateway.send

    def press_then_send(message):
        if message.startswith("MOV"):
            stage.emergency_stop()
        send(message)

    monkeypatch.setattr(stage._gateway, "send", press_then_send)
    with pytest.raises(MotionFault, match="emergency stop"):
        stage.move_to(40e-3)
    wait_until(lambda: controller.received["#24"] == 2)
    with world.lock:
        assert controller.received["MOV"] == 1
        assert not world.axis.moving


def test_stop_from_another_thread_is_no_fault_of_the_controller(stage, world):
    stage.move_to(40e-3)
    with stopping(stage.stop) as done:
        while not done.is_set():
            stage.status()
    assert not world.axis.moving or world.axis.target < 40e-3


def test_referencing_moves_away_from_the_sample(world):
    with serve_tcp(EmulatedController(world)) as server:
        stage = patient(server.url)
        assert not stage.referenced
        with pytest.raises(CommandRefused, match="unreferenced"):
            stage.move_to(23e-3)
        stage.reference()
        assert stage.status().moving
        while stage.status().moving:
            world.pass_time(0.5)
        assert stage.referenced
        assert stage.status().position == pytest.approx(52e-3, abs=1e-7)
        assert stage.status().servo_on
        stage.close()


def test_inverted_axis(world, controller, server):
    stage = patient(server.url, inverted=True, minimum=-40e-3)
    assert stage.travel == pytest.approx((-40e-3, 0))
    stage.move_to(-21e-3)
    world.pass_time(5)
    assert stage.status().position == pytest.approx(-21e-3, abs=1e-7)
    assert world.axis.position == pytest.approx(21e-3)
    stage.close()


def test_nothing_listens():
    with pytest.raises(NotConnected, match=r"cannot open socket://127.0.0.1:1.*Remedy"):
        PIStage("socket://127.0.0.1:1")


@pytest.mark.parametrize("name", ["socket://", "socket://nowhere", "ftp://127.0.0.1:5", "/dev/nowhere", ""])
def test_impossible_ports(name):
    with pytest.raises(NotConnected, match="cannot open"):
        PIStage(name)


def test_a_silent_box_is_noticed_within_one_timeout(world, controller, server):
    world.fail("stage", "silent")
    with pytest.raises(NoReply, match="ask for the identity"):
        PIStage(server.url, reply_timeout=0.05)


def test_wrong_model(server):
    with pytest.raises(WrongDevice, match=r"C-863\.12.*expects 'C-884'"):
        patient(server.url, expected_model="C-884")


def test_wrong_axis(server):
    with pytest.raises(WrongDevice, match="names 'X'"):
        patient(server.url, axis="X")


def test_a_second_program_is_refused(stage, server):
    with pytest.raises(NotConnected):
        patient(server.url)
    assert stage.referenced


@TERMINALS
def test_a_second_program_on_the_serial_port_is_refused(controller):
    with serve_pty(controller) as server:
        stage = patient(server.url)
        with pytest.raises(NotConnected, match="exclusively lock"):
            patient(server.url)
        stage.close()


def test_closing_twice_and_using_it_afterwards(stage):
    stage.close()
    stage.close()
    with pytest.raises(NotConnected, match="closed"):
        stage.status()
    with pytest.raises(NotConnected):
        stage.emergency_stop()


def test_reconnecting_in_the_same_process(server):
    for _ in range(5):
        stage = patient(server.url)
        assert stage.status().servo_on
        stage.close()


# ---------------------------------------------------------------- faults


@pytest.mark.parametrize(
    ("kind", "value", "error"),
    [
        ("silent", 0, NoReply),
        ("slow", 0.4, NoReply),
        ("late", 0, NoReply),
        ("garbage", 0, (BadReply, NoReply)),
        ("unplugged", 0, NotConnected),
        ("error_code", 84, MotionFault),
        ("error_code", 2, CommandRefused),
        ("blocked", 0, MotionFault),
        ("limit_switch", 0, MotionFault),
        ("servo_lost", 0, MotionFault),
        ("rebooted", 0, MotionFault),
    ],
)
def test_every_fault_becomes_one_clear_error(virtual, world, kind, value, error):
    stage = virtual
    stage.move_to(40e-3)
    world.pass_time(0.5)
    world.fail("stage", kind, value)
    with pytest.raises(error, match=r"^stage: .+ Remedy: .+"):
        stage.status()


@pytest.mark.parametrize("kind", ["blocked", "limit_switch", "servo_lost", "rebooted", "error_code"])
def test_stop_works_whatever_the_controller_complains_of(stage, world, kind):
    stage.move_to(40e-3)
    world.pass_time(0.5)
    world.fail("stage", kind)
    with pytest.raises(DeviceError):
        stage.status()
    stage.stop()
    world.pass_time(1)
    assert not world.axis.moving


@pytest.mark.parametrize("kind", ["blocked", "servo_lost", "rebooted"])
def test_a_lost_servo_is_reported_until_it_is_switched_on_again(stage, world, kind):
    stage.move_to(40e-3)
    world.fail("stage", kind)
    for _ in range(3):
        with pytest.raises(MotionFault, match=r"servo|Motor|position error"):
            stage.status()
    world.faults.clear()
    stage.servo(True)
    assert stage.status().servo_on


def test_a_restart_is_named_as_such(stage, world):
    world.fail("stage", "rebooted")
    for _ in range(2):
        with pytest.raises(MotionFault, match="has restarted"):
            stage.status()
    assert not stage.referenced


def test_a_pressed_limit_switch_is_reported_until_the_stage_moves_away(stage, world):
    stage.move_to(40e-3)
    world.pass_time(0.5)
    world.fail("stage", "limit_switch", 1)
    for _ in range(2):
        with pytest.raises(MotionFault, match="positive limit switch"):
            stage.status()
    stage.move_to(21e-3)
    status = stage.status()
    assert (status.positive_limit, status.negative_limit, status.moving) == (True, False, True)


def test_limit_switches_that_are_active_low(world):
    with serve_tcp(EmulatedController(world, referenced=True, limit_bits_inverted=True)) as server:
        stage = patient(server.url)
        status = stage.status()
        assert (status.positive_limit, status.negative_limit) == (False, False)
        world.fail("stage", "limit_switch", -1)
        with pytest.raises(MotionFault, match="negative limit switch"):
            stage.status()
        stage.close()


@pytest.mark.parametrize("after", ["nothing", "a stop that could not be sent"])
def test_somebody_elses_stop_is_reported(world, monkeypatch, after):
    controller = EmulatedController(world, referenced=True)
    with serve_tcp(controller) as server:
        stage = patient(server.url)
        if after != "nothing":
            with monkeypatch.context() as cut:
                cut.setattr(stage._gateway, "send_urgent", mock.Mock(side_effect=ConnectionResetError))
                with pytest.raises(NotConnected):
                    stage.stop()
        stage.move_to(40e-3)
        controller.execute("STP")
        with pytest.raises(MotionFault, match="stopped by command"):
            stage.status()
        stage.stop()
        stage.status()
        stage.close()


@pytest.mark.parametrize("kind", ["silent", "slow", "late", "garbage"])
def test_no_stale_reply_is_ever_believed(virtual, world, kind):
    """While replies go astray and afterwards, a position that is returned is the present one."""
    stage = virtual
    stage.set_speed(5e-3)
    stage.move_to(50e-3)

    def poll():
        world.pass_time(0.1)
        return stage.status()

    positions = 0
    for status in believed(poll, lambda: world.fail("stage", kind, 0.25), world.faults, last=5):
        positions += 1
        assert status.position == pytest.approx(world.axis.position, abs=1e-7)
    assert positions >= 4


def test_stop_reaches_a_controller_whose_replies_are_lost(virtual, world):
    stage = virtual
    stage.move_to(40e-3)
    world.fail("stage", "silent")
    with pytest.raises(NoReply, match="confirm the halt"):
        stage.stop()
    assert world.axis.velocity == 0


def test_unplugged_cable_is_noticed_by_every_call(stage, world):
    world.fail("stage", "unplugged")
    for call in (stage.status, stage.stop, lambda: stage.move_to(23e-3), lambda: stage.servo(True)):
        with pytest.raises(NotConnected):
            call()
    # The byte may still be accepted by the operating system; nothing may escape but a DeviceError.
    with contextlib.suppress(NotConnected):
        stage.emergency_stop()


@TERMINALS
def test_serial_adapter_pulled_out(world, controller):
    with serve_pty(controller) as server:
        stage = patient(server.url)
        world.fail("stage", "unplugged")
        for _ in range(3):
            with pytest.raises((NotConnected, NoReply)):
                stage.status()
        with pytest.raises(NotConnected):
            stage.status()
        stage.close()


# ---------------------------------------------------------------- nonsense


class BabblingController(BabblingPort):
    """Read as the gateway reads."""

    def read(self, timeout):
        data, self._pending = self._pending, b""
        return data

    def drain(self):
        self._pending = b""


PLAUSIBLE = st.sampled_from(
    [
        b"0\n",
        b"1=21.5\n",
        b"1=21.5",
        b"0x9000\n",
        b"0x9100\n",
        b"-1024\n",
        b"10\n",
        b"1\n",
        b"(c), C-863.12, 1, 2\n",
        b"1=1\n",
        b"\xb1\n",
        b"2=5 \n1=5\n",
    ]
)
REPLIES = st.lists(st.one_of(PLAUSIBLE, st.binary(max_size=30), st.text(max_size=10).map(str.encode)), max_size=40)
GOOD_START = [b"", b"(c), C-863.12, 1, 2\n", b"0\n", b"1\n", b"(c), C-863.12, 1, 2\n", b"1=0\n", b"1=52\n"]
GOOD_START += [b"1=1\n", b"0\n", b"0x9000\n"]
CALLS = (
    PIStage.status,
    PIStage.stop,
    PIStage.emergency_stop,
    PIStage.reference,
    lambda stage: stage.referenced,
    lambda stage: stage.servo(True),
    lambda stage: stage.servo(False),
    lambda stage: stage.move_to(0.01),
    lambda stage: stage.set_speed(1e-3),
)


def connect(replies):
    patch = pytest.MonkeyPatch()
    with patch.context() as context:
        context.setattr(drivers.gateway, "open_port", lambda connection, baud: BabblingController(replies))
        return PIStage("fake")


@pytest.mark.parametrize("data", [b"\x00\xff" * 500, b"0x9000\n" * 100, b"x" * 999, b"1=5 \n" * 99])
def test_a_device_that_babbles_without_end(data):
    with flood(data) as url, pytest.raises(DeviceError):
        PIStage(url, reply_timeout=0.05)


@settings(deadline=None)
@given(REPLIES)
def test_connecting_to_nonsense_is_a_device_error(replies):
    with pytest.raises(DeviceError):
        connect(replies)


@settings(max_examples=200, deadline=None)
@given(REPLIES, st.lists(st.sampled_from(CALLS), max_size=10))
def test_nonsense_in_operation_is_a_device_error_or_a_finite_position(replies, calls):
    stage = connect(GOOD_START + replies)
    for call, result in outcomes(stage, "stage", calls):
        if call is PIStage.status:
            assert abs(result.position) < float("inf")


@settings(deadline=None)
@given(st.floats())
def test_no_float_leaves_the_travel(position):
    stage = connect([*GOOD_START, b"", b"0\n", f"1={position * 1e3:.7f}\n".encode()])
    if 0 <= position <= 0.052:
        stage.move_to(position)
    else:
        with pytest.raises(OutOfRange):
            stage.move_to(position)
