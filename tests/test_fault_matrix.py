"""Every step times every fault: a sample on every run, all cells on demand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fault_matrix import Trouble, Verdict, cells, page, play, troubles

PAGE = Path(__file__).parents[1] / "docs" / "fault-matrix.md"
ENOUGH = 200
"""Cells that make a page."""
ON_WIRE = ("stage unplugged, on the wire", "pump answers late (stale replies)", "DAQ removed, on the wire")


def sample() -> list[tuple[Trouble, str]]:
    """Every fault of the direct back end once, the steps in turn, and a few on the wire."""
    direct = [trouble for trouble in troubles() if not trouble.wire]
    chosen = [(trouble, trouble.steps[number % len(trouble.steps)]) for number, trouble in enumerate(direct)]
    return chosen + [(trouble, "preload") for trouble in troubles() if trouble.title in ON_WIRE]


def name(cell: tuple[Trouble, str]) -> str:
    return f"{cell[0].title} in {cell[1]}"


@pytest.fixture(scope="module")
def verdicts() -> Iterator[list[Verdict]]:
    """What the cells of this run came to; enough of them become the page in the documentation."""
    collected: list[Verdict] = []
    yield collected
    if len(collected) >= ENOUGH:
        PAGE.write_text(page(collected), encoding="utf-8")


@pytest.mark.parametrize("cell", sample(), ids=name)
def test_a_fault_ends_safely_and_loses_nothing(cell, tmp_path):
    assert play(*cell, tmp_path).flaws == ()


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("cell", cells(), ids=name)
def test_every_fault_in_every_step(cell, tmp_path, verdicts):
    verdict = play(*cell, tmp_path)
    verdicts.append(verdict)
    assert verdict.flaws == ()


def test_the_matrix_knows_every_fault_of_the_emulators():
    from rig.fault_script import known_faults

    played = {(device, kind) for trouble in troubles() for device, kind, _ in trouble.faults}
    left = {(device, kind) for device, kinds in known_faults().items() for kind in kinds} - played
    assert left == HARMLESS


HARMLESS = {("force", "noise"), ("pressure", "noise"), ("pressure", "leak")}
"""Not faults of an instrument: a worse measurement, which the analysis has to show."""
