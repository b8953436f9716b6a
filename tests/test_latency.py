"""The way from the sample that passes the limit to the stop byte; figures are in docs/reliability.md."""

from __future__ import annotations

import re

import numpy as np
import pytest
from latency import measure

from drivers.emulated.faults import Fault, Faults
from rig.interlocks import Interlocks, Limits
from rig.latency import Latencies
from rig.recording import load_recording
from rig.session import run_scene


def test_every_trip_sends_one_stop_byte_to_the_controller(tmp_path):
    latencies, endings = measure(tmp_path, 20.0, 2)
    tripped = [ending for ending in endings if "force" in ending.reason]
    assert tripped
    assert len(latencies) == len(tripped)
    assert (latencies > 0).all()
    assert any(b"precedence over other programs" in row["text"] for row in load_recording(tmp_path / "0.h5").events)


def test_a_recording_tells_how_long_the_interlocks_took(request_for):
    request = request_for()
    run_scene(request)
    told = [row["text"].decode() for row in load_recording(request.out).events if row["kind"] == b"timing"]
    assert len(told) == 1
    checks, ages = told[0].split(";")
    assert "p50" in checks
    assert "p99" in checks
    assert "plant's clock" in ages
    assert float(re.search(r"p50 ([\d.]+), p99", ages)[1]) == pytest.approx(20.0, rel=0.1)  # a frame, never late


def test_a_recording_tells_how_old_the_sample_was_that_stopped_the_stage(request_for):
    fault = Fault("force", "over_range", at_step="preload", after_samples=87, value=4.7)
    request = request_for(faults=Faults([fault]))
    run_scene(request)
    recording = load_recording(request.out)
    passed = int((recording.force > request.bench.limits.compression_N).argmax())
    told = next(row["text"].decode() for row in recording.events if row["text"].startswith(b"stop sent"))
    age = float(re.search(r"([\d.]+) ms after the sample that passed", told)[1])
    assert age == pytest.approx((recording.force.size - passed) / recording.rate * 1e3, abs=0.5)


def test_the_first_sample_beyond_a_limit_is_found_and_one_that_is_no_number_is_beyond():
    limits = Interlocks(Limits(1.0, 0.5, (0.0, 1.0), (-10.0, 10.0)))
    assert limits.first_beyond(np.array([0.0, 0.9, 1.1, 2.0]), None) == 2
    assert limits.first_beyond(np.array([0.0, -0.6, 1.1]), None) == 1
    assert limits.first_beyond(np.zeros(4), np.array([0.0, 0.0, 0.0, -11.0])) == 3
    assert limits.first_beyond(np.array([0.0, np.nan]), np.zeros(2)) == 1
    assert limits.first_beyond(np.zeros(3), None) == 0


def test_quantiles_are_exact_to_a_twelfth():
    durations = np.random.default_rng(1).lognormal(-7, 1, 5000)
    counted = Latencies()
    for duration in durations:
        counted.add(duration)
    for share in (0.5, 0.9, 0.99, 1.0):
        assert abs(counted.quantile(share) / np.quantile(durations, share) - 1) < 1 / 11
    assert counted.worst == durations.max()
    assert Latencies().quantile(0.5) == 0.0
