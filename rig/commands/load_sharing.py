"""``rig load-sharing``: stress under the film and its sharing among the fibres, as words, JSON or a picture."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.commands import SCENE

if TYPE_CHECKING:
    from model.load_sharing import LoadSharing

FORMULATIONS = ("published", "plane-strain", "axisymmetric")

MEASURED = "measured adhesion efficiency: 1.8-6.6 % (rigid gripper), up to 26 % (soft gripper at -51 kPa)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("scene", metavar="SCENE", help=SCENE)
    parser.add_argument(
        "--formulation", choices=FORMULATIONS, default="axisymmetric", help="equations (default: axisymmetric)"
    )
    parser.add_argument(
        "--pressure-kpa",
        type=float,
        action="append",
        metavar="X",
        help="chamber pressure, may be repeated (default: 0 and the scene's P_0)",
    )
    parser.add_argument(
        "--lift-um", type=float, metavar="X", help="lift u_0 of the rim (default: where peeling begins)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw the stress map and the interface profile")


def run(arguments: argparse.Namespace) -> int:
    """Solve the film with and without its fibre layer and print the measures that converge."""
    from model.load_sharing import Fibres, Film, solve
    from rig.library import load_scene
    from rig.output import PICTURES, prepare, writing

    prepare("--plot", arguments.plot, *PICTURES)
    scene, _ = load_scene(arguments.scene)
    parameters = scene.parameters()
    film = Film.of(parameters)
    stuck = solve(film, arguments.formulation)
    fibred = solve(film, arguments.formulation, fibres=Fibres.of(film.youngs_modulus))
    pressures = arguments.pressure_kpa or list(dict.fromkeys([0.0, parameters.gas.initial_pressure / 1e3]))
    work = parameters.membrane.work_of_adhesion
    rows = [measures(stuck, fibred, pressure * 1e3, arguments.lift_um, work) for pressure in pressures]
    if arguments.plot is not None:
        from analysis.load_sharing_plot import draw_load_sharing

        with writing("--plot", arguments.plot):
            draw_load_sharing(
                stuck, fibred, [(row["lift_m"], row["pressure_Pa"]) for row in rows], scene.title, arguments.plot
            )
    if arguments.json:
        print(json.dumps(as_json(stuck, fibred, rows), allow_nan=False))
    else:
        print(as_text(stuck, fibred, rows, scene.title))
    return 0


def measures(
    stuck: LoadSharing, fibred: LoadSharing, pressure: float, lift_um: float | None, work: float
) -> dict[str, Any]:
    """Return the measures at one pressure; ``None`` stands for what does not exist.

    Suction may peel the film at no lift at all: then the lift is zero and ``peels_by_itself`` is true.
    """
    from model.load_sharing import Load

    lift = stuck.lift_at_peeling(work, pressure) if lift_um is None else lift_um * 1e-6
    by_itself = lift_um is None and not lift > 0
    load = Load(0.0 if by_itself else lift, pressure)
    unit = "N" if stuck.formulation == "axisymmetric" else "N_per_m"
    return {
        "pressure_Pa": pressure,
        "lift_m": load.lift,
        "peels_by_itself": by_itself,
        f"edge_force_{unit}": stuck.edge_force(load),
        "mean_stress_Pa": stuck.mean_stress(load),
        "edge_stress_Pa": stuck.edge_stress(load),
        "release_rate_J_m2": stuck.release_rate(load),
        "fibre_peak_stress_Pa": fibred.peak_stress(load),
        "fibre_mean_stress_Pa": fibred.mean_stress(load),
        "adhesion_efficiency": fibred.sharing(load),
    }


def as_json(stuck: LoadSharing, fibred: LoadSharing, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return everything as one object; stress is tension positive."""
    return {
        "formulation": stuck.formulation.value,
        "assumptions": dict(fibred.assumptions) | {"substrate": "flat"},
        "loads": rows,
        "numerical_error": {"edge_force_relative": stuck.edge_error, "fibre_edge_force_relative": fibred.edge_error},
        "unknowns": stuck.unknowns,
        "runtime_s": stuck.runtime_s + fibred.runtime_s,
    }


def as_text(stuck: LoadSharing, fibred: LoadSharing, rows: list[dict[str, Any]], title: str) -> str:
    """Return a table of the measures."""
    lines = [
        f"{title}: film on a flat, {stuck.formulation.value}, {stuck.unknowns} unknowns, "
        f"{stuck.runtime_s + fibred.runtime_s:.2f} s, edge force +/- {100 * stuck.edge_error:.2g} %",
        "   P (kPa)   lift (um)   mean (kPa)   last fibre (kPa)   peak (kPa)   mean/peak",
    ]
    lines += [
        f"{row['pressure_Pa'] / 1e3:10.3g}{row['lift_m'] * 1e6:12.4g}{row['mean_stress_Pa'] / 1e3:13.4g}"
        f"{row['edge_stress_Pa'] / 1e3:19.4g}{row['fibre_peak_stress_Pa'] / 1e3:13.4g}"
        f"{100 * row['adhesion_efficiency']:11.2f} %" + ("   peels by itself" if row["peels_by_itself"] else "")
        for row in rows
    ]
    lines.append("mean and last fibre: sticking film; peak and mean/peak: with the fibre layer; tension positive")
    lines.append(MEASURED)
    return "\n".join(lines)
