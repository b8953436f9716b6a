"""``rig predict``: one pull-off test, as words, JSON or a picture."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.commands import SCENE

if TYPE_CHECKING:
    from model.prediction import Prediction
    from rig.scene import Scene

FEATURES = {
    "pull_off_force": "N",
    "pull_off_distance": "m",
    "retraction_at_pull_off": "m",
    "zero_force_position": "m",
    "detachment_position": "m",
    "detachment_radius": "m",
}
"""Features of a prediction and their units, as they are named in JSON."""

PROFILE = {"retraction": "m", "force": "N", "pressure": "Pa", "contact_radius": "m"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from model import MODELS, ContactStretch

    parser.add_argument("scene", metavar="SCENE", help=SCENE)
    parser.add_argument("--model", choices=MODELS, default="cone", help="adhesion model (default: cone)")
    parser.add_argument(
        "--contact-stretch",
        choices=[choice.value for choice in ContactStretch],
        help="how the membrane is stretched in contact, for --model membrane (default: eml)",
    )
    parser.add_argument("--pressure-kpa", type=float, metavar="X", help="initial pressure P_0 instead of the scene's")
    parser.add_argument("--points", type=int, default=200, metavar="N", help="points of the profile (default: 200)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--profile", action="store_true", help="add the profile to the JSON, or print it as a table")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw F_r and P_a against retraction")
    parser.add_argument(
        "--rigid-bound",
        action="store_true",
        help="soft gripper: predict the rigid one instead, as a labelled bound",
    )


def run(arguments: argparse.Namespace) -> int:
    """Predict and print. A physical outcome other than pull-off is an answer; an impossible scene is an error."""
    from rig.library import load_scene
    from rig.output import PICTURES, prepare, writing

    scene, _ = load_scene(arguments.scene)
    if scene.protocol.name == "indentation":
        return _indentation(scene, arguments)
    prepare("--plot", arguments.plot, *PICTURES)
    prediction = predict_scene(
        scene,
        arguments.scene,
        model=arguments.model,
        contact_stretch=arguments.contact_stretch,
        pressure_kPa=arguments.pressure_kpa,
        points=arguments.points,
        rigid_bound=arguments.rigid_bound,
    )
    if arguments.plot is not None:
        from analysis.prediction_plot import draw_prediction

        with writing("--plot", arguments.plot):
            draw_prediction(prediction, scene.title, arguments.plot)
    if arguments.json:
        print(json.dumps(as_json(prediction, profile=arguments.profile), allow_nan=False))
    else:
        print(as_text(prediction, scene.title, profile=arguments.profile))
    return 0


def predict_scene(
    scene: Scene,
    source: str,
    *,
    model: str = "cone",
    contact_stretch: str | None = None,
    pressure_kPa: float | None = None,
    points: int = 200,
    rigid_bound: bool = False,
) -> Prediction:
    """Predict a scene of a file; errors name the file.

    Raises
    ------
    FileError
        The scene is physically impossible, or the model has no choice of contact stretch.
    UnsupportedScene
        The models do not describe this protocol, or the papers hold none for this gripper.
    """
    from dataclasses import replace

    from model import InvalidParameter, predict
    from rig.errors import FileError

    bound = refuse_unmodelled(scene, source, rigid_bound=rigid_bound)
    if points < 16:
        raise FileError(f"--points {points}: a profile needs at least 16 points")
    if contact_stretch is not None and model != "membrane":
        raise FileError(
            f"--contact-stretch {contact_stretch}: --model {model} has no such assumption to choose. "
            "Remedy: add --model membrane, or leave the option out."
        )
    try:
        prediction = predict(scene.parameters(pressure_kPa), model, points=points, contact_stretch=contact_stretch)
    except InvalidParameter as error:
        raise FileError(f"scene {source}: {error}") from error
    if bound:
        return replace(prediction, warnings=(*prediction.warnings, bound))
    return prediction


def refuse_unmodelled(scene: Scene, source: str, *, rigid_bound: bool) -> str | None:
    """Return the label a prediction of this scene must carry, if any.

    Raises
    ------
    UnsupportedScene
        The models do not describe this protocol, or the papers hold none for this gripper.
    """
    from model import UnsupportedScene

    protocol = scene.protocol.name
    if protocol != "pull_off":
        remedy = "Remedy: run it and analyse its recording."
        if protocol == "indentation":
            remedy = "Remedy: `rig predict` answers with JKR's pull-off force."
        raise UnsupportedScene(f"scene {source}: the models do not describe the protocol {protocol}. {remedy}")
    kind = scene.gripper.kind
    if kind == "rigid":
        return None
    if kind == "soft" and rigid_bound:
        return "bound, not a prediction: the rigid gripper's model stands in for the soft one"
    remedy = {
        "soft": "--rigid-bound predicts the rigid gripper instead, as a labelled bound",
        "punch": "a rigid punch pulls off all fibres at once; analyse its recordings instead",
    }[kind]
    raise UnsupportedScene(
        f"scene {source}: gripper.kind = {kind!r} has no adhesion model in the papers. Remedy: {remedy}."
    )


def _indentation(scene: Scene, arguments: argparse.Namespace) -> int:
    """Print what JKR says of a test with a glass sphere (SI Eq. S13): a force, no profile."""
    from model import jkr
    from rig.errors import FileError
    from rig.scene import IndentationSection

    protocol = scene.protocol
    assert isinstance(protocol, IndentationSection)
    if arguments.plot is not None or arguments.profile or arguments.pressure_kpa is not None:
        raise FileError(
            f"scene {arguments.scene}: JKR gives the pull-off force of an indentation, no profile and no pressure. "
            "Remedy: leave --plot, --profile and --pressure-kpa out."
        )
    radius, work = protocol.indenter_radius_mm * 1e-3, scene.membrane.work_of_adhesion_J_m2
    force = jkr.pull_off_force_jkr(work, radius)
    assumption = "half-space; on a thin bonded layer the same work gives up to twice the force"
    if arguments.json:
        answer = {
            "model": "jkr",
            "pull_off_force_N": force,
            "work_of_adhesion_J_m2": work,
            "indenter_radius_m": radius,
            "assumptions": {"support": assumption},
        }
        print(json.dumps(answer))
    else:
        print(f"{scene.title}: JKR (SI Eq. S13)\n  F_off  {force:.6f} N   = 3/2 pi w R, w = {work:g} J/m^2, ", end="")
        print(f"R = {protocol.indenter_radius_mm:g} mm\n  {assumption}")
    return 0


def as_json(prediction: Prediction, *, profile: bool) -> dict[str, Any]:
    """Return the object of ``--json``; undefined features are null."""
    result: dict[str, Any] = {"model": prediction.model, "outcome": prediction.outcome.value}
    result.update({f"{name}_{unit}": number(getattr(prediction, name)) for name, unit in FEATURES.items()})
    result["numerical_error"] = {
        f"{name}_{unit}": number(prediction.numerical_error.get(name, math.nan)) for name, unit in FEATURES.items()
    }
    result["runtime_s"] = prediction.runtime_s
    result["assumptions"] = dict(prediction.assumptions)
    result["warnings"] = list(prediction.warnings)
    result["jumps"] = [
        {
            "position_m": jump.position,
            "radius_before_m": jump.radius_before,
            "radius_after_m": jump.radius_after,
            "force_before_N": jump.force_before,
            "force_after_N": jump.force_after,
        }
        for jump in prediction.jumps
    ]
    if profile:
        result.update({f"{name}_{unit}": getattr(prediction, name).tolist() for name, unit in PROFILE.items()})
    return result


def number(value: float) -> float | None:
    """Return a finite float, or None for JSON's null."""
    return float(value) if math.isfinite(value) else None


def as_text(prediction: Prediction, title: str, *, profile: bool) -> str:
    """Return the answer in words, lengths in mm."""
    lines = [f"{title}: {prediction.outcome.value} ({prediction.label})"]
    if math.isfinite(prediction.pull_off_force):
        error = prediction.numerical_error
        lines += [
            f"  F_p  {prediction.pull_off_force:.6f} N   "
            f"(+- {error.get('pull_off_force', math.nan):.1e} N numerically)",
            f"  D_p  {prediction.pull_off_distance * 1e3:.6f} mm  "
            f"(+- {error.get('pull_off_distance', math.nan) * 1e3:.1e} mm numerically)",
            f"  z_r at F_p     {prediction.retraction_at_pull_off * 1e3:.6f} mm",
            f"  F_r = 0        at z = {prediction.zero_force_position * 1e3:.6f} mm",
            f"  detachment     at z = {prediction.detachment_position * 1e3:.6f} mm, "
            f"r = {prediction.detachment_radius * 1e3:.6f} mm",
        ]
    lines += [
        f"  jump           at z = {jump.position * 1e3:.6f} mm, r = {jump.radius_before * 1e3:.4f} -> "
        f"{jump.radius_after * 1e3:.4f} mm"
        for jump in prediction.jumps
    ]
    lines += [f"  note: {warning}" for warning in prediction.warnings]
    lines.append("  " + "; ".join(f"{name}: {choice}" for name, choice in prediction.assumptions.items()))
    lines.append(f"  run time {prediction.runtime_s * 1e3:.2f} ms")
    if profile:
        lines += ["retraction_m\tforce_N\tpressure_Pa\tcontact_radius_m"]
        columns = [getattr(prediction, name) for name in PROFILE]
        lines += ["\t".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True)]
    return "\n".join(lines)
