"""Work and precision of the cone model: the papers' grid, our solver, the batch, against the reference."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.accuracy.plots import work_precision
from analysis.accuracy.section import Progress, Section
from analysis.accuracy.timing import Timing, timed
from model import Gas, GasAnchor, Membrane, Parameters, Substrate, batch, cone, grid, reference

if TYPE_CHECKING:
    import pandas as pd

PROBLEMS = {
    "flat, +1 kPa": Parameters(Substrate("flat"), gas=Gas(1000.0)),
    "60 mm sphere, -3.2 kPa": Parameters(Substrate("sphere", 60e-3), gas=Gas(-3200.0)),
    "15 mm sphere, +2 kPa": Parameters(Substrate("sphere", 15e-3), gas=Gas(2000.0)),
}
GRIDS = ((201, 501), (501, 1251), (1001, 2501), (2001, 5001), (6001, 15001))
SCANS = (8, 16, 32, 64, 128, 512)
BATCH_SCANS = (8, 16, 24, 48)
BATCH_SIZE = 4096
ERRORS = (("error_F_p", "relative error of F_p"), ("error_D_p", "relative error of D_p"))
AS_DESCRIBED, HOISTED, SINGLE = "grid, as the SI describes it", "grid, improved by us", "grid in float32"
SOLVER, BATCH = "solver, scan of n radii", f"batch of {BATCH_SIZE}, per scene"


def sections(quick: bool, progress: Progress) -> list[Section]:
    """Return work-precision diagrams, the comparison with the papers' grid, and the counts of terms."""
    result = [_work_precision(name, scene, quick, progress) for name, scene in PROBLEMS.items()]
    return [result[0], _ratio(quick, progress), *result[1:], _throughput(quick, progress), _terms()]


@functools.cache
def exact(scene: Parameters, contact_stretch: bool = True) -> reference.Reference:
    """Return the reference solution, kept for the other studies."""
    return reference.solve(scene, contact_stretch=contact_stretch)


def _row(
    method: str, setting: str, result: Any, timing: Timing, evaluations: int, truth: reference.Reference
) -> dict[str, Any]:
    return {
        "method": method,
        "setting": setting,
        "evaluations": evaluations,
        **timing.columns(),
        "error_F_p": abs(float(result.pull_off_force / truth.pull_off_force - 1)),
        "error_D_p": abs(float(result.pull_off_distance / truth.pull_off_distance - 1)),
    }


def _work_precision(name: str, scene: Parameters, quick: bool, progress: Progress) -> Section:
    import pandas as pd

    truth = exact(scene)
    rows = []
    for positions, radii in GRIDS[:3] if quick else GRIDS:
        for method, options in (
            (AS_DESCRIBED, {"as_described": True}),
            (HOISTED, {}),
            (SINGLE, {"dtype": np.float32}),
        ):
            progress(f"{name}: {method} {positions} x {radii}")
            call = functools.partial(grid.solve, scene, positions=positions, radii=radii, **options)
            result, timing = timed(call, 1 if positions > 2001 else 5)
            rows.append(_row(method, f"{positions} x {radii}", result, timing, result.evaluations, truth))
    for nodes in SCANS:
        progress(f"{name}: solver with {nodes} radii")
        solved, timing = timed(functools.partial(cone.solve, scene, nodes=nodes), 11 if quick else 101)
        evaluations = solved.evaluations["elastic energy"]
        rows.append(_row(SOLVER, f"n = {nodes}", solved, timing, evaluations, truth))
    rows += [_batch_row(scene, nodes, quick, truth) for nodes in BATCH_SCANS]
    return diagram(name, pd.DataFrame(rows), truth)


def _batch_row(scene: Parameters, nodes: int, quick: bool, truth: reference.Reference) -> dict[str, Any]:
    size = 256 if quick else BATCH_SIZE
    solved, timing = timed(functools.partial(batch.solve_many, [scene] * size, nodes=nodes), 3 if quick else 5)
    worst = int(np.argmax(np.abs(solved.pull_off_force - float(truth.pull_off_force))))
    one = replace(truth, pull_off_force=solved.pull_off_force[worst], pull_off_distance=solved.pull_off_distance[worst])
    each = Timing(*(seconds / size for seconds in timing))
    return _row(BATCH, f"n = {nodes}", one, each, solved.evaluations // size, truth)


def diagram(name: str, table: pd.DataFrame, truth: reference.Reference) -> Section:
    """Return the section of a measured table."""
    key = "cone-" + name.replace(",", "").replace("+", "plus-").replace("-3.2", "minus-3.2").replace(" ", "-")
    return Section(
        f"Cone model, {name}",
        f"Reference: F_p = {float(truth.pull_off_force):.15f} N, D_p = {float(truth.pull_off_distance) * 1e3:.15f} mm, "
        f"to {truth.digits} digits: the printed energy, differentiated numerically, followed in steps of z, polished "
        "in mpmath. The resolution of our solver is the number of radii of its scan; the scan only brackets folds, "
        "peak and zero of the force, so more radii cost time and do not change the features.",
        {key: table},
        {key: lambda path: work_precision(table, ERRORS, path)},
        {key: f"Work and precision, {name}. Errors of zero are drawn at 1e-17."},
    )


def _ratio(quick: bool, progress: Progress) -> Section:
    """Compare with the papers' own resolution in one run."""
    import pandas as pd

    name, scene = next(iter(PROBLEMS.items()))
    truth = exact(scene)
    size = (2001, 5001) if quick else grid.PAPER_GRID
    rows = []
    for method, described in ((AS_DESCRIBED, True), (HOISTED, False)):
        progress(f"{name}: {method} {size[0]} x {size[1]}")
        result, timing = timed(
            functools.partial(grid.solve, scene, positions=size[0], radii=size[1], as_described=described), 1
        )
        rows.append(_row(method, f"{size[0]} x {size[1]}", result, timing, result.evaluations, truth))
    solved, timing = timed(functools.partial(cone.solve, scene), 31 if quick else 301)
    rows.append(
        _row("solver, profile of 200 points", "default", solved, timing, solved.evaluations["elastic energy"], truth)
    )
    table = pd.DataFrame(rows)
    table["times_slower"] = table["median_s"] / table["median_s"].iloc[-1]
    return comparison(table)


def comparison(table: pd.DataFrame) -> Section:
    """Return the section of the measured comparison with the papers' grid."""
    described, hoisted, ours = (row for _, row in table.iterrows())
    name = next(iter(PROBLEMS))
    text = (
        f"One scene ({name}), one run, one process. {described['setting']} grid as the SI describes it (energy as "
        f"printed at every point, both derivatives everywhere): {described['median_s']:.3g} s; our solver with the "
        f"whole profile and all features: {ours['median_s'] * 1e3:.3g} ms in the median "
        f"({ours['lower_s'] * 1e3:.3g} ms lower quartile), **{described['times_slower']:,.0f} times faster** "
        f"({hoisted['times_slower']:,.0f} times faster than the grid with all hoisted that can be). Error of F_p "
        f"{described['error_F_p']:.1e} against {ours['error_F_p']:.1e}, of D_p {described['error_D_p']:.1e} against "
        f"{ours['error_D_p']:.1e}."
    )
    return Section("The papers' grid beside the solver", text, {"cone-papers-grid": table})


def _throughput(quick: bool, progress: Progress) -> Section:
    """Many different scenes through the batch solver, checked against the scalar one."""
    import time

    import pandas as pd

    size, checked = (512, 64) if quick else (16384, 1024)
    progress(f"batch of {size} different scenes")
    scenes = sweep_scenes(size)
    solved = batch.solve_many(scenes)
    begin = time.process_time()
    solved = batch.solve_many(scenes)
    seconds = time.process_time() - begin
    alone = [cone.solve(scene, points=16) for scene in scenes[:checked]]
    worst = {
        name: max(abs(getattr(solved, name)[k] / getattr(one, name) - 1) for k, one in enumerate(alone))
        for name in ("pull_off_force", "pull_off_distance")
    }
    table = pd.DataFrame(
        [
            {
                "scenes": size,
                "scenes_per_cpu_second": size / seconds,
                "solved_one_by_one": solved.scalar_scenes,
                "evaluations_per_scene": solved.evaluations / size,
                "worst_deviation_F_p": worst["pull_off_force"],
                "worst_deviation_D_p": worst["pull_off_distance"],
            }
        ]
    )
    return throughput(table, checked)


def throughput(table: pd.DataFrame, checked: int) -> Section:
    """Return the section of the measured throughput."""
    size, rate = int(table["scenes"].iloc[0]), float(table["scenes_per_cpu_second"].iloc[0])
    text = (
        f"{size} scenes as a sweep has them (flats and spheres of 12 to 60 mm, thickness 0.1 to 1 mm, work of adhesion "
        f"0.1 to 9 J/m2, P_0 -4 to +3 kPa) in one call: {rate:,.0f} scenes per second of one core. Deviation "
        f"of {checked} of them from the scalar solver below."
    )
    return Section("Batches", text, {"cone-batch": table})


def sweep_scenes(size: int, seed: int = 1) -> list[Parameters]:
    """Return different scenes over the ranges of EML Figs. 5 and 6."""
    random = np.random.default_rng(seed)
    return [
        Parameters(
            Substrate("flat") if k % 4 == 0 else Substrate("sphere", float(random.uniform(12e-3, 60e-3))),
            membrane=Membrane(2e6, float(random.uniform(1e-4, 1e-3)), float(random.uniform(0.1, 9.0))),
            gas=Gas(float(random.uniform(-4e3, 3e3))),
        )
        for k in range(size)
    ]


def _terms() -> Section:
    """Count what is evaluated: a scene pays only for what it has."""
    import pandas as pd

    flat, sphere = Substrate("flat"), Substrate("sphere", 60e-3)
    vented = Gas(anchor=GasAnchor.VENTED)
    cases: dict[str, Callable[[], Any]] = {
        "flat, vented": lambda: cone.solve(Parameters(flat, gas=vented)),
        "flat, closed chamber": lambda: cone.solve(Parameters(flat, gas=Gas(1000.0))),
        "60 mm sphere, vented, cone-2017": lambda: cone.solve(Parameters(sphere, gas=vented), contact_stretch=False),
        "60 mm sphere, vented, cone": lambda: cone.solve(Parameters(sphere, gas=vented)),
        "60 mm sphere, closed chamber, cone": lambda: cone.solve(Parameters(sphere, gas=Gas(1000.0))),
    }
    names = ("elastic energy", "chamber gas", "spherical cap", "contact stretch")
    rows = []
    for case, call in cases.items():
        counts = call().evaluations
        rows.append({"scene": case, **{name: counts.get(name, 0) for name in names}})
    text = "Points at which each term was evaluated for one prediction with 200 points of profile."
    return Section("What a scene does not need is not computed", text, {"cone-terms": pd.DataFrame(rows)})
