"""Volume and tightness of the chamber: V_0 from Boyle's law, and the leak rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.errors import FeatureMissing
from analysis.extraction import Details, Extraction, extraction_step
from analysis.numerics import Array, block_means
from model.parameters import STANDARD_ATMOSPHERE


@dataclass(frozen=True)
class BoyleFit:
    """V_0 from pump volume against pressure.

    Attributes
    ----------
    volume, uncertainty
        V_0 and its standard uncertainty from the scatter, m^3.
    offset
        Pump volume at which P_a would be zero, m^3.
    residual
        (n,), m^3, of the fitted points.
    """

    volume: float
    uncertainty: float
    offset: float
    residual: Array


def fit_boyle(
    pumped: Array, pressure: Array, atmosphere: float = STANDARD_ATMOSPHERE, interval: float | None = None
) -> BoyleFit:
    """Fit V_0 to the volume the pump has put in and the pressure that followed, chamber closed and out of contact.

    Isothermal: (P_atm + P_a) (V_0 - dV) = P_atm V_0 with dV the volume the plunger has moved in, so that
    dV = V_0 P_a / (P_atm + P_a) + offset: a straight line whose slope is V_0.

    Parameters
    ----------
    pumped
        (n,), m^3, moved into the chamber.
    pressure
        (n,), Pa gauge.
    interval
        Time between the points, s. Given, a leak proportional to P_a is fitted beside V_0 (what has left by then is the
        integral of P_a over its time constant, times V_0), and the time by which the pressure lags behind the pump in
        tubing and sensor: without that the fit would take a stroke's lag for a leak.

    Raises
    ------
    FeatureMissing
        The pressure hardly changed.
    """
    share = pressure / (atmosphere + pressure)
    if pumped.size < 8 or float(np.ptp(share)) < 1e-4:
        raise FeatureMissing("the pressure changed by less than ten pascals; nothing to fit")
    columns = [share, np.ones_like(share)]
    if interval is not None:
        lost = np.concatenate([[0.0], np.cumsum((pressure[1:] + pressure[:-1]) / 2)]) * interval
        scaled = lost / (atmosphere + pressure)
        columns += [_of_unit_size(scaled), _of_unit_size(np.gradient(pumped))]
    design = np.stack(columns, axis=1)
    solution, _, _, _ = np.linalg.lstsq(design, pumped, rcond=None)
    residual = np.asarray(pumped - design @ solution, dtype=np.float64)
    variance = float(residual @ residual) / (pumped.size - design.shape[1])
    covariance = np.linalg.inv(design.T @ design) * variance
    return BoyleFit(float(solution[0]), float(np.sqrt(covariance[0, 0])), float(solution[1]), residual)


def _of_unit_size(column: Array) -> Array:
    return column / max(float(np.abs(column).max()), 1e-30)


@extraction_step(
    "volume",
    title="Chamber volume",
    protocols=("volume",),
    gives={"chamber_volume_m3": "V_0 from pump volume against pressure (Boyle)"},
    after=("segments",),
)
def volume(work: Extraction) -> Details:
    """Fit dV = V_0 P_a / (P_atm + P_a), with a leak and a lag of the pressure, to 50 ms means of the whole record.

    Temperature is taken as constant: the pump must move slowly, or wait.
    """
    run = work.run
    if run.pump_volume is None or run.pressure is None:
        raise FeatureMissing("the recording holds no pump volume or no pressure")
    atmosphere = STANDARD_ATMOSPHERE if run.parameters is None else run.parameters.gas.atmospheric_pressure
    length = work.samples(0.05, least=1)
    fit = fit_boyle(
        block_means(run.pump_volume, length), block_means(run.pressure, length), atmosphere, length / run.rate
    )
    work.set(chamber_volume_m3=fit.volume)
    return {"decision": f"V_0 = {fit.volume * 1e6:.3f} mL", "fit": fit}


@dataclass(frozen=True, slots=True)
class Leak:
    """Exponential decay of the pressure towards the room.

    Attributes
    ----------
    time_constant
        s; infinite for a tight chamber.
    rate
        Pa/s at the start: P_a / time constant.
    flow
        The same as a volume flow at room pressure, m^3/s, with V_0.
    """

    time_constant: float
    rate: float
    flow: float


def fit_leak(time: Array, pressure: Array, volume: float, atmosphere: float = STANDARD_ATMOSPHERE) -> Leak:
    """Fit P_a = P_1 exp(-t / tau): flow through a leak is proportional to the pressure difference.

    Parameters
    ----------
    time, pressure
        (n,), s and Pa gauge, chamber closed, pump at rest.
    volume
        V_0, m^3.
    """
    from scipy.optimize import least_squares

    span = float(time[-1] - time[0])
    level = float(pressure[: max(1, pressure.size // 20)].mean())
    slope = float(np.polyfit(time - time[0], pressure, 1)[0])
    scale = max(abs(level), 1.0)

    def residual(unknown: Array) -> Array:
        decayed = unknown[0] * np.exp(-unknown[1] * (time - time[0]) / span)
        return np.asarray(decayed - pressure / scale, dtype=np.float64)

    guess = [level / scale, -slope * span / level if level else 0.0]
    first, decay = least_squares(residual, guess).x
    rate = float(first * scale * decay / span)
    constant = float(span / decay) if decay else float("inf")
    return Leak(constant, rate, rate * volume / atmosphere)


@extraction_step(
    "leak",
    title="Leak",
    protocols=("leak",),
    gives={
        "leak_rate_Pa_s": "speed at which P_a nears the room's pressure at the start of the hold",
        "leak_time_constant_s": "time in which the pressure falls to 1/e",
        "leak_flow_m3_s": "the same as volume flow at room pressure",
    },
    after=("segments",),
)
def leak(work: Extraction) -> Details:
    """Fit an exponential decay to the pressure of the ``hold`` (or ``dwell``) step, in 100 ms means."""
    run = work.run
    step = run.step("hold") or run.step("dwell")
    if run.pressure is None or step is None:
        raise FeatureMissing("the recording holds no pressure or no hold step")
    if run.parameters is None:
        raise FeatureMissing("without parameters the chamber volume is unknown")
    length = work.samples(0.1, least=1)
    time, gas = (block_means(signal[step.start : step.stop], length) for signal in (run.time, run.pressure))
    volume, atmosphere = run.parameters.gripper.chamber_volume, run.parameters.gas.atmospheric_pressure
    found = fit_leak(time, gas, volume, atmosphere)
    values = {
        "leak_rate_Pa_s": abs(found.rate),
        "leak_time_constant_s": found.time_constant,
        "leak_flow_m3_s": abs(found.flow),
    }
    work.set(**values)
    unsure = _disagreement(time, gas, found)
    work.stated.update({name: unsure * abs(value) for name, value in values.items()})
    return {"decision": f"tau = {found.time_constant:.3g} s; its halves differ by {2 * unsure:.1%}", "leak": found}


def _disagreement(time: Array, pressure: Array, whole: Leak) -> float:
    """Half the difference between the leak in the first and the second half, relative: drift of the sensor looks so."""
    middle = time.size // 2
    first, second = (fit_leak(time[part], pressure[part], 1.0) for part in (slice(middle), slice(middle, None)))
    at_start = second.rate * float(np.exp((time[middle] - time[0]) / whole.time_constant))
    return abs(first.rate - at_start) / 2 / abs(whole.rate) if whole.rate else 0.0
