"""The min/max pyramid: what is drawn is what was measured, however it came in."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.console.pyramid import Pyramid, polyline


def filled(signal: np.ndarray, cuts: list[int]) -> Pyramid:
    pyramid = Pyramid()
    for part in np.split(signal, sorted(cut % (signal.size + 1) for cut in cuts)):
        pyramid.extend(part)
    return pyramid


@settings(max_examples=60, deadline=None)
@given(
    size=st.integers(1, 5000),
    cuts=st.lists(st.integers(0, 10_000), max_size=8),
    span=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    blocks=st.integers(1, 60),
    seed=st.integers(0, 2**31),
)
def test_a_view_holds_the_extremes_of_its_stretch(
    size: int, cuts: list[int], span: tuple[float, float], blocks: int, seed: int
) -> None:
    signal = np.random.default_rng(seed).normal(size=size).cumsum()
    pyramid = filled(signal, cuts)
    np.testing.assert_array_equal(pyramid.values, signal)
    start, stop = (int(part * size) for part in sorted(span))
    index, least, greatest = pyramid.view(start, stop, blocks)
    if stop <= start:
        assert index.size == 0
        return
    assert index.size <= 4 * blocks + 3
    assert np.all(np.diff(index) > 0)
    assert np.all(least <= greatest)
    inside = signal[start:stop]
    assert least.min() <= inside.min()
    assert greatest.max() >= inside.max()
    block = max(1.0, np.diff(index).max()) if index.size > 1 else float(size)
    widened = signal[max(0, int(start - block)) : int(stop + block)]
    assert least.min() >= widened.min()
    assert greatest.max() <= widened.max()


def test_a_single_spike_in_a_million_points_is_drawn() -> None:
    signal = np.zeros(1_000_000)
    signal[654_321] = 1.0
    pyramid = filled(signal, [])
    index, least, greatest = pyramid.view(0, signal.size, 250)
    assert greatest.max() == 1.0
    assert abs(index[int(np.argmax(greatest))] - 654_321) <= signal.size / 250
    x, y = polyline(index, least, greatest)
    assert y.max() == 1.0
    assert x.size == y.size <= 2 * 1003


def test_few_samples_are_drawn_as_they_are() -> None:
    pyramid = filled(np.arange(100.0), [7])
    index, least, greatest = pyramid.view(10, 60, 250)
    x, y = polyline(index, least, greatest)
    np.testing.assert_array_equal(x, np.arange(10.0, 60.0))
    np.testing.assert_array_equal(y, np.arange(10.0, 60.0))


def test_an_append_computes_only_what_is_new() -> None:
    pyramid = filled(np.zeros(300_000), [])
    levels = [level.size for level in pyramid._levels]
    pyramid.extend(np.zeros(20))
    computed = sum(level.size for level in pyramid._levels) - sum(levels)
    assert computed <= 20
