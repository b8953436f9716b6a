"""What a coverage-guided fuzzer does for hours (``benchmarks/fuzz.py``), for a moment, and what it has found before."""

from __future__ import annotations

import pytest
from fuzz_targets import TARGETS
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.daq_errors import translated
from drivers.errors import BadReply
from rig.errors import FileError
from rig.scene import parse_scene

SLOW = {"bytes of recordings": 3}
FOUND = [
    ("scene files", b'[substrate]\nshape = "flat"\n[protocol]\nname = "pul\\t_off"\n'),
    ("scene files", b'[substrate]\nshape = "flat"\n"\\u001b[2J" = 1\n'),
    ("gRPC replies", b"\5\0" * 60),
    ("journals", b"\r\0\0\5\0\x90" + bytes(7) + b"\2^"),
]


@pytest.mark.parametrize("name", TARGETS)
def test_any_bytes_end_in_one_clear_error(name, monkeypatch):
    monkeypatch.setattr("rig.seal.PROBE_SECONDS", 3.0)
    target, seeds = TARGETS[name]
    for seed in (*seeds, b""):
        target(seed)

    @settings(max_examples=SLOW.get(name, 30), deadline=None, database=None)
    @given(data=st.binary(max_size=300))
    def play(data):
        target(data)

    play()


@pytest.mark.parametrize(("name", "data"), FOUND)
def test_what_was_found_stays_mended(name, data):
    TARGETS[name][0](data)


def test_control_characters_of_a_file_do_not_reach_the_terminal():
    with pytest.raises(FileError) as error:
        parse_scene('[substrate]\nshape = "flat"\n"\\u001b[2J" = 1\n', "scene.toml")
    assert "\x1b" not in str(error.value)
    assert r"\x1b[2J" in str(error.value)


def test_a_defect_of_nidaqmx_that_a_server_can_set_off_is_a_bad_reply():
    with pytest.raises(BadReply, match="UnboundLocalError"), translated():
        raise UnboundLocalError("cannot access local variable 'response'")
