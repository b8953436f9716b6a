"""Whatever bytes an instrument sends: an error of its driver, never a crash, a hang or a motion."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.emulated.server import Line, serve_tcp
from drivers.errors import DeviceError
from drivers.pump import LegatoPump, parse_quantity, parse_reply
from drivers.stage import PIStage

PATIENCE = 0.02
BYTES = st.one_of(
    st.binary(min_size=1, max_size=40),
    st.sampled_from(
        [b"0\n", b"1=0\n", b"1=nan\n", b"1=1e999\n", b"0 1\n", b"\n\n", b"1=\n", b"=\n", b"9" * 400 + b"\n"]
    ),
    st.sampled_from([b"\n:", b"\n00:", b"\nT*", b"\n>*", b"1 2 3 i.....\n:", b"\n\x11", b":" * 300, b"ml/min\n>"]),
)


class Babbler:
    """An instrument that answers every message with the next of its texts, and notes what it is told."""

    def __init__(self, answers: list[bytes]) -> None:
        self._answers = list(answers)
        self.told = b""
        self.watch_interval = 1.0

    def connect(self, line: Line) -> Babbler:
        self._line = line
        return self

    def receive(self, data: bytes) -> None:
        self.told += data
        if self._answers:
            self._line.send(self._answers.pop(0), 0.0)

    def watch(self) -> None:
        pass


def stage(connection: str) -> PIStage:
    return PIStage(connection, reply_timeout=PATIENCE)


def pump(connection: str) -> LegatoPump:
    return LegatoPump(connection, syringe_diameter=14.43e-3, force_percent=50, reply_timeout=PATIENCE, settle=0.0)


@pytest.mark.parametrize(("opening", "motion"), [(stage, (b"MOV", b"FRF", b"FPL", b"FNL")), (pump, (b"irun", b"wrun"))])
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(answers=st.lists(BYTES, max_size=12))
def test_an_instrument_that_babbles_is_not_taken_for_one(opening, motion, answers):
    babbler = Babbler(answers)
    with serve_tcp(babbler) as server, pytest.raises(DeviceError) as error:
        opening(server.url)
    assert not any(command in babbler.told for command in motion)
    assert "Remedy" in str(error.value)


@settings(max_examples=500, deadline=None)
@given(data=st.one_of(BYTES, st.binary(max_size=200)))
def test_a_reply_of_the_pump_is_understood_or_refused(data):
    with contextlib.suppress(ValueError):
        reply = parse_reply(data)
        assert all(line.isprintable() for line in reply.lines)


@settings(max_examples=500, deadline=None)
@given(text=st.one_of(st.text(max_size=40), st.from_regex(r"[0-9.]{0,6} ?[munp]?l(/(min|sec|hr))?", fullmatch=True)))
def test_a_quantity_is_a_number_or_refused(text):
    with contextlib.suppress(ValueError):
        assert parse_quantity(text) >= 0
