"""Honeywell HSC....600MDAA5 (in any package): +-600 mbar gauge, 10 to 90 % of its supply, ratiometric.

    P = ((V / Vs - 0.1) / 0.8) * 1200 mbar - 600 mbar          (TruStability HSC series, transfer function A)

Vs is acquired on a channel of its own and averaged over the last 100 ms, so that its noise is not added to the
signal's. The average is kept in whole numbers: a stream gives the same bits however it is cut into frames.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.flags import Array, Reading, SensorFlags

MILLIBAR = 100.0
"""Pa."""

FULL_SCALE = 600 * MILLIBAR
TOTAL_ERROR_BAND = 12 * MILLIBAR
"""1 % of the span of 1200 mbar, 0...50 degC: offset, span and thermal errors."""

CALIBRATED = (0.10, 0.90)
CLIPPED = (0.025, 0.975)
ALIVE = (0.02, 0.98)
CLIP_MARGIN = 0.001
SUPPLY = (4.75, 5.25)
SUPPLY_STEP = 0.05
"""V from its own mean."""
SUPPLY_LOST = 1.5
"""V; below it there is no supply (0 V) or its wire is open (1.4 V on a USB-6008/6009)."""

OPEN_INPUT = 1.398
"""V; an open input of a USB-6008/6009 sits on a divider of 30.9 k and 39.2 k from 2.5 V (NI user guide)."""
OPEN_INPUT_TOLERANCE = 0.02

Flags = NDArray[np.int64]

_SLOPE, _MIDDLE = 2.5 * FULL_SCALE, 1.25 * FULL_SCALE  # P = 150 kPa V / Vs - 75 kPa


class HoneywellHSC:
    """One sensor and its supply; keeps the last 100 ms of both.

    Parameters
    ----------
    name
        The sensor as the operator knows it.
    rate
        Sample rate, Hz.
    averaging
        Time over which the supply is averaged, s.
    quietest
        rms noise of the signal below which an input at 1.398 V is taken for open, V; ``None`` switches the test off.
        A live sensor's own noise is larger than that of the converter alone: measure both on the rig.
    zero
        What the sensor reads with port 1 open to the room, Pa; it is subtracted.
    slope, intercept
        Of a calibration against a standard: true Pa = slope * (P - zero) + intercept.
    """

    def __init__(
        self,
        name: str = "pressure sensor",
        *,
        rate: float,
        averaging: float = 0.1,
        quietest: float | None = 2e-4,
        zero: float = 0.0,
        slope: float = 1.0,
        intercept: float = 0.0,
    ) -> None:
        window = round(averaging * rate) if averaging >= 0.05 and rate > 0 else 0
        if window < 1:
            raise ValueError(f"{name}: averaging {averaging} s at {rate} Hz; it must be at least 0.05 s and one sample")
        self.name = name
        self._quietest = quietest
        self._slope = slope * _SLOPE
        self._middle = slope * (_MIDDLE + zero) - intercept
        self._window = window
        self._supply = _RunningMean(window)
        self._past_signal = np.empty(0)

    def convert(self, signal: Array, supply: Array) -> Reading:
        """Return the gauge pressure (n,) in Pa and what was wrong.

        Values are kept out of range and when saturated (a bound), NaN where nothing can be said: no supply, wiring,
        open wire.

        Parameters
        ----------
        signal, supply
            V, (n,), the next n samples of the stream.
        """
        if not signal.size:
            return Reading(np.empty(0), SensorFlags.NONE)
        mean = self._supply.take(supply)
        past = self._remember(signal)
        if _is_sound(signal, supply, mean):
            return Reading(self._pressure(signal, mean), SensorFlags.NONE)
        return self._convert_doubtful(signal, supply, mean, past)

    def _remember(self, signal: Array) -> Array:
        """Return the samples before this block, as many as the open-wire test looks back."""
        past = self._past_signal
        self._past_signal = np.concatenate((past, signal))[-self._window :]
        return past

    def _pressure(self, signal: Array, supply: Array) -> Array:
        pressure: Array = signal / supply * self._slope - self._middle
        return pressure

    def _convert_doubtful(self, signal: Array, supply: Array, mean: Array, past: Array) -> Reading:
        with np.errstate(over="ignore"):
            positive = np.where(mean > 0, mean, np.nan)
            pressure = self._pressure(signal, positive)
            faults = _faults(signal, supply, mean, signal / positive)
        faults[self._still(past, signal)] |= int(SensorFlags.OPEN_WIRE)
        pressure[(faults & _MEANINGLESS) != 0] = np.nan
        return Reading(pressure, SensorFlags(int(np.bitwise_or.reduce(faults))))

    def _still(self, past: Array, signal: Array) -> NDArray[np.bool_]:
        """Whether the last 100 ms up to each sample lay without a sensor's noise where an open input lies, (n,)."""
        result = np.zeros(signal.size, bool)
        joined = np.concatenate((past, signal))
        if self._quietest is None or joined.size < self._window:
            return result
        windows = np.lib.stride_tricks.sliding_window_view(joined - OPEN_INPUT, self._window)[-signal.size :]
        near = np.abs(windows).max(axis=1) < OPEN_INPUT_TOLERANCE
        quiet = np.zeros(len(windows), bool)
        quiet[near] = [np.std(window) < self._quietest for window in windows[near]]
        result[-len(windows) :] = quiet
        return result


_MEANINGLESS = int(
    SensorFlags.INVALID
    | SensorFlags.SUPPLY_LOST
    | SensorFlags.SUPPLY_RANGE
    | SensorFlags.WIRING
    | SensorFlags.OPEN_WIRE
)


def _is_sound(signal: Array, supply: Array, mean: Array) -> bool:
    """Whether a block is so far from every limit that no sample of it needs a closer look (false for NaN)."""
    low, high = np.minimum.reduce(supply), np.maximum.reduce(supply)
    least, most = np.minimum.reduce(mean), np.maximum.reduce(mean)
    bottom, top = np.minimum.reduce(signal), np.maximum.reduce(signal)
    return bool(
        SUPPLY[0] <= min(low, least)
        and max(high, most) <= SUPPLY[1]
        and max(high - least, most - low) <= SUPPLY_STEP
        and (CALIBRATED[0] + 1e-9) * most <= bottom
        and top <= (CALIBRATED[1] - 1e-9) * least
        and (bottom > OPEN_INPUT + OPEN_INPUT_TOLERANCE or top < OPEN_INPUT - OPEN_INPUT_TOLERANCE)
    )


def _faults(signal: Array, supply: Array, mean: Array, part: Array) -> Flags:
    """Return the flags of every sample, (n,)."""
    flags = np.zeros(signal.size, np.int64)
    for condition, flag in (
        (~np.isfinite(signal) | ~np.isfinite(supply), SensorFlags.INVALID),
        ((supply < SUPPLY_LOST) | (mean < SUPPLY_LOST), SensorFlags.SUPPLY_LOST),
        (_outside(mean, SUPPLY) | _outside(supply, SUPPLY), SensorFlags.SUPPLY_RANGE),
        (np.abs(supply - mean) > SUPPLY_STEP, SensorFlags.SUPPLY_STEP),
        (_outside(part, ALIVE), SensorFlags.WIRING),
        (_outside(part, CLIPPED, CLIP_MARGIN), SensorFlags.CLIPPED),
        (_outside(part, CALIBRATED), SensorFlags.OVER_RANGE),
    ):
        flags[condition] |= int(flag)
    return flags


def _outside(values: Array, limits: tuple[float, float], margin: float = 0.0) -> NDArray[np.bool_]:
    return (values < limits[0] + margin) | (values > limits[1] - margin)


class _RunningMean:
    """Mean of the last ``window`` samples (fewer at the beginning), exact in any cut.

    Volts become whole numbers of 2**-20 V (1 microvolt), whose sums do not depend on the order of adding; they are
    summed from the beginning, which 63 bits allow for 10**11 samples.
    """

    _SCALE = 2.0**20
    _LIMIT = 20.0  # V

    def __init__(self, window: int) -> None:
        self._window = window
        self._sums = np.zeros(self._window + 1, np.int64)  # of all samples up to each of the last ones
        self._seen = 0

    def take(self, volts: Array) -> Array:
        """Return the mean (V) at each of the next samples."""
        bounded = np.fmax(np.fmin(volts, self._LIMIT), -self._LIMIT)  # a NaN becomes a number, flagged elsewhere
        counts = np.rint(bounded * self._SCALE).astype(np.int64)
        counts[0] += self._sums[-1]
        sums = np.concatenate((self._sums, np.add.accumulate(counts)))
        last, first = sums[self._window + 1 :], sums[1 : volts.size + 1]
        mean: Array = (last - first) / (self._number(volts.size) * self._SCALE)
        self._sums = sums[-self._window - 1 :]
        self._seen += volts.size
        return mean

    def _number(self, samples: int) -> Array | int:
        """How many samples each mean is over."""
        if self._seen >= self._window:
            return self._window
        return np.minimum(np.arange(self._seen + 1, self._seen + samples + 1), self._window)
