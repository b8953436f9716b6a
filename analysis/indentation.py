"""The JKR test (SI S4): work of adhesion from the pull-off force, contact area, and fits of JKR, DMT and Maugis."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from analysis.derived import INTERFACE_STRENGTH, area_of, validity
from analysis.errors import FeatureMissing
from analysis.extraction import Details, Extraction, extraction_step
from analysis.numerics import RECTANGULAR, Array, block_means
from analysis.run import Run
from model import jkr

POINTS = 300
"""The retraction curve is averaged into so many points before a fit."""

FEWEST = 12
"""Points that a fit needs."""

FITTED = {"fitted_work_of_adhesion_J_m2": "work_of_adhesion", "fitted_modulus_Pa": "modulus"}
"""Features of the better fit, and which of its attributes each is."""

FIRST_ORDER = 0.2
"""A correction of w and E* by more than that is none of first order."""

DEPENDENT = 1e-6
"""Directions of the unknowns that the curve shows less than that, of the one it shows most, stay as they are."""

WIDEST = 7.0
"""Work of adhesion, modulus and strength are sought within this logarithm of the first guess."""


def indenter_radius(run: Run) -> float:
    """Return R, m, from the scene.

    Raises
    ------
    FeatureMissing
        The scene names none.
    """
    radius = run.settings.get("indenter_radius_mm")
    if not isinstance(radius, int | float):
        raise FeatureMissing("the scene names no indenter_radius_mm")
    return float(radius) * 1e-3


@extraction_step(
    "work of adhesion",
    title="Work of adhesion (S13)",
    after=("pull-off",),
    protocols=("indentation",),
    gives={
        "work_of_adhesion_J_m2": "w = 2 F_off / (3 pi R), SI Eq. S13",
        "work_of_adhesion_thin_layer_J_m2": "the same force read for a thin incompressible bonded layer, F / (3 pi R)",
    },
)
def work_of_adhesion(work: Extraction) -> Details:
    """Apply S13, and check it: reach of the adhesion (Tabor, Maugis), and contact radius against the film's thickness.

    It reaches as far as w over the stress it carries: that over the contact's area of this run, or of Table S3.
    """
    radius = indenter_radius(work.run)
    force = work.values["pull_off_force_N"]
    bounds = jkr.thin_layer_bounds(force, radius)
    work.set(
        work_of_adhesion_J_m2=bounds.half_space,
        work_of_adhesion_thin_layer_J_m2=bounds.incompressible_layer,
    )
    if work.run.parameters is None:
        return {"decision": "S13; without the membrane's modulus and thickness its validity is unknown"}
    membrane = work.run.parameters.membrane
    modulus = jkr.contact_modulus(membrane.youngs_modulus)
    area = projected_area(work.run)
    contact = None if area is None else math.sqrt(area / math.pi)
    strength = INTERFACE_STRENGTH if area is None else force / area
    found = validity(force, radius, modulus, membrane.thickness, contact, strength)
    holds = f"S13 holds: Tabor parameter {found.tabor:.2g}, Maugis' lambda {found.maugis:.2g}"
    decision = holds if found.holds else "S13 with reserve: " + "; ".join(found.remarks)
    return {"decision": decision, "validity": found}


@extraction_step(
    "contact area",
    title="Projected contact area",
    after=("pull-off",),
    protocols=("indentation", "fiber", "punch"),
    gives={
        "projected_area_m2": "contact area seen at pull-off",
        "contact_stress_Pa": "F_off over the projected area",
    },
)
def contact_area(work: Extraction) -> Details:
    """Take the area measured on the still image of this recording and divide the force by it.

    It comes from ``rig analyze --areas`` or from the scene (``contact_area_mm2``, ``projected_area_um2`` of fibres),
    with its uncertainty; where none is stated, five per cent of the area.
    """
    area = projected_area(work.run)
    if area is None:
        raise FeatureMissing("no contact area: no still image was measured for this run (rig analyze --areas)")
    work.set(projected_area_m2=area, contact_stress_Pa=work.values["pull_off_force_N"] / area)
    return {"decision": f"A_pc = {area * 1e6:.3g} mm²"}


@extraction_step(
    "real contact area",
    title="Real contact area",
    after=("pull-off",),
    protocols=("fiber",),
    gives={
        "real_area_m2": "real contact area of the fibres",
        "real_contact_stress_Pa": "F_off over the real contact area",
    },
)
def real_contact_area(work: Extraction) -> Details:
    """Take the area of the fibres' tips seen by the confocal microscope (``real_area_um2``); divide the force by it."""
    area = area_of(work.run, "real_area_um2")
    if area is None:
        raise FeatureMissing("no real_area_um2 was measured for this run (rig analyze --areas)")
    work.set(real_area_m2=area, real_contact_stress_Pa=work.values["pull_off_force_N"] / area)
    return {"decision": f"A_rc = {area * 1e12:.5g} µm²"}


def projected_area(run: Run) -> float | None:
    """Return the projected area measured for a run, m^2, or ``None``."""
    return area_of(run, "projected_area_um2" if run.protocol == "fiber" else "contact_area_mm2")


@dataclass(frozen=True)
class ContactFit:
    """A contact model fitted to a retraction curve.

    Attributes
    ----------
    model
        ``"JKR"``, ``"DMT"`` or ``"Maugis"``.
    work_of_adhesion, modulus
        J/m^2 and contact modulus E*, Pa; with standard uncertainties from the fit's covariance.
    rate_shift
        What both change by, relatively, if the work of adhesion may grow with the line's speed; where that is asked.
    origin
        Separation at first touch, m.
    corner
        Separation at which the contact line begins to recede, m; below it is pinned.
    strength
        Cohesive strength of Maugis, Pa; ``nan`` for the others.
    misfit
        Root mean square residual, N.
    stretches
        Parts of the curve that lie on one side of the fit each: as many points say something of their own.
    separation, force
        The fitted curve.
    """

    model: str
    work_of_adhesion: float
    work_of_adhesion_uncertainty: float
    modulus: float
    modulus_uncertainty: float
    rate_shift: tuple[float, float]
    origin: float
    corner: float
    strength: float
    misfit: float
    stretches: int
    separation: Array
    force: Array


def fit_contact(
    separation: Array, force: Array, radius: float, *, models: tuple[str, ...] = ("JKR", "DMT", "Maugis")
) -> list[ContactFit]:
    """Fit JKR, DMT and Maugis to the retraction curve of a JKR test.

    Parameters
    ----------
    separation, force
        (n,), m, rising, and N, compression positive: the attached part of the retraction.
    radius
        R of the indenter, m.

    Returns
    -------
    list
        One fit per model, best first. Free are w, E*, the origin, the separation at which the contact line begins to
        recede and, for Maugis, the cohesive strength.

    Notes
    -----
    At first the line is pinned (adhesion hysteresis): down to the depth where it begins to recede, force and depth are
    linear, with the stiffness 2 E* a of a punch of the contact radius a there (Johnson 1971).

    Raises
    ------
    FeatureMissing
        The curve holds no tension or too few points.
    """
    length = max(1, separation.size // POINTS)
    place, pull = block_means(separation, length), block_means(force, length)
    if place.size < FEWEST or pull.min() >= 0:
        raise FeatureMissing("the retraction holds no tension to fit")
    work, modulus, origin = _first_guess(place, pull, radius)
    first = _cornered("JKR", place, pull, radius, [math.log(work), math.log(modulus)], origin)
    return sorted((_fit(model, place, pull, radius, first) for model in models), key=lambda fit: fit.misfit)


def _jkr(depth: Array, logs: Array, radius: float) -> tuple[Array, Array]:
    work, modulus = (float(value) for value in np.exp(logs[:2]))
    pull = math.pi * work / (2 * modulus)
    root = (radius * math.sqrt(pull) / 2) ** (1 / 3)
    fold = root**4 / radius - 2 * math.sqrt(pull) * root
    reached = np.maximum(depth, fold * (1 - 1e-12))
    contact = jkr.jkr_contact_radius(reached, work, radius, modulus)
    return jkr.jkr_force_at(contact, work, radius, modulus), contact


def _dmt(depth: Array, logs: Array, radius: float) -> tuple[Array, Array]:
    work, modulus = np.exp(logs[:2])
    contact = np.sqrt(np.maximum(depth, 0.0) * radius)
    return 4 * modulus * contact**3 / (3 * radius) - 2 * np.pi * radius * work, contact


def _maugis(depth: Array, logs: Array, radius: float) -> tuple[Array, Array]:
    work, modulus, strength = (float(value) for value in np.exp(logs[:3]))
    deepest = max(float(depth.max()), 1e-9)
    contact = 1.5 * math.sqrt(deepest * radius) + 3.0 * (radius**2 * work / modulus) ** (1 / 3)
    curve = jkr.maugis_curve(work, radius, modulus, strength, largest_contact=contact, points=400)
    rising = curve.indentation[::-1]
    return np.interp(depth, rising, curve.force[::-1]), np.interp(depth, rising, curve.contact_radius[::-1])


LAWS: dict[str, Callable[[Array, Array, float], tuple[Array, Array]]] = {"JKR": _jkr, "DMT": _dmt, "Maugis": _maugis}
"""Force and contact radius at a depth for the logarithms of w, E* (and strength), while the line recedes.

Beyond the last stable contact its force is kept.
"""


def _force(model: str, depth: Array, corner: float, logs: Array, radius: float) -> Array:
    """Force at a depth where the line is pinned at depths beyond ``corner``."""
    force, contact = LAWS[model](np.minimum(depth, corner), logs, radius)
    return force + 2 * math.exp(logs[1]) * contact * np.maximum(depth - corner, 0.0)


def _fit(model: str, place: Array, pull: Array, radius: float, first: ContactFit) -> ContactFit:
    """Fit a model, starting from the fit of JKR."""
    if model == "JKR":
        return first
    logs = [math.log(first.work_of_adhesion), math.log(first.modulus)]
    if model == "DMT":
        return _cornered("DMT", place, pull, radius, logs, first.origin)
    length = (math.pi * first.work_of_adhesion * (4 / 3 * first.modulus) ** 2 / radius) ** (1 / 3)
    starts = ([*logs, math.log(cohesion * length / 2)] for cohesion in (0.3, 1.0, 4.0))
    return min(
        (_solve("Maugis", place, pull, radius, start, first.corner, first.origin) for start in starts),
        key=lambda fit: fit.misfit,
    )


def _cornered(model: str, place: Array, pull: Array, radius: float, logs: list[float], origin: float) -> ContactFit:
    """Fit from a line that recedes from the start, then from one that is pinned at first; keep the better."""
    free = _solve(model, place, pull, radius, logs, float(place.min()), origin)
    logs = [math.log(free.work_of_adhesion), math.log(free.modulus)]
    pinned = _solve(model, place, pull, radius, logs, float(np.median(place)), free.origin)
    return min((free, pinned), key=lambda fit: fit.misfit)


def _solve(
    model: str,
    place: Array,
    pull: Array,
    radius: float,
    logs: list[float],
    corner: float,
    origin: float,
    *,
    rate: bool = False,
) -> ContactFit:
    """Least squares over the logarithms of w, E* (and strength), and corner and origin in micrometres.

    The line begins to recede somewhere between the deepest point and that of the largest tension. With ``rate`` w grows
    with a power of its speed; the power is found to first order, and left out where that would not do.
    """
    from scipy.optimize import least_squares

    scale = float(np.ptp(pull))
    first, last = float(place.min()), float(place[int(np.argmin(pull))])

    def residual(unknown: Array) -> Array:
        corner, origin = (float(value) * 1e-6 for value in unknown[-2:])
        return (_force(model, origin - place, origin - corner, unknown[:-2], radius) - pull) / scale

    start = np.array([*logs, min(max(corner, first), last) / 1e-6, origin / 1e-6])
    lowest = np.array([*(log - WIDEST for log in logs), first / 1e-6 - 1e-3, -np.inf])
    highest = np.array([*(log + WIDEST for log in logs), last / 1e-6 + 1e-3, np.inf])
    solution = least_squares(residual, start, bounds=(lowest, highest), max_nfev=200, x_scale="jac")
    found, residuals = solution.x, np.asarray(solution.fun, dtype=np.float64)
    columns, shift = np.asarray(solution.jac, dtype=np.float64), (0.0, 0.0)
    if rate:
        columns = np.column_stack([columns, columns[:, 0] * _faster(model, place, radius, found)])
        moved = -np.linalg.pinv(columns) @ residuals
        shift = (float(moved[0]), float(moved[1]))
        if math.hypot(*shift) < FIRST_ORDER:
            found, residuals = found + moved[:-1], residuals + columns @ moved
    variance = float(np.sum(residuals**2)) / max(1, place.size - columns.shape[1])
    spread = np.sqrt(np.sum(np.linalg.pinv(columns, DEPENDENT) ** 2, axis=1) * variance)
    return ContactFit(
        model=model,
        work_of_adhesion=math.exp(found[0]),
        work_of_adhesion_uncertainty=math.exp(found[0]) * float(spread[0]),
        modulus=math.exp(found[1]),
        modulus_uncertainty=math.exp(found[1]) * float(spread[1]),
        rate_shift=shift,
        origin=float(found[-1]) * 1e-6,
        corner=float(found[-2]) * 1e-6,
        strength=math.exp(found[2]) if model == "Maugis" else math.nan,
        misfit=float(np.sqrt(np.mean(residuals**2))) * scale,
        stretches=1 + int(np.count_nonzero(np.diff(np.signbit(residuals)))),
        separation=place,
        force=residuals * scale + pull,
    )


def _faster(model: str, place: Array, radius: float, found: Array) -> Array:
    """Return the logarithm of the line's speed, over that at the largest tension; while pinned, as it begins to recede.

    Zero where too little of it is seen to recede.
    """
    corner, origin = (float(value) * 1e-6 for value in found[-2:])
    force, contact = LAWS[model](np.minimum(origin - place, origin - corner), found[:-2], radius)
    speed = -np.gradient(contact)
    moving = np.flatnonzero((place > corner) & (speed > 0))
    if moving.size < FEWEST:
        return np.zeros(place.size)
    logarithm = np.interp(np.arange(place.size), moving, np.log(speed[moving]))
    return np.asarray(logarithm - logarithm[int(np.argmin(force))], dtype=np.float64)


def _first_guess(place: Array, pull: Array, radius: float) -> tuple[float, float, float]:
    """Work from S13; modulus from the slope of the curve over its span; origin a fifth of the span before the peak."""
    force = -float(pull.min())
    span = max(float(np.ptp(place)), 1e-9)
    modulus = float(np.ptp(pull)) / span / (2 * math.sqrt(radius * span))
    return jkr.work_of_adhesion_jkr(force, radius), modulus, float(place[int(np.argmin(pull))]) - 0.2 * span


@extraction_step(
    "contact models",
    title="JKR and DMT beside S13",
    after=("work of adhesion", "detachment"),
    protocols=("indentation",),
    gives={
        "fitted_work_of_adhesion_J_m2": "work of adhesion of the contact model that fits the retraction best",
        "fitted_modulus_Pa": "contact modulus E* of that model",
    },
)
def contact_models(work: Extraction) -> Details:
    """Fit JKR and DMT to the attached part of the retraction, F against z, and keep the better.

    At first the contact line is pinned (hysteresis), and the contact as stiff as a punch; where it begins to recede is
    fitted too, and how the work of adhesion grows with the line's speed: w is that at the largest tension. The fit is
    repeated on the perturbed copies of the run. Added to the uncertainty is what that growth has changed, as the half
    width of a rectangle, and how far off the other model is, with the odds on it: the ratio of the misfits to the power
    of the number of stretches that lie to one side of the better fit.

    Maugis has one parameter more and is fitted on request only (``fit_contact``): it follows noise where the others
    suffice.
    """
    start, _ = work.retraction()
    part = slice(start, int(work.release))
    radius = indenter_radius(work.run)
    if work.earlier is not None:
        return _fitted_again(work, work.earlier, part, radius)
    first, rival = fit_contact(work.separation[part], work.force[part], radius, models=("JKR", "DMT"))
    best = _with_rate(first, work, part, radius)
    odds = (first.misfit / rival.misfit) ** first.stretches
    doubt = math.sqrt(odds / (1 + odds))
    for (name, key), shift in zip(FITTED.items(), best.rate_shift, strict=True):
        value, other = (float(getattr(fit, key)) for fit in (best, rival))
        work.set(**{name: value})
        own = float(getattr(best, f"{key}_uncertainty"))
        work.stated[name] = math.hypot(own, value * shift / RECTANGULAR, doubt * (value - other))
    words = "; ".join(
        f"{fit.model}: w = {fit.work_of_adhesion:.3g} J/m², misfit {fit.misfit * 1e3:.2g} mN" for fit in (best, rival)
    )
    pinned = (best.corner - float(best.separation[0])) * 1e6
    return {"decision": f"{words}; the line recedes after {max(pinned, 0.0):.0f} um", "fits": (best, rival)}


def _fitted_again(work: Extraction, earlier: Extraction, part: slice, radius: float) -> Details:
    """Fit a changed copy of a run, from the fit of the run itself."""
    if "contact models" not in earlier.details:
        raise FeatureMissing(earlier.failed["contact models"])
    fits = earlier.details["contact models"]["fits"]
    assert isinstance(fits, tuple)
    fit = _with_rate(fits[0], work, part, radius)
    work.set(**{name: float(getattr(fit, key)) for name, key in FITTED.items()})
    return {"decision": "as before", "fits": (fit,)}


def _with_rate(near: ContactFit, work: Extraction, part: slice, radius: float) -> ContactFit:
    """Fit the model of another fit, from there, with a work of adhesion that grows with the line's speed."""
    length = max(1, (part.stop - part.start) // POINTS)
    place, pull = block_means(work.separation[part], length), block_means(work.force[part], length)
    if place.size < FEWEST:
        raise FeatureMissing("the retraction holds too little to fit")
    logs = [math.log(near.work_of_adhesion), math.log(near.modulus)]
    return _solve(near.model, place, pull, radius, logs, near.corner, near.origin, rate=True)
