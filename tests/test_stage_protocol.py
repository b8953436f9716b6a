"""What the stage driver says on the wire, byte by byte (GCS 2.0, MS249E)."""

import pytest
from dialogue import dialogue
from links import GatewayWire, Script

from drivers.errors import BadReply, CommandRefused, MotionFault, NoReply, OutOfRange, WrongDevice
from drivers.stage import PIStage

IDENTITY = b"(c)2015 Physik Instrumente (PI) GmbH & Co. KG, C-863.12, 0021550019, 1.2.1.0\n"
CONNECT = [
    (b"\n*IDN?\n", IDENTITY),
    (b"ERR?\n", b"0\n"),
    (b"SAI?\n", b"1\n"),
    (b"*IDN?\n", IDENTITY),  # pipython looks which dialect it is
    (b"TMN?\n", b"1=0.0000000\n"),
    (b"TMX?\n", b"1=52.0000000\n"),
    (b"FRF?\n", b"1=1\n"),
    (b"ERR?\n", b"0\n"),
    (b"\x04", b"0x9000\n"),
]


def test_connection_identifies_the_controller_and_moves_nothing():
    with dialogue(CONNECT) as url:
        stage = PIStage(url, reply_timeout=60.0)
        assert stage.identity.model == "C-863.12"
        assert stage.identity.serial == "0021550019"
        assert stage.travel == pytest.approx((0.0, 0.052))
        stage.close()


def test_errors_left_by_an_earlier_program_are_read_away():
    exchanges = [CONNECT[0], (b"ERR?\n", b"10\n"), *CONNECT[1:]]
    with dialogue(exchanges) as url:
        PIStage(url, reply_timeout=60.0).close()


@pytest.mark.parametrize(
    ("identity", "error"),
    [
        (b"(c)2015 Physik Instrumente, C-884.4D, 1, 1.0\n", "expects 'C-863'"),
        (b"PREVAC, MG15, 1\n", "expects 'C-863'"),
        (b"\n", "expects 'C-863'"),
        (b"\x8a\xea\x00\xff\n", "expects 'C-863'"),
        (b"a\nb\n", "not in GCS"),
    ],
)
def test_another_device_is_refused(identity, error):
    with dialogue([(b"\n*IDN?\n", identity)]) as url, pytest.raises(WrongDevice, match=error):
        PIStage(url, reply_timeout=60.0)


def test_a_missing_axis_is_refused():
    with (
        dialogue([*CONNECT[:2], (b"SAI?\n", b"A \nB\n"), CONNECT[3]]) as url,
        pytest.raises(WrongDevice, match=r"\['A', 'B'\]"),
    ):
        PIStage(url, reply_timeout=60.0)


def test_limits_are_the_narrower_of_controller_and_bench():
    with dialogue(CONNECT) as url:
        stage = PIStage(url, reply_timeout=60.0, minimum=0.010, maximum=0.1)
        assert stage.travel == pytest.approx((0.010, 0.052))
        stage.close()


def test_limits_without_overlap_are_refused():
    with dialogue(CONNECT[:6]) as url, pytest.raises(OutOfRange, match="nothing in common"):
        PIStage(url, reply_timeout=60.0, minimum=0.1)


@pytest.fixture
def talk():
    """Run a dialogue with a connected stage; ``options`` go to the driver."""

    def run(exchanges, action, **options):
        with dialogue([*CONNECT, *exchanges]) as url:
            stage = PIStage(url, reply_timeout=60.0, **options)
            try:
                return action(stage)
            finally:
                stage.close()

    return run


@pytest.fixture
def talk_past_silence(monkeypatch):
    """The same in virtual time, for replies that stay away."""

    def run(exchanges, action):
        script = Script([*CONNECT, *exchanges])
        wire = GatewayWire(script)
        monkeypatch.setattr("drivers.gateway.open_port", lambda connection, baud: wire)
        monkeypatch.setattr("drivers.gateway.time", wire)
        try:
            return action(PIStage("fake"))
        finally:
            script.check()

    return run


def test_status_is_two_questions(talk):
    status = talk([(b"\x04", b"0x3000\n"), (b"POS?\n", b"1=21.5000000\n")], PIStage.status)
    assert status.position == pytest.approx(0.0215)
    assert (status.moving, status.on_target, status.servo_on) == (True, False, True)
    assert status.sent < status.received


def test_on_target_flag(talk):
    status = talk([(b"\x04", b"0x9000\n"), (b"POS?\n", b"1=1.0\n")], PIStage.status)
    assert (status.moving, status.on_target) == (False, True)


def test_error_code_is_read_only_if_the_flag_is_up(talk):
    exchanges = [(b"\x04", b"0x9100\n"), (b"POS?\n", b"1=1.0\n"), (b"ERR?\n", b"2\n")]
    with pytest.raises(CommandRefused, match="Unknown command 2"):
        talk(exchanges, PIStage.status)


def test_motion_error_is_a_motion_fault(talk):
    exchanges = [(b"\x04", b"0x0100\n"), (b"POS?\n", b"1=1.0\n"), (b"ERR?\n", b"-1024\n"), (b"FRF?\n", b"1=1\n")]
    exchanges.append((b"ERR?\n", b"0\n"))
    with pytest.raises(MotionFault, match="position error too large"):
        talk(exchanges, PIStage.status)


def test_inverted_axis_turns_position_travel_and_switches_round(talk):
    exchanges = [(b"\x04", b"0x9004\n"), (b"POS?\n", b"1=20.0\n")]

    def poll(stage):
        assert stage.travel == pytest.approx((-0.052, 0.0))
        stage._limits_accepted = 0b100
        return stage.status()

    status = talk(exchanges, poll, inverted=True)
    assert status.position == pytest.approx(-0.020)
    assert status.negative_limit
    assert not status.positive_limit


def test_inverted_axis_moves_the_other_way(talk):
    exchanges = [(b"MOV 1 20\n", b""), (b"ERR?\n", b"0\n"), (b"MOV?\n", b"1=20.0000000\n")]
    talk(exchanges, lambda stage: stage.move_to(-0.020), inverted=True)


@pytest.mark.parametrize(
    ("action", "sent"),
    [
        (lambda stage: stage.servo(True), b"SVO 1 1\n"),
        (lambda stage: stage.servo(False), b"SVO 1 0\n"),
    ],
)
def test_set_commands_ask_for_the_error(talk, action, sent):
    talk([(sent, b""), (b"ERR?\n", b"0\n")], action)


@pytest.mark.parametrize(
    ("action", "sent", "kept"),
    [
        (lambda stage: stage.move_to(0.0123), b"MOV 1 12.3\n", b"1=12.3000000\n"),
        (lambda stage: stage.move_to(0.052), b"MOV 1 52\n", b"1=52.0000000\n"),
        (lambda stage: stage.set_speed(10e-6), b"VEL 1 0.01\n", b"1=0.0100000\n"),
    ],
)
def test_targets_and_speeds_are_read_back(talk, action, sent, kept):
    question = sent[:3] + b"?\n"
    talk([(sent, b""), (b"ERR?\n", b"0\n"), (question, kept)], action)
    garbled = kept.replace(b".", b"")
    talk([(sent, b""), (b"ERR?\n", b"0\n"), (question, garbled), (question, kept)], action)
    with pytest.raises(BadReply, match=r"after [\d.]+ was sent"):
        talk([(sent, b""), (b"ERR?\n", b"0\n"), (question, b"1=1.0\n"), (question, b"1=1.0\n"), (b"\x18", b"")], action)


@pytest.mark.parametrize(
    ("code", "kind"), [(b"5", CommandRefused), (b"7", CommandRefused), (b"-1024", MotionFault), (b"10", MotionFault)]
)
def test_a_refused_move_names_the_reason(talk, code, kind):
    with pytest.raises(kind, match="cannot move to 1 mm: controller error"):
        talk([(b"MOV 1 1\n", b""), (b"ERR?\n", code + b"\n")], lambda stage: stage.move_to(0.001))


@pytest.mark.parametrize("position", [-1e-6, 0.0521, float("nan"), float("inf")])
def test_targets_outside_the_travel_are_not_sent(talk, position):
    with pytest.raises(OutOfRange, match="travel"):
        talk([], lambda stage: stage.move_to(position))


@pytest.mark.parametrize("speed", [0.0, -1e-3, float("nan"), float("inf")])
def test_impossible_speeds_are_not_sent(talk, speed):
    with pytest.raises(OutOfRange, match="positive"):
        talk([], lambda stage: stage.set_speed(speed))


def test_stop_halts_and_reads_the_error_away(talk):
    talk([(b"HLT 1\n", b""), (b"ERR?\n", b"10\n"), (b"ERR?\n", b"0\n")], PIStage.stop)


def test_unconfirmed_halt_is_followed_by_the_stop_byte(talk):
    with pytest.raises(BadReply):
        talk([(b"HLT 1\n", b""), (b"ERR?\n", b"?!\n"), (b"\x18", b"")], PIStage.stop)


def test_emergency_stop_is_one_byte_and_blocks_moves_until_acknowledged(talk):
    def press(stage):
        stage.emergency_stop()
        with pytest.raises(MotionFault, match="emergency stop"):
            stage.move_to(0.001)
        stage.stop()
        stage.move_to(0.001)

    halt = [(b"HLT 1\n", b""), (b"ERR?\n", b"10\n"), (b"ERR?\n", b"0\n")]
    move = [(b"MOV 1 1\n", b""), (b"ERR?\n", b"0\n"), (b"MOV?\n", b"1=1.0000000\n")]
    talk([(b"\x18", b""), *halt, *move], press)


def test_reference_goes_to_the_limit_away_from_the_sample(talk):
    def exchanges(command):
        return [
            (b"SVO 1 1\n", b""),
            (b"ERR?\n", b"0\n"),
            (b"RON 1 1\n", b""),
            (b"ERR?\n", b"0\n"),
            (b"LIM?\n", b"1=1\n"),
            (b"ERR?\n", b"0\n"),
            (command, b""),
            (b"ERR?\n", b"0\n"),
        ]

    talk(exchanges(b"FPL 1\n"), PIStage.reference)
    talk(exchanges(b"FNL 1\n"), PIStage.reference, inverted=True)


@pytest.mark.parametrize(
    "reply", [b"1=nan\n", b"1=\n", b"2=5.0\n", b"1=5.0 6.0\n", b"5.0\n", b"\n", b"1=5.0\n1=5.0\n", b"0x9005\n"]
)
def test_a_position_that_makes_no_sense_is_refused(talk, reply):
    with pytest.raises(BadReply, match="makes no sense"):
        talk([(b"\x04", b"0x9000\n"), (b"POS?\n", reply)], PIStage.status)


@pytest.mark.parametrize("reply", [b"0x19000\n", b"-1\n", b"1=5\n", b"\xb1\n"])
def test_a_status_word_that_makes_no_sense_is_refused(talk, reply):
    with pytest.raises(BadReply, match="makes no sense"):
        talk([(b"\x04", reply)], PIStage.status)


def test_after_a_missing_reply_every_late_one_is_discarded(talk_past_silence):
    """The reply to the first question comes with the landmark and must not answer the second question."""
    exchanges = [
        (b"\x04", b"0x9000\n"),
        (b"POS?\n", b""),
        (b"*IDN?\n", b"1=11.0\n" + IDENTITY),
        (b"\x04", b"0x9000\n"),
        (b"POS?\n", b"1=12.0\n"),
    ]

    def poll_twice(stage):
        with pytest.raises(NoReply, match="within"):
            stage.status()
        return stage.status()

    assert talk_past_silence(exchanges, poll_twice).position == pytest.approx(0.012)


def test_a_late_landmark_does_not_end_the_next_search(talk_past_silence):
    exchanges = [
        (b"\x04", b""),
        (b"*IDN?\n", b""),
        (b"*IDN?\n", b"0x9000\n" + IDENTITY + IDENTITY),
        (b"\x04", b"0x9000\n"),
        (b"POS?\n", b"1=12.0\n"),
    ]

    def poll(stage):
        for _ in range(2):
            with pytest.raises(NoReply):
                stage.status()
        return stage.status()

    assert talk_past_silence(exchanges, poll).position == pytest.approx(0.012)
