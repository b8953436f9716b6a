"""Work and precision of the membrane solver, and how it ends in the extremes."""

from __future__ import annotations

import functools
import math
import time
from typing import Any, NamedTuple

import numpy as np

from analysis.accuracy.membrane_reference import Problem, Shot, collocated, highest, shoot
from analysis.accuracy.plots import work_precision
from analysis.accuracy.section import Progress, Section
from analysis.accuracy.timing import Timing, timed
from model import Gas, GasAnchor, Gripper, Membrane, ModelError, Parameters, Substrate, membrane
from model.membrane_branch import Counter, release_state
from model.membrane_equilibrium import Closure, remaining_step, resample, shape, solve
from model.membrane_path import Memory
from model.parameters import ContactStretch
from model.prediction import Outcome

FLAT = Parameters(Substrate("flat"), gas=Gas(-1000.0))
SPHERE = Parameters(Substrate("sphere", 60e-3), gas=Gas(-3200.0))
STATES = {
    "flat, -1 kPa, a = 6 mm": (FLAT, 0.75, (0.45, -0.06)),
    "flat, -1 kPa, a = 2 mm": (FLAT, 0.25, (0.45, -0.1)),
    "60 mm sphere, -3.2 kPa, a = 5 mm": (SPHERE, 0.625, (0.6, -0.2)),
}
"""Scene, contact radius over R_0 and a guess of peel angle and pressure."""
ORDERS = (3, 4, 6, 8, 10, 12, 16, 20)
TOLERANCES = (1e-3, 1e-4, 1e-6, 1e-8, 1e-10)
ERRORS = (("error_force", "relative error of the pull"), ("error_height", "relative error of the height"))
FEATURES = (("error_force", "relative error of F_p"), ("error_height", "relative error of z at detachment"))
SCENES = 1000
KNOWN = tuple(outcome.value for outcome in Outcome)


def sections(quick: bool, progress: Progress) -> list[Section]:
    """Return work-precision of single states, of the whole profile, and the extreme scenes."""
    states = list(STATES.items())[: 1 if quick else None]
    return [
        *(_one_state(name, *case, quick, progress) for name, case in states),
        _profile(quick, progress),
        _extremes(quick, progress),
    ]


def _row(method: str, setting: str, value: Shot, truth: Shot, timing: Timing, evaluations: int) -> dict[str, Any]:
    return {
        "method": method,
        "setting": setting,
        "evaluations": evaluations,
        **timing.columns(),
        "error_force": abs(value.pull / truth.pull - 1),
        "error_height": abs(value.height / truth.height - 1),
    }


def _one_state(
    name: str, scene: Parameters, a: float, guess: tuple[float, float], quick: bool, progress: Progress
) -> Section:
    import pandas as pd

    progress(f"membrane, {name}: reference")
    problem = Problem.of(scene)
    truth, other = shoot(problem, a, guess), shoot(problem, a, guess, 1e-11)
    repeats = 5 if quick else 15
    rows = []
    annulus, nearby = (
        membrane.scene(scene.with_changes(initial_pressure=pressure), ContactStretch.PROJECTED).annulus
        for pressure in (scene.gas.initial_pressure, 0.9 * scene.gas.initial_pressure)
    )
    width = np.array([-math.log(a)])
    start = release_state(nearby, float(width[0]), Counter()).state
    assert start is not None
    for order in ORDERS:
        progress(f"membrane, {name}: collocation of order {order}")

        solved, timing = timed(functools.partial(solve, annulus, width, resample(start, order)), repeats)
        value = Shot(float(shape(annulus, width, solved.state).height[0]), float(solved.state[0, -1]), 0.0)
        rows.append(_row("collocation", f"N = {order}", value, truth, timing, solved.evaluations * order))
    for tolerance in TOLERANCES[:3] if quick else TOLERANCES:
        progress(f"membrane, {name}: solve_bvp {tolerance:g}")
        for method, other_solver in (("solve_bvp", collocated), ("shooting, DOP853", shoot)):
            problem.calls[0] = 0
            other_solver(problem, a, guess, tolerance)
            calls = problem.calls[0]
            value, timing = timed(functools.partial(other_solver, problem, a, guess, tolerance), 2 if quick else 5)
            rows.append(_row(method, f"tol = {tolerance:g}", value, truth, timing, calls))
    table = pd.DataFrame(rows)
    place = name.split(" kPa", maxsplit=1)[0].replace(", -", "-minus-").replace(" ", "-")
    key = f"membrane-{place}-kPa-{a * 8:.0f}-mm"
    text = (
        "One peeling state with the chamber gas coupled, E_m 2 MPa, projected stick. Reference: shooting with DOP853 "
        f"at 1e-13, which differs from itself at 1e-11 by {abs(other.pull / truth.pull - 1):.1e}. "
        "Collocation starts from the state at a tenth less pressure, the others from a guess of angle and pressure. "
        "Evaluations are points at which the equations were evaluated, those for finite differences included."
    )
    return Section(
        f"Membrane, one state: {name}",
        text,
        {key: table},
        {key: lambda path: work_precision(table, ERRORS, path)},
        {key: f"Membrane, {name}: work and precision"},
    )


def _profile(quick: bool, progress: Progress) -> Section:
    import pandas as pd

    progress("membrane: reference of the whole profile")
    problem = Problem.of(SPHERE)
    force = highest(problem, lambda shot: shot.pull, (0.82, 0.912), (0.6, -0.2))
    height = highest(problem, lambda shot: shot.height, (0.38, 0.48), (0.6, -0.2))
    truth = Shot(height, force, 0.0)
    rows = []
    for tolerance in (1e-4, 1e-6) if quick else (1e-2, *TOLERANCES):
        for method in ("cold", "warm, pressure 20 Pa away"):
            progress(f"membrane: profile, {method}, {tolerance:g}")
            memory = Memory()
            options: dict[str, Any] = {"points": 60, "contact_stretch": "projected", "tolerance": tolerance}
            if method != "cold":
                options["memory"] = memory
            turns = iter(range(10**6))

            def ours(options: dict[str, Any] = options, turns: Any = turns, method: str = method) -> Any:
                shift = 20.0 * (next(turns) % 2) if method != "cold" else 0.0
                return membrane.solve(SPHERE.with_changes(initial_pressure=-3200.0 + shift), **options)

            _, timing = timed(ours, 4 if quick else 12)
            result = membrane.solve(SPHERE, **options)
            value = Shot(result.detachment_position / problem.length, result.pull_off_force / problem.force_unit, 0.0)
            rows.append(
                _row(method, f"tol = {tolerance:g}", value, truth, timing, result.evaluations["membrane states"])
            )
    table = pd.DataFrame(rows)
    text = (
        "60 mm sphere at -3.2 kPa, projected stick: profile of 60 points with F_p, D_p and everything else a "
        "prediction holds. Reference: Brent's method over shooting solutions, "
        f"F_p = {force * problem.force_unit:.9f} N, detachment at z = {height * problem.length * 1e3:.9f} mm. The "
        "solver resolves further than asked: the tolerance bounds the last term of its series, the error is of the "
        "order of the next."
    )
    key = "membrane-profile"
    return Section(
        "Membrane, whole profile",
        text,
        {key: table},
        {key: lambda path: work_precision(table, FEATURES, path, work="states evaluated")},
        {key: "Membrane, whole profile: work and precision"},
    )


def random_scene(random: np.random.Generator) -> Parameters:
    """Return a scene from far beyond what a laboratory holds."""

    def spread(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    radius = spread(1e-3, 0.1)
    effective = radius * (1.0 if random.random() < 0.1 else random.uniform(0.02, 1))
    substrate = Substrate("flat") if random.random() < 0.3 else Substrate("sphere", spread(1e-3, 1e3))
    pressure = float(random.choice([0.0, random.uniform(-101e3, 2e5), random.choice([-1, 1]) * spread(1, 1e5)]))
    return Parameters(
        substrate,
        Gripper(radius, effective, spread(1e-8, 1.0)),
        Membrane(spread(1e3, 1e9), spread(1e-6, 5e-3), spread(1e-6, 100)),
        Gas(pressure, anchor=GasAnchor(str(random.choice(["free", "vented", "start"], p=[0.6, 0.2, 0.2])))),
    )


class End(NamedTuple):
    """How one scene ended: its outcome or error, the relative errors it states, what Newton would still change."""

    outcome: str
    seconds: float
    error_force: float = math.nan
    error_distance: float = math.nan
    remaining: float = math.nan


def end_of(seed: int) -> End:
    """Solve one random scene. ``remaining`` is the largest Newton step that the states of its profile would take."""
    begin = time.process_time()
    memory, parameters = Memory(), random_scene(np.random.default_rng(seed))
    try:
        result = membrane.solve(parameters, points=60, memory=memory)
    except ModelError as error:
        return End(f"{type(error).__name__}: {str(error).split(':')[-1].strip()[:60]}", time.process_time() - begin)
    seconds = time.process_time() - begin
    if result.outcome is not Outcome.PULL_OFF:
        return End(result.outcome.value, seconds)
    scene = membrane.anchored_scene(parameters, ContactStretch.EML, Counter())
    assert not isinstance(scene, Outcome)
    steps = [
        remaining_step(
            scene.annulus,
            panel.width,
            panel.state,
            Closure.HEIGHT if panel.pinned else Closure.RELEASE,
            panel.coordinate,
        )
        for panel in [*memory.peel, *memory.pinned]
    ]
    stated = result.numerical_error
    return End(
        result.outcome.value,
        seconds,
        stated["pull_off_force"] / result.pull_off_force,
        stated["pull_off_distance"] / result.pull_off_distance,
        float(np.concatenate(steps).max()),
    )


def _extremes(quick: bool, progress: Progress) -> Section:
    import pandas as pd

    size = 4 if quick else SCENES
    ends = []
    for seed in range(size):
        progress(f"membrane: extreme scene {seed + 1} of {size}")
        ends.append(end_of(seed))
    frame = pd.DataFrame(ends)
    seconds = frame.groupby("outcome")["seconds"]
    table = pd.DataFrame({"scenes": seconds.size(), "median_s": seconds.median(), "longest_s": seconds.max()})
    table = table.sort_values("scenes", ascending=False).reset_index()
    solved = frame[frame["error_force"].notna()]
    rows = [
        {
            "quantity": name,
            "median": solved[column].median(),
            "99 % below": solved[column].quantile(0.99),
            "largest": solved[column].max(),
        }
        for name, column in (
            ("stated relative error of F_p", "error_force"),
            ("stated relative error of D_p", "error_distance"),
            ("relative Newton step left in the states", "remaining"),
        )
    ]
    unexplained = sum(outcome not in KNOWN for outcome in frame["outcome"])
    text = (
        f"{size} random scenes: E_m 1 kPa to 1 GPa, h_0 1 um to 5 mm, omega_a 1e-6 to 100 J/m2, P_0 -101 to +200 kPa, "
        "V_0 10 uL to 1 m3, R_0 1 to 100 mm, r_e up to R_0, d_b 1 mm to 1 km and flats, gas anchored at V_0, at the "
        f"start, or vented. {len(solved)} pull off, {size - len(solved) - unexplained} end in a typed physical "
        f"outcome, **{unexplained}** are refused as not converged. D_p is uncertain where the membrane is slack while "
        "the force vanishes: there the rim rises without a force, so that the zero of the force is an interval, and "
        "its length is stated as the error."
    )
    return Section(
        "Membrane, extreme scenes",
        text,
        {"membrane-extremes": table, "membrane-extremes-errors": pd.DataFrame(rows)},
        captions={
            "membrane-extremes": "How the scenes end, and CPU time each.",
            "membrane-extremes-errors": "Of the scenes that pull off.",
        },
    )
