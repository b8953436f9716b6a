"""Small numerical tools: running means, fits that find their own window, jumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RECTANGULAR = 3**0.5
"""Half-width of a rectangular distribution over its standard deviation."""

BLOCKS = 48
"""A window is averaged into about this many blocks before a fit: fast, and it makes the test of fit sharp."""


def running_mean(values: Array, width: int) -> Array:
    """Centred moving average over ``width`` samples, same length; the ends repeat the first and last sample."""
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(values, max(1, width), mode="nearest"), dtype=np.float64)


def block_means(values: Array, length: int) -> Array:
    """Means of consecutive blocks of ``length`` samples; an incomplete last block is left out."""
    count = values.size // length
    return np.asarray(values[: count * length].reshape(count, length).mean(axis=1), dtype=np.float64)


def on_grid(place: Array, value: Array, grid: Array) -> Array:
    """Average ``value`` in cells centred on an even ``grid``; empty cells are interpolated."""
    step = float(grid[1] - grid[0])
    cell = np.floor((place - grid[0]) / step + 0.5).astype(np.int64)
    inside = (cell >= 0) & (cell < grid.size)
    count = np.bincount(cell[inside], minlength=grid.size)
    total = np.bincount(cell[inside], weights=value[inside], minlength=grid.size)
    filled = count > 0
    return np.asarray(np.interp(grid, grid[filled], total[filled] / count[filled]), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of a signal, measured where the signal itself is known.

    Attributes
    ----------
    sigma
        Standard deviation of one sample.
    residual
        The samples it was measured on, mean removed; resampled by the propagation.
    memory
        Block length from which on block means fall as the square root of their length, samples.
    inflation
        How much larger the standard deviation of such means is than for white noise.
    """

    sigma: float
    residual: Array
    memory: int = 1
    inflation: float = 1.0

    @classmethod
    def measure(cls, residual: Array, memory: int) -> Noise:
        """Measure on residuals that hold noise only; ``memory`` is the block length looked at, samples."""
        sigma = float(residual.std())
        blocks = block_means(residual, max(memory, 1))
        if blocks.size < 4 or sigma == 0:
            return cls(sigma, residual)
        inflation = float(blocks.std(ddof=1) * np.sqrt(memory) / sigma)
        return cls(sigma, residual, memory, max(1.0, inflation))

    def of_mean(self, length: float) -> float:
        """Standard deviation of the mean of ``length`` consecutive samples."""
        inflation = 1.0 + (self.inflation - 1.0) * min(1.0, length / self.memory)
        return self.sigma * inflation / float(np.sqrt(max(length, 1.0)))

    def draw(self, count: int, generator: np.random.Generator) -> Array:
        """Draw ``count`` samples of like noise: blocks of the residual in random order, place and sign."""
        block = max(self.memory, 1)
        if self.residual.size < 8 * block:
            return generator.normal(0.0, self.sigma, count)
        pieces = -(-count // block)
        starts = generator.integers(0, self.residual.size - block + 1, pieces)
        signs = generator.choice(np.array([-1.0, 1.0]), pieces)
        drawn = self.residual[starts[:, None] + np.arange(block)] * signs[:, None]
        return np.asarray(drawn.reshape(-1)[:count], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class LocalFit:
    """A polynomial through the samples ``start`` to ``stop`` (exclusive); the abscissa is the sample index."""

    polynomial: np.polynomial.Polynomial
    start: int
    stop: int

    def __call__(self, index: float) -> float:
        """Return the value at a sample index, which may lie between two samples."""
        return float(self.polynomial(index))

    def slope(self, index: float) -> float:
        """Return the derivative per sample."""
        return float(self.polynomial.deriv()(index))

    def curvature(self, index: float) -> float:
        """Return the second derivative per sample squared."""
        return float(self.polynomial.deriv(2)(index))

    def minimum(self) -> tuple[float, float]:
        """Return index and value of the smallest value within the window, its ends included."""
        ends = np.array([self.start, self.stop - 1], dtype=np.float64)
        turning = self._inside(self.polynomial.deriv().roots())
        places = np.concatenate([ends, turning])
        values = self.polynomial(places)
        best = int(np.argmin(values))
        return float(places[best]), float(values[best])

    def root(self, near: float) -> float | None:
        """Return the zero nearest to ``near`` within the window, or ``None``."""
        roots = self._inside(self.polynomial.roots())
        return None if roots.size == 0 else float(roots[np.argmin(np.abs(roots - near))])

    def _inside(self, roots: NDArray[np.generic]) -> Array:
        real = np.real(roots[np.abs(np.imag(roots)) < 1e-9 * max(1, self.stop - self.start)])
        return np.asarray(real[(real >= self.start) & (real <= self.stop - 1)], dtype=np.float64)


def fit_window(values: Array, start: int, stop: int, degree: int) -> tuple[LocalFit, Array, float]:
    """Fit a polynomial to block means of a window; return it, the residuals of the blocks and the block length."""
    length = max(1, (stop - start) // BLOCKS)
    means = block_means(values[start:stop], length)
    places = start + (length - 1) / 2 + length * np.arange(means.size)
    degree = max(0, min(degree, means.size - 2))
    polynomial = np.polynomial.Polynomial.fit(
        places, means, degree, domain=[start, stop - 1 if stop - 1 > start else stop]
    )
    return LocalFit(polynomial, start, stop), means - polynomial(places), float(length)


def fit_around(values: Array, index: int, left: int, right: int, noise: Noise, *, degree: int = 3) -> LocalFit:
    """Fit a polynomial around ``index`` in the widest window whose residuals are noise.

    1. Start with the samples from ``left`` to ``right``.
    2. Average them into blocks, fit, and compare the residuals with the noise of a block (chi squared).
    3. While they do not fit, narrow both sides by a quarter. Stop at the smallest window of a dozen samples.
    4. Narrow once more, so that what the test could not see is smaller than the noise.
    """
    smallest = 4 * (degree + 1)
    before, after = float(index - left), float(right - 1 - index)
    accepted = False
    while True:
        start = max(left, int(index - before))
        stop = min(right, int(index + after) + 1)
        fit, residual, length = fit_window(values, start, stop, degree)
        if accepted or stop - start <= smallest:
            return fit
        freedom = max(1, residual.size - degree - 1)
        scale = noise.of_mean(length)
        chi_squared = float(np.sum(residual**2)) / (scale**2 * freedom) if scale > 0 else np.inf
        accepted = chi_squared < 1 + 2.5 * np.sqrt(2 / freedom)
        before, after = 0.75 * before, 0.75 * after


@dataclass(frozen=True, slots=True)
class ForceJump:
    """A sudden change: between the samples ``start`` (last before) and ``stop`` (first after)."""

    start: int
    stop: int
    before: float
    after: float
    slope_before: float

    @property
    def size(self) -> float:
        """Change of the value; positive where tension is released."""
        return self.after - self.before

    @property
    def middle(self) -> float:
        """Index half-way between the last sample before and the first after."""
        return (self.start + self.stop) / 2


def find_jumps(values: Array, noise: Noise, width: int, smallest: float) -> list[ForceJump]:
    """Find jumps: means over ``width`` samples before and after differ by more than noise and ``smallest``.

    Each candidate is then tested with a line fitted on either side, so that a steep but smooth stretch is not a jump.
    """
    if values.size < 8 * width:
        return []
    means = running_mean(values, width)
    contrast = np.zeros_like(values)
    contrast[width:-width] = means[2 * width :] - means[: -2 * width]
    threshold = max(6 * np.sqrt(2) * noise.of_mean(width), smallest)
    flagged = np.flatnonzero(np.abs(contrast) > threshold)
    if flagged.size == 0:
        return []
    groups = np.split(flagged, np.flatnonzero(np.diff(flagged) > width) + 1)
    tested = (_test_jump(values, _centre(contrast, group), noise, width, smallest) for group in groups)
    sharp = [_sharpen(values, jump, noise, width, smallest) for jump in tested if jump is not None]
    return _merged(sorted(sharp, key=lambda jump: jump.start), 2 * width)


def _merged(jumps: list[ForceJump], gap: int) -> list[ForceJump]:
    """Join neighbours: a jump found twice, or a slow one found in parts."""
    joined: list[ForceJump] = []
    for jump in jumps:
        last = joined[-1] if joined else None
        if last is not None and jump.start - last.stop <= gap:
            ends = last if last.stop >= jump.stop else jump
            joined[-1] = ForceJump(last.start, ends.stop, last.before, ends.after, last.slope_before)
        else:
            joined.append(jump)
    return joined


def _sharpen(values: Array, jump: ForceJump, noise: Noise, width: int, smallest: float) -> ForceJump:
    """Look at a jump ever closer while most of it remains: force that runs away before the snap is not part of it."""
    while width >= 8:
        width //= 2
        change = np.abs(np.diff(running_mean(values[max(0, jump.start - 1) : jump.stop + 2], max(1, width // 8))))
        centre = max(0, jump.start - 1) + int(np.argmax(change)) + 1
        closer = _test_jump(values, centre, noise, width, smallest)
        shorter = closer is not None and closer.stop - closer.start <= (jump.stop - jump.start) // 2
        if closer is None or not shorter or abs(closer.size) < 0.5 * abs(jump.size):
            break
        jump = closer
    return jump


def _centre(contrast: Array, group: NDArray[np.intp]) -> int:
    strength = np.abs(contrast[group])
    return int(np.median(group[strength > 0.98 * strength.max()]))


def _test_jump(values: Array, centre: int, noise: Noise, width: int, smallest: float) -> ForceJump | None:
    gap, reach = (3 * width) // 2, 6 * width
    left_start, left_stop = max(0, centre - reach), centre - gap
    right_start, right_stop = centre + gap, min(values.size, centre + reach)
    if left_stop - left_start < width or right_stop - right_start < width:
        return None
    before = _line(values, left_start, left_stop)
    after = _line(values, right_start, right_stop)
    size = after(centre) - before(centre)
    if abs(size) < max(5 * 2.8 * noise.of_mean(min(left_stop - left_start, right_stop - right_start)), smallest):
        return None
    places = np.arange(left_stop, right_start)
    fraction = (values[left_stop:right_start] - before(places)) / size
    crossing = int(np.argmax(fraction > 0.5))
    below = np.flatnonzero(fraction[: crossing + 1] < 0.1)
    above = np.flatnonzero(fraction[crossing:] > 0.9)
    start = int(places[below[-1]]) if below.size else left_stop
    stop = max(int(places[crossing + above[0]]) if above.size else right_start, start + 1)
    steepest = max(abs(float(line.deriv()(centre))) for line in (before, after))
    if abs(size) < 2 * steepest * (stop - start):  # a kink: the slopes on either side explain the change
        return None
    for line, window in ((before, (left_start, left_stop)), (after, (right_start, right_stop))):
        if _misfit(values, line, *window) > max(3 * noise.sigma, 0.15 * abs(size)):  # another jump is in the way
            return None
    return ForceJump(start, stop, float(before(start)), float(after(stop)), float(before.deriv()(start)))


def _misfit(values: Array, line: np.polynomial.Polynomial, start: int, stop: int) -> float:
    return float(np.std(values[start:stop] - line(np.arange(start, stop, dtype=np.float64))))


def _line(values: Array, start: int, stop: int) -> np.polynomial.Polynomial:
    return np.polynomial.Polynomial.fit(np.arange(start, stop, dtype=np.float64), values[start:stop], 1)
