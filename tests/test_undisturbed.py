"""Precedence of the loop in real time: granted or not, it is told and taken back."""

from __future__ import annotations

import gc
import os
import sys
import threading

import pytest

from rig import undisturbed as module
from rig.undisturbed import undisturbed


def test_what_was_loaded_before_is_not_searched_for_garbage_until_the_end() -> None:
    with undisturbed():
        assert gc.get_freeze_count() > 10_000
    assert gc.get_freeze_count() == 0


def test_the_priority_of_the_loops_thread_is_taken_back_even_after_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    held = [module._priority()]
    monkeypatch.setattr(module, "_priority", lambda: held[-1])
    monkeypatch.setattr(module, "_set_priority", held.append)

    def fail() -> None:
        with undisturbed() as told:
            assert told.endswith("yes")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    first, raised, last = held
    assert raised != first
    assert last == first


def test_a_system_that_grants_no_precedence_ends_no_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(value: int) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(module, "_set_priority", refuse)
    with undisturbed() as told:
        assert told.endswith("not granted by the system")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows gives precedence to whole processes")
def test_only_the_loops_own_thread_has_precedence() -> None:
    over = threading.Event()
    bystander = threading.Thread(target=over.wait)
    bystander.start()
    assert bystander.native_id is not None
    before = os.getpriority(os.PRIO_PROCESS, bystander.native_id)
    with undisturbed() as told:
        assert os.getpriority(os.PRIO_PROCESS, bystander.native_id) == before
        assert (module._priority() < before) == told.endswith("yes")
    over.set()
    bystander.join()
