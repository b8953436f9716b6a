"""The way from the sample that passes the limit to the stop byte; figures are in docs/reliability.md."""

from __future__ import annotations

import numpy as np
from latency import measure

from rig.latency import Latencies
from rig.recording import load_recording
from rig.session import run_scene


def test_every_trip_sends_one_stop_byte_to_the_controller(tmp_path):
    latencies, endings = measure(tmp_path, 20.0, 2)
    tripped = [ending for ending in endings if "force" in ending.reason]
    assert tripped  # a computer that is too busy for real time ends a run for that
    assert len(latencies) == len(tripped)
    assert (latencies > 0).all()


def test_a_recording_tells_how_long_the_interlocks_took(request_for):
    request = request_for()
    run_scene(request)
    told = [row["text"].decode() for row in load_recording(request.out).events if row["kind"] == b"timing"]
    assert len(told) == 1
    assert "p50" in told[0]
    assert "p99" in told[0]


def test_quantiles_are_exact_to_a_twelfth():
    durations = np.random.default_rng(1).lognormal(-7, 1, 5000)
    counted = Latencies()
    for duration in durations:
        counted.add(duration)
    for share in (0.5, 0.9, 0.99, 1.0):
        assert abs(counted.quantile(share) / np.quantile(durations, share) - 1) < 1 / 11
    assert counted.worst == durations.max()
    assert Latencies().quantile(0.5) == 0.0
