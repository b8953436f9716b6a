"""Work and precision of the load-sharing finite elements: grading, locking, and the peak that is none."""

from __future__ import annotations

import functools
from typing import Any

from analysis.accuracy.plots import limits, work_precision
from analysis.accuracy.section import Progress, Section
from analysis.accuracy.timing import timed
from model.load_sharing import Discretisation, Fibres, Film, Formulation, Load, LoadSharing, solve

FILM = Film(8e-3, 7.3e-3, 200e-6, 2.0e6)
LIFTED = Load(1e-4, 0.0)
SUCKED = Load(1e-4, -2900.0)
ERRORS = (("error_force", "relative error of the edge force"), ("error_energy", "relative error of the release rate"))


def sections(quick: bool, progress: Progress) -> list[Section]:
    """Return convergence of the edge force, locking, and the peak with and without fibres."""
    return [_convergence(quick, progress), _locking(quick, progress), _peak(quick, progress)]


def _convergence(quick: bool, progress: Progress) -> Section:
    import pandas as pd

    progress("load sharing: reference")
    finest = Discretisation(0.02e-6) if quick else Discretisation(0.01e-6, 0.0625)
    truth = solve(FILM, estimate_error=False, discretisation=finest)
    meshes = {
        "uniform": [Discretisation(largest=size, graded=False) for size in (0.5, 0.25, 0.125)],
        "graded": [Discretisation(20e-6 / 4**k, (0.5, 0.25, 0.25, 0.125, 0.125)[k]) for k in range(5)],
    }
    rows = []
    for method, series in meshes.items():
        for mesh in series[: (2 if method == "uniform" else 4) if quick else None]:
            smallest = mesh.smallest if mesh.graded else mesh.largest * FILM.thickness
            progress(f"load sharing: {method}, {smallest * 1e6:g} um")
            call = functools.partial(solve, FILM, discretisation=mesh, estimate_error=False)
            result, timing = timed(call, 2 if quick else 3)
            rows.append(
                {
                    "method": method,
                    "setting": f"{smallest * 1e6:.3g} um at the edge",
                    "evaluations": result.unknowns,
                    **timing.columns(),
                    "error_force": abs(result.edge_force(LIFTED) / truth.edge_force(LIFTED) - 1),
                    "error_energy": abs(result.release_rate(LIFTED) / truth.release_rate(LIFTED) - 1),
                }
            )
    table = pd.DataFrame(rows)
    _, again = timed(lambda: (truth.edge_force(SUCKED), truth.edge_stress(SUCKED), truth.release_rate(SUCKED)), 50)
    text = (
        "Incompressible axisymmetric film (Taylor-Hood), lifted by 0.1 mm, stuck up to 7.3 mm. The square-root "
        "singularity at the contact edge makes uniform meshes converge at first order whatever the polynomials; "
        "halving elements towards the edge buys two orders of magnitude at the same number of unknowns (column "
        "evaluations). "
        f"Once solved, edge force, mean over the last fibre and release rate at any lift and pressure cost "
        f"{again.median * 1e3:.2g} ms together."
    )
    key = "load-sharing"
    return Section(
        "Load sharing, uniform against graded meshes",
        text,
        {key: table},
        {key: lambda path: work_precision(table, ERRORS, path, work="unknowns")},
        {key: "Load sharing: work and precision"},
    )


def _locking(quick: bool, progress: Progress) -> Section:
    import pandas as pd

    rows = []
    for ratio in (0.4, 0.49, 0.4999) if quick else (0.4, 0.45, 0.49, 0.499, 0.4999, 0.49999):
        forces: dict[str, float] = {}
        film = Film(FILM.radius, FILM.contact_radius, FILM.thickness, FILM.youngs_modulus, ratio)
        for element in ("P1", "P2", "mixed"):
            progress(f"load sharing: locking, nu = {ratio}, {element}")
            mesh = Discretisation(2e-6, 0.25 if quick else 0.125, element)
            result = solve(film, Formulation.PLANE_STRAIN, estimate_error=False, discretisation=mesh)
            forces[element] = result.edge_force(LIFTED)
        rows.append(
            {
                "nu": f"{ratio:g}",
                **{f"{name} over mixed": forces[name] / forces["mixed"] for name in ("P1", "P2")},
                "mixed (N/m)": forces["mixed"],
            }
        )
    film = Film(FILM.radius, FILM.contact_radius, FILM.thickness, FILM.youngs_modulus, 0.5)
    limit = solve(film, Formulation.PLANE_STRAIN, estimate_error=False, discretisation=mesh)
    incompressible = {"nu": "1/2", "mixed (N/m)": limit.edge_force(LIFTED)}
    table = pd.DataFrame([*rows, incompressible])
    long = pd.DataFrame(
        [
            {"x": 0.5 - float(str(row["nu"])), "y": row[f"{name} over mixed"], "series": name}
            for row in rows
            for name in ("P1", "P2")
        ]
    )
    text = (
        "Plane strain on one graded mesh: displacement elements stiffen as nu approaches 1/2, linear ones without "
        "bound; the mixed element does not notice and takes nu = 1/2 itself."
    )
    panel = [("plane strain, stuck edge lifted", "1/2 - nu", "edge force / that of the mixed element", long)]
    return Section(
        "Load sharing, locking",
        text,
        {"load-sharing-locking": table},
        {"load-sharing-locking": lambda path: limits(panel, path)},
        {"load-sharing-locking": "Locking of displacement elements"},
    )


def _peak(quick: bool, progress: Progress) -> Section:
    import pandas as pd

    fibres = Fibres.of(FILM.youngs_modulus)
    rows: list[dict[str, Any]] = []
    for smallest in (20e-6, 5e-6, 1.25e-6, 0.3e-6)[: 2 if quick else None]:
        progress(f"load sharing: peak, {smallest * 1e6:g} um")
        mesh = Discretisation(smallest)
        stuck = solve(FILM, estimate_error=False, discretisation=mesh)
        layer = solve(FILM, fibres=fibres, estimate_error=False, discretisation=mesh)
        rows.append(
            {
                "smallest element (um)": smallest * 1e6,
                "largest stress, stuck (kPa): no result": _largest(stuck) / 1e3,
                "last fibre pitch, stuck (kPa)": stuck.edge_stress(SUCKED) / 1e3,
                "peak, fibre layer (kPa)": layer.peak_stress(SUCKED) / 1e3,
                "mean over peak, fibre layer (%)": 100 * layer.sharing(SUCKED),
            }
        )
    table = pd.DataFrame(rows)
    text = (
        "Lift 0.1 mm, -2.9 kPa. **Warning:** the largest stress of a film that sticks grows as one over the root of "
        "the element and is no result; the solver refuses to name it. The mean over the last fibre pitch converges, "
        "and so does the peak once the fibres are springs (Winkler layer)."
    )
    return Section("Load sharing, the peak stress", text, {"load-sharing-peak": table})


def _largest(result: LoadSharing) -> float:
    return float(result.traction(SUCKED).max())
