"""Whether the stated uncertainties are true: random synthetic tests, bias and coverage of each feature."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.pipeline import analyze
from analysis.run import Run, Sensors
from analysis.synthetic import Experiment, Imperfections, Profile, pull_off_run, volume_run
from model import predict
from model.jkr import work_of_adhesion_jkr
from model.parameters import Gas, Membrane, Parameters, Substrate

if TYPE_CHECKING:
    import pandas as pd

SENSORS = Sensors(
    force_gain=2e-3,
    force_linearity=3e-4,
    force_capacity=5.0,
    pressure_gain=2.5e-3,
    pressure_offset=30.0,
    position=1e-4,
    compliance=12e-6,
    compliance_uncertainty=1e-6,
    creep=0.06,
    creep_uncertainty=0.003,
    creep_time=9.0,
    pump_volume=2e-3,
)
"""A good bench; the synthetic tests draw their calibration errors from these standard uncertainties."""

INDENTER = 4e-3

Case = tuple[Run, dict[str, float]]


def _imperfections(generator: np.random.Generator) -> Imperfections:
    normal = generator.normal
    return Imperfections(
        force_noise=float(generator.choice([2e-4, 5e-4, 1e-3])),
        colour=float(generator.choice([0.0, 0.8])),
        drift=4e-6 * normal(),
        wander=3e-4,
        bow=(SENSORS.force_linearity * normal(), SENSORS.force_linearity * normal()),
        bow_load=SENSORS.force_capacity * 0.005 * 2 ** float(generator.uniform(-1, 1)),
        force_gain=SENSORS.force_gain * normal(),
        pressure_gain=SENSORS.pressure_gain * normal(),
        pressure_offset=SENSORS.pressure_offset * normal(),
        position_gain=SENSORS.position * normal(),
        compliance=SENSORS.compliance + SENSORS.compliance_uncertainty * normal(),
        creep=SENSORS.creep + SENSORS.creep_uncertainty * normal(),
        creep_time=SENSORS.creep_time,
        resolution=1.5e-4,
    )


def pull_off_case(seed: int) -> Case:
    """Return a random pull-off test: substrate, membrane, P_0, speed, rate, instruments; and the truth."""
    generator = np.random.default_rng([seed, 11])
    while True:
        diameter = float(generator.choice([15e-3, 30e-3, 60e-3, 0.0]))
        parameters = Parameters(
            Substrate("sphere", diameter) if diameter else Substrate("flat"),
            membrane=Membrane(
                work_of_adhesion=generator.uniform(2, 6), youngs_modulus=generator.uniform(1.6, 2.4) * 1e6
            ),
            gas=Gas(initial_pressure=generator.uniform(-2000, 1500)),
        )
        prediction = predict(parameters, points=4000)
        if prediction.pull_off_force > 0.03:
            break
    experiment = Experiment(
        rate=float(generator.choice([500, 1000])),
        retract_speed=float(generator.choice([20e-6, 50e-6])),
        snap=float(generator.choice([0.0, 0.01])),
    )
    flaws = _imperfections(generator)
    phase = float(generator.uniform())
    profile = Profile.of(prediction)
    return pull_off_run(profile, experiment, flaws, seed=seed, sensors=SENSORS, parameters=parameters, phase=phase)


def indentation_case(seed: int) -> Case:
    """Return a random JKR test and its truth, work of adhesion included."""
    generator = np.random.default_rng([seed, 12])
    work, modulus = generator.uniform(2, 6), generator.uniform(1, 3) * 1e6
    profile = Profile.jkr(work, INDENTER, modulus, 0.095)
    experiment = Experiment(
        retract_speed=10e-6,
        preload=0.1,
        approach_stiffness=20000.0,
        settle=1.5,
        snap=0.002,  # its force vanishes with its area
        settings={"indenter_radius_mm": 4.0},
    )
    flaws = replace(_imperfections(generator), force_noise=2e-4)
    phase = float(generator.uniform())
    run, truth = pull_off_run(profile, experiment, flaws, seed=seed, sensors=SENSORS, phase=phase)
    truth = {name: truth[name] for name in ("pull_off_force_N", "pull_off_distance_m")}
    truth["work_of_adhesion_J_m2"] = work_of_adhesion_jkr(truth["pull_off_force_N"], INDENTER)
    return replace(run, protocol="indentation", pressure=None), truth


def volume_case(seed: int) -> Case:
    """Return a random measurement of V_0 and its truth."""
    generator = np.random.default_rng([seed, 13])
    volume = generator.uniform(5e-6, 10e-6)
    run = volume_run(
        volume,
        gain=SENSORS.pressure_gain * generator.normal(),
        offset=SENSORS.pressure_offset * generator.normal(),
        pump_gain=SENSORS.pump_volume * generator.normal(),
        seed=seed,
        sensors=SENSORS,
    )
    return run, {"chamber_volume_m3": float(volume)}


CASES = {"pull_off": pull_off_case, "indentation": indentation_case, "volume": volume_case}


def deviations(kind: str, seeds: Iterable[int]) -> dict[str, list[float]]:
    """Return (measured - true) / stated uncertainty for each feature; ``nan`` where it is missing."""
    found: dict[str, list[float]] = {}
    for seed in seeds:
        run, truth = CASES[kind](seed)
        features = analyze(run).features
        for name, true in truth.items():
            score = (features.value(name) - true) / features.uncertainty(name) if name in features else np.nan
            found.setdefault(name, []).append(score)
    return found


def coverage(kind: str, seeds: Iterable[int]) -> pd.DataFrame:
    """Return the summary of ``deviations``."""
    return summary(deviations(kind, seeds))


def summary(found: Mapping[str, list[float]]) -> pd.DataFrame:
    """Return, per feature: how many tests, share within one standard uncertainty, mean and spread of the deviations."""
    import pandas as pd

    rows = []
    for name, listed in found.items():
        scores = np.array(listed)
        good = scores[np.isfinite(scores)]
        inside = float(np.mean(np.abs(good) < 1))
        rows.append((name, good.size, scores.size - good.size, inside, float(good.mean()), float(good.std(ddof=1))))
    columns = ["feature", "tests", "missing", "within_one_uncertainty", "mean_deviation", "spread"]
    return pd.DataFrame(rows, columns=columns)
