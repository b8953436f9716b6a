"""Validation: every published pull-off experiment of the rigid gripper beside each model, nothing fitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from analysis.accuracy.report import markdown
from analysis.published import Experiment, experiments
from model import GasAnchor, Parameters, membrane, predict

if TYPE_CHECKING:
    import pandas as pd

    from model.prediction import Prediction


VARIANTS = {
    "cone-2017": ("cone-2017", None),
    "cone": ("cone", None),
    "membrane, eml": ("membrane", "eml"),
    "membrane, projected": ("membrane", "projected"),
    "membrane, loading": ("membrane", "loading"),
    "membrane, frictionless": ("membrane", "frictionless"),
    "membrane, unstretched": ("membrane", "unstretched"),
}
"""What is compared, by its name in the tables: model and contact stretch."""

IMPLIED_AT_30_MM = 2.8
"""EML: the cone's D_p at 30 mm and the lowest pressure is 2.8 times the experiment's; no value is printed."""


NOMINAL = "nominal"
TRIED: dict[str, Callable[[Parameters], Parameters]] = {
    NOMINAL: lambda scene: scene,
    "omega_a 2.07 J/m2 (thin-layer limit of the JKR test)": lambda scene: scene.with_changes(work_of_adhesion=2.07),
    "omega_a 3.3 J/m2 (Table S4)": lambda scene: scene.with_changes(work_of_adhesion=3.3),
    "omega_a 4.14 J/m2 (Table S3)": lambda scene: scene.with_changes(work_of_adhesion=4.14),
    "omega_a 6 J/m2": lambda scene: scene.with_changes(work_of_adhesion=6.0),
    "E_m 1.5 MPa": lambda scene: scene.with_changes(youngs_modulus=1.5e6),
    "E_m 2.1 MPa (PNAS Fig. 4)": lambda scene: scene.with_changes(youngs_modulus=2.1e6),
    "h_0 250 um (SI Fig. S3)": lambda scene: scene.with_changes(thickness=250e-6),
    "r_e 7.0 mm": lambda scene: replace(scene, gripper=replace(scene.gripper, effective_radius=7.0e-3)),
    "r_e 8.0 mm = R_0": lambda scene: replace(scene, gripper=replace(scene.gripper, effective_radius=8.0e-3)),
    "V_0 7.92 mL (+10 %)": lambda scene: replace(scene, gripper=replace(scene.gripper, chamber_volume=7.92e-6)),
    "gas 1 K warmer than at V_0": lambda scene: scene.with_changes(
        initial_pressure=scene.gas.initial_pressure + scene.gas.atmospheric_pressure / 293
    ),
    "gas adiabatic (as stiff as V_0 / 1.4)": lambda scene: replace(
        scene, gripper=replace(scene.gripper, chamber_volume=scene.gripper.chamber_volume / 1.4)
    ),
    "pressure held at P_0 (leak, or endless chamber)": lambda scene: replace(
        scene, gas=replace(scene.gas, anchor=GasAnchor.VENTED)
    ),
    "P_0 anchored at the start of retraction": lambda scene: replace(
        scene, gas=replace(scene.gas, anchor=GasAnchor.START)
    ),
}
"""What was changed in search of the discrepancies, one at a time."""


def predictions() -> dict[str, list[Prediction]]:
    """Return the predictions of every model for every experiment."""
    return {
        name: [predict(test.parameters, model, points=150, contact_stretch=stretch) for test in experiments()]
        for name, (model, stretch) in VARIANTS.items()
    }


def force_table(predicted: dict[str, list[Prediction]]) -> pd.DataFrame:
    """Return F_p in N beside Table S1, with deviations in per cent."""
    import pandas as pd

    return pd.DataFrame([_row(test, "F_p (N)", test.force, predicted, i) for i, test in enumerate(experiments())])


def distance_table(predicted: dict[str, list[Prediction]]) -> pd.DataFrame:
    """Return D_p in mm beside EML's text, with deviations in per cent; where no value is printed, none is given."""
    import pandas as pd

    rows = []
    for i, test in enumerate(experiments()):
        measured = np.nan if test.distance is None else test.distance * 1e3
        rows.append(_row(test, "D_p (mm)", measured, predicted, i))
    return pd.DataFrame(rows)


def _row(
    test: Experiment, quantity: str, measured: float, predicted: dict[str, list[Prediction]], index: int
) -> dict[str, object]:
    row: dict[str, object] = {"substrate": test.substrate, "P_0 (kPa)": test.pressure / 1e3, quantity: measured}
    for name, results in predicted.items():
        result = results[index]
        value = result.pull_off_force if quantity.startswith("F_p") else result.pull_off_distance * 1e3
        deviation = "" if np.isnan(measured) else f" ({100 * (value / measured - 1):+.0f} %)"
        row[name] = f"{value:.3f}{deviation}"
    return row


def summary_table(predicted: dict[str, list[Prediction]]) -> pd.DataFrame:
    """Return the mean magnitude of the deviations of each model, in per cent."""
    import pandas as pd

    tests = experiments()
    rows = []
    for name, results in predicted.items():
        force = [abs(r.pull_off_force / t.force - 1) for r, t in zip(results, tests, strict=True)]
        far = {
            sign: [
                abs(r.pull_off_distance / t.distance - 1)
                for r, t in zip(results, tests, strict=True)
                if t.distance is not None and (t.pressure < 0) == (sign == "suction")
            ]
            for sign in ("pressure", "suction")
        }
        rows.append(
            {
                "model": name,
                "F_p, all eight (%)": 100 * float(np.mean(force)),
                "D_p at positive P_0 (%)": 100 * float(np.mean(far["pressure"])),
                "D_p under suction (%)": 100 * float(np.mean(far["suction"])),
            }
        )
    return pd.DataFrame(rows)


def spread_table(predicted: dict[str, list[Prediction]]) -> pd.DataFrame:
    """Return the range of F_p and D_p over the contact assumptions that stick: the model's own uncertainty."""
    import pandas as pd

    names = ("membrane, eml", "membrane, projected", "membrane, loading", "membrane, frictionless")
    rows = []
    for i, test in enumerate(experiments()):
        forces = [predicted[name][i].pull_off_force for name in names]
        distances = [predicted[name][i].pull_off_distance * 1e3 for name in names]
        rows.append(
            {
                "substrate": test.substrate,
                "P_0 (kPa)": test.pressure / 1e3,
                "F_p (N)": f"{min(forces):.3f} - {max(forces):.3f}",
                "spread of F_p (%)": 100 * (max(forces) / min(forces) - 1),
                "D_p (mm)": f"{min(distances):.2f} - {max(distances):.2f}",
                "spread of D_p (%)": 100 * (max(distances) / min(distances) - 1),
            }
        )
    return pd.DataFrame(rows)


def tried_table(predicted: dict[str, list[Prediction]]) -> pd.DataFrame:
    """Return F_p and D_p of the tests that stay unexplained under one change at a time, beside the measured ones."""
    import pandas as pd

    chosen = [
        (i, test)
        for i, test in enumerate(experiments())
        if test.substrate == "d_b 15 mm" or (test.substrate == "d_b 30 mm" and test.pressure < 0)
    ]
    names = [f"{test.substrate[4:]}, {test.pressure / 1e3:g} kPa: F_p (N), D_p (mm)" for _, test in chosen]
    implied = _implied(predicted)
    measured = [_pair(test.force, test.distance or implied) for _, test in chosen]
    rows: list[list[str]] = [["**measured** (30 mm: D_p implied)", *measured]]
    for name, change in TRIED.items():
        results = [membrane.solve(change(test.parameters), points=16, tolerance=1e-5) for _, test in chosen]
        rows.append([name, *(_pair(one.pull_off_force, one.pull_off_distance) for one in results)])
    for name in ("projected", "loading", "frictionless", "unstretched"):
        results = [predicted[f"membrane, {name}"][i] for i, _ in chosen]
        rows.append([f"contact: {name}", *(_pair(one.pull_off_force, one.pull_off_distance) for one in results)])
    relaxed = [membrane.solve(test.parameters, points=16, tolerance=1e-5, tension_field=True) for _, test in chosen]
    rows.append(["tension field", *(_pair(one.pull_off_force, one.pull_off_distance) for one in relaxed)])
    return pd.DataFrame(rows, columns=["change", *names])


def _pair(force: float, distance: float) -> str:
    return f"{force:.3f}, {1e3 * distance:.2f}"


def _implied(predicted: dict[str, list[Prediction]]) -> float:
    """Return the D_p (m) at 30 mm and -4.1 kPa that EML's ratio of the cone to the experiment implies."""
    index = next(i for i, t in enumerate(experiments()) if t.substrate == "d_b 30 mm" and t.pressure < 0)
    return predicted["cone"][index].pull_off_distance / IMPLIED_AT_30_MM


def numerical_errors(predicted: dict[str, list[Prediction]]) -> str:
    """Return a sentence on the numerical errors of the entries: which of them reach the last digit shown."""
    visible = [
        f"D_p of {name} at {test.substrate}, {test.pressure / 1e3:g} kPa (+-{1e3 * error:.3f} mm)"
        for name, results in predicted.items()
        for test, result in zip(experiments(), results, strict=True)
        if (error := result.numerical_error["pull_off_distance"]) > 0.5e-6
    ]
    exact = "Numerical errors of all entries are below the last digit shown"
    if not visible:
        return exact + "."
    return (
        f"{exact}\nbut for {'; '.join(visible)}:\nthere the contact passes the radius whose stored stretch just "
        "peels it, where the membrane is slack\nand the zero of the force is an interval."
    )


def write_page(folder: Path) -> Path:
    """Write ``validation.md`` and its picture; return the page."""
    predicted = predictions()
    (folder / "validation").mkdir(parents=True, exist_ok=True)
    draw(predicted, folder / "validation" / "published.png")
    page = folder / "validation.md"
    page.write_text(_page(predicted), encoding="utf-8", newline="\n")
    return page


def _page(predicted: dict[str, list[Prediction]]) -> str:
    tests = experiments()
    thirty = next(i for i, t in enumerate(tests) if t.substrate == "d_b 30 mm" and t.pressure < 0)
    implied = _implied(predicted)
    three = {name: _suction_deviation(predicted[name], implied) for name in ("cone", "membrane, eml")}
    return _TEXT.format(
        cone_three=100 * three["cone"],
        membrane_three=100 * three["membrane, eml"],
        forces=markdown(force_table(predicted)),
        distances=markdown(distance_table(predicted)),
        summary=markdown(summary_table(predicted)),
        spread=markdown(spread_table(predicted)),
        ratio=IMPLIED_AT_30_MM,
        implied=1e3 * implied,
        numerical=numerical_errors(predicted),
        tried=markdown(tried_table(predicted)),
        cone=predicted["cone"][thirty].pull_off_distance * 1e3,
        membrane=predicted["membrane, eml"][thirty].pull_off_distance * 1e3,
    )


def _suction_deviation(results: list[Prediction], implied: float) -> float:
    """Return the mean deviation of D_p under suction, the implied distance at 30 mm counted."""
    found = []
    for test, result in zip(experiments(), results, strict=True):
        measured = implied if test.substrate == "d_b 30 mm" else test.distance
        if test.pressure < 0 and measured is not None:
            found.append(abs(result.pull_off_distance / measured - 1))
    return float(np.mean(found))


_TEXT = """# Validation against the published experiments

Written by `python benchmarks/validation.py`. Every pull-off test of the rigid gripper whose numbers are printed (PNAS
2017 SI Table S1; EML 2020 section 3) beside each model. Nominal parameters throughout (E_m 2 MPa, h_0 200 um, omega_a
4 J/m2, R_0 8 mm, r_e 7.3 mm, V_0 7.2 mL), P_0 anchored at V_0; nothing is fitted. Deviations are those of the model
from the experiment.

{numerical}

## Pull-off force

{forces}

## Pull-off distance

{distances}

A dash: the papers print no value, so that the mean under suction below rests on two tests only. At 30 mm and -4.1 kPa
EML says that its cone is {ratio} times too long; with {cone:.2f} mm for the cone that implies an experiment near
{implied:.2f} mm, where the membrane gives {membrane:.2f} mm: with it counted, the mean deviation under suction is
{cone_three:.0f} % for the cone and {membrane_three:.0f} % for the membrane (eml).

## Mean deviations

{summary}

## What the contact assumption alone changes

{spread}

The range over four contact assumptions (W_2 of EML, projected stick, stick as loading leaves it, no friction), the
shape being exact in all of them. Read it as the uncertainty of the model.

![Measured and predicted](validation/published.png)

## What this says

- Under suction the cone's error of D_p is one of shape: with the equilibrium shape the distance at 60 mm and -3.2 kPa
  comes out within one per cent of the experiment, with no parameter touched.
- Stick as vented loading leaves it differs from projected stick by less than half a per cent in radius: projection is a
  good description of a membrane that sticks where it touches.
- At 15 mm the prediction is dominated by the stretch stored in contact, for which the papers give no measurement:
  F_p varies by tens of per cent with the assumption, and every one that stores stretch stays below the measured force.

## What remains unexplained, and what was tried

One change at a time from the nominal scene, membrane with contact stretch `eml` unless named:

{tried}

- **15 mm.** The measured forces ask for 5.1 and 5.4 J/m2 of adhesion, a third more than any calibration of the papers
  gives, and flat glass contradicts it: there the force at -2.9 kPa is already 9 % too high with 4 J/m2. Stiffness,
  thickness and r_e hardly change F_p, the state of the gas changes it by a few per cent. With nothing stored in contact
  (`unstretched`) the force under suction passes the measured one, but detachment comes half as late again. D_p at
  -0.7 kPa is right as it stands, D_p at +2 kPa a fifth short. No assumption on the contact fits all four numbers.
- **30 mm, -4.1 kPa.** F_p is right within 3 % (`eml`), but detachment comes at twice the implied distance, whatever the
  contact, modulus, thickness, volume or temperature of the gas. What shortens D_p most, a pressure held or anchored at
  the start of retraction, puts F_p a third to two thirds above the measured one; less adhesion shortens it by a quarter
  and costs a third of the force. The implied distance itself is a ratio in EML's text, not a printed measurement.
- **30 mm, +2.7 kPa.** F_p is 20 to 30 % too high in every model.
- **Not tried**, because the model has no place for them: bending of the film (the overhang of 0.7 mm is three to four
  thicknesses), pretension from mounting, rate-dependent adhesion (the JKR test retracts five times faster),
  misalignment, friction that yields during peeling, and the peel zone of several fibres that EML shows (Fig. 3f).
"""


def draw(predicted: dict[str, list[Prediction]], path: Path) -> None:
    """Draw measured against predicted F_p and D_p, and the force curves of the 60 mm sphere under suction."""
    from matplotlib.figure import Figure

    colours = ["0.6", "#D55E00", "#0072B2", "#56B4E9", "#009E73", "#CC79A7", "0.3"]
    markers = "xsoDv^+"
    figure = Figure(figsize=(13, 4.4), layout="constrained")
    force, distance, curve = figure.subplots(1, 3)
    tests = experiments()
    for (name, results), colour, marker in zip(predicted.items(), colours, markers, strict=True):
        style = {"color": colour, "marker": marker, "ls": "", "ms": 6, "label": name}
        if marker not in "x+":
            style["markerfacecolor"] = "none"
        force.plot([t.force for t in tests], [r.pull_off_force for r in results], **style)
        pairs = [(t.distance, r.pull_off_distance) for t, r in zip(tests, results, strict=True) if t.distance]
        distance.plot([1e3 * a for a, _ in pairs], [1e3 * b for _, b in pairs], **style)
    for axes, quantity, unit, span in ((force, "F_p", "N", (0, 1.3)), (distance, "D_p", "mm", (1, 3.4))):
        axes.plot(span, span, "k", lw=0.8)
        axes.set(xlim=span, ylim=span, xlabel=f"measured {quantity} ({unit})", ylabel=f"predicted {quantity} ({unit})")
    distance.set_xlim(1, 2.7)
    force.legend(frameon=False, fontsize="small")
    index = next(i for i, t in enumerate(tests) if t.substrate == "d_b 60 mm" and t.pressure < 0)
    for name in ("cone", "membrane, eml"):
        result = predicted[name][index]
        colour = colours[list(predicted).index(name)]
        z, f = result.retraction * 1e3, result.force
        curve.plot([*z, z[-1]], [*f, 0.0], color=colour, label=name)
    curve.plot([tests[index].distance * 1e3], [0.0], "k*", ms=11, label="measured D_p")  # type: ignore[operator]
    curve.axhline(-tests[index].force, color="k", ls=":", label="measured F_p")
    curve.set(xlabel="retraction z_r (mm)", ylabel="F_r (N), compression positive", title="60 mm sphere, -3.2 kPa")
    curve.legend(frameon=False, fontsize="small")
    figure.savefig(path, dpi=120)
