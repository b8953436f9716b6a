"""Runs with known truth: a profile put through stage, load train, sensors and noise. They check the analysis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from analysis.creep import delayed
from analysis.numerics import Array
from analysis.run import Run, Sensors, Step
from model.jkr import jkr_curve
from model.parameters import STANDARD_ATMOSPHERE, Parameters
from model.prediction import Prediction


@dataclass(frozen=True)
class Profile:
    """Force and pressure against retraction up to the last stable contact; z_r rises strictly."""

    retraction: Array
    force: Array
    pressure: Array

    @classmethod
    def of(cls, prediction: Prediction, compression: float = 0.4) -> Self:
        """Take the stable part of a prediction, from where the compression has fallen to ``compression`` (N)."""
        order = np.flatnonzero(prediction.stable)
        keep = order[np.concatenate([[True], np.diff(np.maximum.accumulate(prediction.retraction[order])) > 0])]
        keep = keep[int(np.argmax(prediction.force[keep] < compression)) :]
        return cls(prediction.retraction[keep], prediction.force[keep], prediction.pressure[keep])

    @classmethod
    def jkr(cls, work_of_adhesion: float, radius: float, modulus: float, preload: float, points: int = 4000) -> Self:
        """Return the unloading of a JKR contact from ``preload`` (N); no pressure."""
        hertz = float(np.cbrt(3 * preload * radius / (4 * modulus)))
        curve = jkr_curve(work_of_adhesion, radius, modulus, largest_contact=3 * hertz, points=3 * points)
        part = curve.force < preload
        return cls(-curve.indentation[part], curve.force[part], np.zeros(int(part.sum())))


@dataclass(frozen=True, slots=True)
class Imperfections:
    """What the instruments add. SI units; ``gain`` errors are relative.

    Attributes
    ----------
    force_noise, pressure_noise
        White noise of one sample.
    colour
        Correlation of successive force samples' noise (AR(1) coefficient), 0 for white.
    drift, wander
        Drift of the zero of force, N/s, and the amplitude of its slow waves (about 200, 600 and 1800 s), N.
    creep, creep_time
        Share of a compression that the load train loses to the reading, and the time constant, s (``analysis.creep``).
    bow, bow_load
        What the calibration line is out by under tension and under compression, N, and the load by which it has grown
        to 63 per cent of that, N.
    force_gain, pressure_gain, position_gain
        Errors of the calibrations.
    pressure_offset
        Error of the pressure zero.
    compliance
        True compliance of the load train, m/N.
    resolution
        Least count of the force, N.
    """

    force_noise: float = 1e-3
    pressure_noise: float = 15.0
    colour: float = 0.0
    drift: float = 0.0
    wander: float = 0.0
    creep: float = 0.0
    creep_time: float = 9.0
    bow: tuple[float, float] = (0.0, 0.0)
    bow_load: float = 0.025
    force_gain: float = 0.0
    pressure_gain: float = 0.0
    pressure_offset: float = 0.0
    position_gain: float = 0.0
    compliance: float = 0.0
    resolution: float = 0.0


@dataclass(frozen=True)
class Experiment:
    """How the synthetic test is driven: speeds in m/s, times in s, preload in N."""

    rate: float = 1000.0
    approach_speed: float = 100e-6
    retract_speed: float = 10e-6
    preload: float = 0.5
    tare: float = 2.0
    dwell: float = 5.0
    settle: float = 3.0
    tail: float = 5.0
    clearance: float = 0.5e-3
    approach_stiffness: float = 900.0
    relaxation: float = 0.1
    relaxation_time: float = 3.0
    snap: float = 0.0
    settings: Mapping[str, float | str] = field(default_factory=dict)


def pull_off_run(
    profile: Profile,
    experiment: Experiment | None = None,
    imperfections: Imperfections | None = None,
    *,
    seed: int = 0,
    sensors: Sensors | None = None,
    parameters: Parameters | None = None,
    phase: float = 0.5,
) -> tuple[Run, dict[str, float]]:
    """Make one run and say what a perfect analysis would find in it.

    Parameters
    ----------
    profile
        The force the sample puts on the gripper during retraction; its first point is where the retraction starts.
    seed
        Of the noise.
    phase
        Where between two samples the detachment falls, 0...1.

    Returns
    -------
    tuple
        The run, and the true features by name.
    """
    test, flaws = experiment or Experiment(), imperfections or Imperfections()
    generator = np.random.default_rng(seed)
    segments = _segments(profile, test, flaws, phase)
    height = np.concatenate([part for _, part, _, _ in segments])
    force = np.concatenate([part for _, _, part, _ in segments])
    pressure = np.concatenate([part for _, _, _, part in segments])
    steps, start = [], 0
    for name, part, _, _ in segments:
        steps.append(Step(name, start, start + part.size))
        start += part.size
    time = np.arange(force.size) / test.rate
    measured = force - flaws.creep * delayed(force, 1 / test.rate, flaws.creep_time)
    measured = measured + np.where(force < 0, *flaws.bow) * -np.expm1(-np.abs(force) / flaws.bow_load)
    measured = (
        measured * (1 + flaws.force_gain) + 0.05 + _drift(generator, time, flaws) + _noise(generator, force.size, flaws)
    )
    if flaws.resolution:
        measured = np.round(measured / flaws.resolution) * flaws.resolution
    run = Run(
        name=f"synthetic-{seed}",
        protocol="pull_off",
        rate=test.rate,
        force=measured,
        pressure=pressure * (1 + flaws.pressure_gain)
        + flaws.pressure_offset
        + generator.normal(0, 1, force.size) * flaws.pressure_noise,
        height=height * (1 + flaws.position_gain) + 5e-3,
        steps=tuple(steps),
        parameters=parameters,
        sensors=sensors or Sensors(),
        settings=dict(test.settings),
    )
    return run, _truth(profile, test, flaws.compliance, phase)


def _segments(
    profile: Profile, test: Experiment, flaws: Imperfections, phase: float
) -> list[tuple[str, Array, Array, Array]]:
    """Return (step, stage height, true force, true pressure) for each segment; contact is at separation 0."""
    dt, compliance = 1 / test.rate, flaws.compliance
    reach = (test.preload / test.approach_stiffness) ** (2 / 3) * 1e-2
    lowest = -reach - test.preload * compliance
    down = np.arange(test.clearance, lowest, -test.approach_speed * dt)
    depth = np.linspace(0, reach * 1.001, 4000)
    law = test.preload * (depth / reach) ** 1.5
    force_down = np.interp(-down, depth + law * compliance, law, left=0.0)
    rest = np.arange(round(test.dwell * test.rate)) * dt
    relaxing = test.preload * (1 - test.relaxation * (1 - np.exp(-rest / test.relaxation_time)))
    settle = np.arange(round(test.settle * test.rate)) * dt
    ramp = np.clip(settle / max(test.settle - 1.0, dt), 0, 1)
    start_force, start_pressure = float(profile.force[0]), float(profile.pressure[0])
    shift = profile.retraction - profile.force * compliance
    shift = shift - shift[0] + down[-1]
    if np.any(np.diff(shift) <= 0):
        keep = np.concatenate([[True], np.diff(np.maximum.accumulate(shift)) > 0])
    else:
        keep = np.ones(shift.size, dtype=bool)
    step = test.retract_speed * dt
    up = shift[keep][-1] - step * (np.arange(int((shift[keep][-1] - shift[0]) / step), -1, -1) + phase)
    up = up[up >= shift[0]]
    force_up = np.interp(up, shift[keep], profile.force[keep])
    pressure_up = np.interp(up, shift[keep], profile.pressure[keep])
    tail = up[-1] + step * np.arange(1, round(test.tail * test.rate) + 1)
    snap = np.zeros(tail.size)
    length = round(test.snap * test.rate)
    snap[:length] = force_up[-1] * (1 - (np.arange(length) + 1) / (length + 1))
    back = np.arange(tail[-1], test.clearance + 1e-3, 500e-6 * dt)
    zero = np.zeros
    still = np.full
    return [
        (
            "tare",
            still(round(test.tare * test.rate), test.clearance),
            zero(round(test.tare * test.rate)),
            zero(round(test.tare * test.rate)),
        ),
        ("approach", down, force_down, zero(down.size)),
        ("dwell", still(rest.size, down[-1]), relaxing, zero(rest.size)),
        (
            "pressurize",
            still(settle.size, down[-1]),
            relaxing[-1] + (start_force - relaxing[-1]) * ramp,
            start_pressure * ramp,
        ),
        ("retract", up, force_up, pressure_up),
        ("pull-off", tail, snap, still(tail.size, pressure_up[-1])),
        ("return", back, zero(back.size), still(back.size, pressure_up[-1])),
    ]


def _drift(generator: np.random.Generator, time: Array, flaws: Imperfections) -> Array:
    drift = flaws.drift * time
    for period in (197.0, 611.0, 1789.0):
        phase = generator.uniform(0, 2 * np.pi)
        drift = drift + flaws.wander * generator.normal() * np.sin(2 * np.pi * time / period + phase)
    return np.asarray(drift, dtype=np.float64)


def _noise(generator: np.random.Generator, count: int, flaws: Imperfections) -> Array:
    from scipy.signal import lfilter

    white = generator.normal(0, 1, count) * flaws.force_noise
    if not flaws.colour:
        return white
    scale = float(np.sqrt(1 - flaws.colour**2))
    return np.asarray(lfilter([scale], [1, -flaws.colour], white), dtype=np.float64)


def _truth(profile: Profile, test: Experiment, compliance: float, phase: float) -> dict[str, float]:
    """The contact is lost at the end of the snap; till then the stage goes on and the load train springs back."""
    force, place = profile.force, profile.retraction
    lowest = int(np.argmin(force))
    compressed = np.flatnonzero(force[: lowest + 1] > 0)
    if compressed.size:
        first = int(compressed[-1])
        zero = float(np.interp(0.0, -force[first : first + 2], place[first : first + 2]))
    else:
        zero = float(place[0])
    tense = place >= zero
    path = np.concatenate([[zero], place[tense]])
    pull = np.concatenate([[float(np.interp(zero, place, force))], force[tense]])
    snap = round(test.snap * test.rate)
    further = (snap + 1 - phase) * test.retract_speed / test.rate - compliance * float(force[-1]) if snap else 0.0
    return {
        "pull_off_force_N": -float(force.min()),
        "pull_off_distance_m": float(place[-1]) + further - zero,
        "retraction_at_pull_off_m": float(place[lowest]) - zero,
        "preload_N": test.preload,
        "initial_pressure_Pa": float(profile.pressure[0]),
        "pressure_at_pull_off_Pa": float(profile.pressure[lowest]),
        "adhesion_energy_J": -float(np.trapezoid(pull, path)) - float(force[-1]) * further / 2,
    }


def volume_run(
    volume: float,
    *,
    rate: float = 200.0,
    pressure_noise: float = 10.0,
    gain: float = 0.0,
    offset: float = 0.0,
    pump_gain: float = 0.0,
    seed: int = 0,
    sensors: Sensors | None = None,
    parameters: Parameters | None = None,
) -> Run:
    """Make a run of the protocol ``volume``: the pump moves 0.3 ml out and in again, the chamber follows Boyle's law.

    Parameters
    ----------
    volume
        True V_0, m^3.
    gain, offset, pump_gain
        Errors of the pressure's sensitivity (relative), its zero (Pa) and the pump's volume (relative).
    """
    generator = np.random.default_rng(seed)
    there = np.linspace(0.0, -0.3e-6, round(20 * rate))
    moved = np.concatenate([there, there[::-1]])
    gas = STANDARD_ATMOSPHERE * moved / (volume - moved)
    return Run(
        name=f"volume-{seed}",
        protocol="volume",
        rate=rate,
        force=generator.normal(0, 1e-3, moved.size),
        pressure=gas * (1 + gain) + offset + generator.normal(0, pressure_noise, moved.size),
        height=np.zeros(moved.size),
        steps=(Step("pump", 0, moved.size),),
        parameters=parameters,
        sensors=sensors or Sensors(),
        pump_volume=moved * (1 + pump_gain),
    )
