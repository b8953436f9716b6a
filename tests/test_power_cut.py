"""A power cut at any moment of a journalled recording: what was acknowledged is there, and nothing that is wrong."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from power_cut import Disk, watched

from rig.errors import FileError
from rig.journal import journal_of
from rig.observe import Controls, Observer
from rig.recording import Recording, load_recording
from rig.session import Request, run_scene

Cuts = tuple[Disk, Recording]


class _StopAfter(Observer):
    """The operator ends the run after so many samples: the disk is looked at often, and slowly."""

    def __init__(self, controls: Controls, samples: int) -> None:
        self._controls, self._samples = controls, samples

    def frame(self, frame):
        if frame.stop >= self._samples:
            self._controls.stop()


@pytest.fixture
def recorded(request_for: Callable[..., Request], tmp_path: Path, monkeypatch) -> Callable[..., Cuts]:
    """Record a run on a disk that is followed; every few frames are a flush, however fast they come."""

    def record(*, journalled: bool, samples: int) -> Cuts:
        monkeypatch.setattr("rig.recorder.FLUSH_SECONDS", 0.005)
        request = request_for("sphere-60mm-low", controls=Controls())
        recording = request.bench.recording.model_copy(update={"survives_power_cut": journalled})
        request.bench = request.bench.model_copy(update={"recording": recording})
        request.out = tmp_path / "disk" / "run.h5"
        request.out.parent.mkdir()
        request.observers = [_StopAfter(request.controls, samples)]
        with watched(request.out.parent) as disk:
            run_scene(request)
        return disk, load_recording(request.out)

    return record


def found_after(disk: Disk, moment: int, draw: random.Random, folder: Path) -> Recording | None:
    """Cut the power, read what is left as the program would; ``None`` if it is no recording."""
    folder.mkdir()
    disk.cut(moment, draw, folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rig.recovery.lives", lambda writer: False)  # the tests' process is the writer
        try:
            return load_recording(folder / "run.h5")
        except FileError:
            return None


def is_part_of(found: Recording, whole: Recording) -> bool:
    """Whether every sample is as it was recorded."""
    length = found.force.size
    return all(
        np.array_equal(getattr(found, name), getattr(whole, name)[..., : getattr(found, name).shape[-1]])
        for name in ("volts", "force", "height", "pressure", "frames", "stage", "steps")
    ) and (length == 0 or found.frames[-1]["start"] + found.frames[-1]["samples"] == length)


def check(disk: Disk, whole: Recording, folder: Path, cuts: int, seed: int) -> None:
    draw = random.Random(seed)
    for number in range(cuts):
        moment = draw.randint(1, disk.moments)
        found = found_after(disk, moment, draw, folder / f"cut-{seed}-{number}")
        safe = disk.safe_at(moment)
        if found is None:
            assert safe == 0
            continue
        assert found.force.size >= safe
        assert is_part_of(found, whole)


def test_a_power_cut_costs_nothing_that_was_acknowledged(recorded, tmp_path):
    disk, whole = recorded(journalled=True, samples=1500)
    assert disk.acknowledged[-1][1] == whole.force.size
    check(disk, whole, tmp_path, cuts=25, seed=1)


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_a_thousand_power_cuts_cost_nothing_that_was_acknowledged(recorded, tmp_path):
    disk, whole = recorded(journalled=True, samples=6000)
    check(disk, whole, tmp_path, cuts=1000, seed=2)


def test_the_model_of_the_disk_is_merciless(recorded, tmp_path):
    """Without the journal nothing is promised: the same cuts must be able to destroy a recording."""
    disk, _ = recorded(journalled=False, samples=600)
    draw = random.Random(3)
    assert any(found_after(disk, disk.moments // 2, draw, tmp_path / str(cut)) is None for cut in range(10))


def test_the_journal_goes_when_the_recording_is_safe(request_for):
    request = request_for()
    recording = request.bench.recording.model_copy(update={"survives_power_cut": True})
    request.bench = request.bench.model_copy(update={"recording": recording})
    assert run_scene(request).exit_code == 0
    assert request.out.exists()
    assert not journal_of(request.out).exists()
