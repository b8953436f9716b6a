"""The JKR test: work of adhesion, its validity, and the fits of JKR, DMT and Maugis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis import FeatureMissing, Run, Sensors, analyze
from analysis.derived import (
    adhesion_efficiency,
    adhesion_stress,
    enhancement_ratio,
    full_contact_area,
    validity,
)
from analysis.indentation import fit_contact
from analysis.quantity import Quantity
from analysis.synthetic import Experiment, Imperfections, Profile, pull_off_run
from model import jkr
from model.parameters import Membrane, Parameters, Substrate

RADIUS, MODULUS, WORK = 4e-3, 2e6, 4.1


def indentation_run(profile: Profile | None = None, **settings: float | str) -> Run:
    experiment = Experiment(
        rate=500.0,
        retract_speed=10e-6,
        preload=0.1,
        approach_stiffness=20000.0,
        dwell=2.0,
        settle=1.5,
        settings={"indenter_radius_mm": 4.0, **settings},
    )
    profile = profile or Profile.jkr(WORK, RADIUS, MODULUS, 0.095)
    run, _ = pull_off_run(profile, experiment, Imperfections(force_noise=1e-4), sensors=Sensors(force_gain=2e-3))
    membrane = Membrane(youngs_modulus=2e6, thickness=250e-6)
    return replace(
        run, protocol="indentation", pressure=None, parameters=Parameters(Substrate("flat"), membrane=membrane)
    )


def test_work_of_adhesion_from_the_pull_off_force() -> None:
    features = analyze(indentation_run()).features
    work = features["work_of_adhesion_J_m2"]
    assert work.value == pytest.approx(WORK, abs=3 * work.uncertainty)
    assert features.value("work_of_adhesion_thin_layer_J_m2") == pytest.approx(work.value / 2)
    fitted = features["fitted_work_of_adhesion_J_m2"]
    assert fitted.value == pytest.approx(WORK, rel=0.01)
    assert features.value("fitted_modulus_Pa") == pytest.approx(MODULUS, rel=0.02)
    assert fitted.uncertainty > 0.002 * fitted.value


def test_validity_is_stated_with_the_number() -> None:
    analysis = analyze(indentation_run(), uncertainties=False)
    words = analysis.decisions["Work of adhesion (S13)"]
    assert "no half-space" in words
    assert "thin-layer" in words


def test_area_from_the_still_image_gives_the_stress() -> None:
    features = analyze(indentation_run(contact_area_mm2=0.78), uncertainties=False).features
    assert features.value("contact_stress_Pa") == pytest.approx(features.value("pull_off_force_N") / 0.78e-6)
    assert "still image" in analyze(indentation_run(), uncertainties=False).features.missing["projected_area_m2"]


def test_area_and_radius_are_in_the_budgets() -> None:
    features = analyze(
        indentation_run(contact_area_mm2=0.78, contact_area_uncertainty_mm2=0.0156, indenter_radius_uncertainty_mm=0.04)
    ).features
    assert features["projected_area_m2"].uncertainty == pytest.approx(0.0156e-6)
    stress = features["contact_stress_Pa"]
    assert stress.budget["contact area"] == pytest.approx(0.02 * stress.value, rel=0.03)
    for name in ("work_of_adhesion_J_m2", "fitted_work_of_adhesion_J_m2"):
        work = features[name]
        assert work.budget["indenter radius"] == pytest.approx(0.01 * work.value, rel=0.2)
    assert "indenter radius" not in features["pull_off_force_N"].budget
    unstated = analyze(indentation_run(contact_area_mm2=0.78)).features["projected_area_m2"]
    assert unstated.uncertainty == pytest.approx(0.05 * unstated.value)


def test_without_a_radius_there_is_no_work_of_adhesion() -> None:
    run = replace(indentation_run(), settings={})
    features = analyze(run, uncertainties=False).features
    with pytest.raises(FeatureMissing, match="indenter_radius_mm"):
        features["work_of_adhesion_J_m2"]
    assert features.value("pull_off_force_N") > 0


@pytest.mark.parametrize("truth", ["JKR", "DMT", "Maugis"])
def test_each_contact_model_is_recovered_from_its_own_curve(truth: str) -> None:
    curve = {
        "JKR": jkr.jkr_curve(WORK, RADIUS, 2e5, largest_contact=2e-3, points=2000),
        "DMT": jkr.dmt_curve(WORK, RADIUS, 2e5, largest_contact=1.2e-3, points=2000),
        "Maugis": jkr.maugis_curve(WORK, RADIUS, 2e5, 2e4, largest_contact=1.5e-3, points=2000),
    }[truth]
    force = curve.force + np.random.default_rng(0).normal(0, 2e-4, curve.force.size)
    fits = {fit.model: fit for fit in fit_contact(-curve.indentation, force, RADIUS)}
    degenerate = 0.15 if truth == "Maugis" else 0.03  # strength and work of adhesion nearly exchange
    assert fits[truth].work_of_adhesion == pytest.approx(WORK, rel=degenerate)
    assert fits[truth].modulus == pytest.approx(2e5, rel=0.03)
    assert fits[truth].misfit == pytest.approx(2e-4 / np.sqrt(6), rel=0.35)
    assert fits[truth].misfit <= 1.1 * min(fit.misfit for fit in fits.values())


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_a_line_that_is_pinned_at_first_does_not_stiffen_the_modulus(share: float) -> None:
    curve = jkr.jkr_curve(WORK, RADIUS, MODULUS, largest_contact=0.7e-3, points=2000)
    depth = np.linspace(curve.indentation[0], curve.indentation[-1], 2000)
    corner = depth[0] - share * (depth[0] - depth[int(np.argmin(np.interp(-depth, -curve.indentation, curve.force)))])
    contact = float(jkr.jkr_contact_radius(corner, WORK, RADIUS, MODULUS))
    force = jkr.jkr_force(np.minimum(depth, corner), WORK, RADIUS, MODULUS)
    force += 2 * MODULUS * contact * np.maximum(depth - corner, 0.0)
    noise = np.random.default_rng(0).normal(0, 2e-4, depth.size)
    best = fit_contact(-depth, force + noise, RADIUS, models=("JKR", "DMT"))[0]
    assert best.model == "JKR"
    assert best.modulus == pytest.approx(MODULUS, rel=0.01)
    assert best.work_of_adhesion == pytest.approx(WORK, rel=0.01)
    assert best.corner == pytest.approx(-corner, abs=2e-6)


def run_with_rate(power: float) -> Run:
    """Return a test whose work of adhesion grows with a power of the line's speed, and is ``WORK`` at F_p."""
    profile = Profile.jkr(WORK, RADIUS, MODULUS, 0.095)
    place, work = profile.retraction, np.full(profile.retraction.size, WORK)
    for _ in range(8):
        contact = np.array([jkr.jkr_contact_radius(-z, w, RADIUS, MODULUS) for z, w in zip(place, work, strict=True)])
        place, work, contact = (values[np.isfinite(contact)] for values in (place, work, contact))
        force = np.array([jkr.jkr_force_at(a, w, RADIUS, MODULUS) for a, w in zip(contact, work, strict=True)])
        speed = np.maximum.accumulate(-np.gradient(contact, place))
        work = WORK * (speed / speed[int(np.argmin(force))]) ** power
    return indentation_run(Profile(place, force, np.zeros(place.size)))


def test_a_work_of_adhesion_that_grows_with_the_lines_speed_leaves_the_modulus_alone() -> None:
    analysis = analyze(run_with_rate(0.03))
    best, _ = analysis.work.details["contact models"]["fits"]
    assert best.modulus / (1 + best.rate_shift[1]) < 0.993 * MODULUS
    modulus, work = (analysis.features[f"fitted_{name}"] for name in ("modulus_Pa", "work_of_adhesion_J_m2"))
    assert modulus.value == pytest.approx(MODULUS, rel=0.005)
    assert work.value == pytest.approx(WORK, rel=0.005)
    assert modulus.budget["fit"] > 0.005 * modulus.value


def test_a_model_that_does_not_fit_casts_no_doubt_on_the_one_that_does() -> None:
    analysis = analyze(indentation_run())
    best, rival = analysis.work.details["contact models"]["fits"]
    assert (best.model, rival.model) == ("JKR", "DMT")
    assert abs(rival.work_of_adhesion / best.work_of_adhesion - 1) > 0.2
    for name in ("fitted_modulus_Pa", "fitted_work_of_adhesion_J_m2"):
        fitted = analysis.features[name]
        assert fitted.budget["fit"] < 0.01 * fitted.value


def test_no_force_stretches_the_load_train_where_a_jkr_contact_ends() -> None:
    run = indentation_run()
    soft = replace(run, sensors=replace(run.sensors, compliance=12e-6))
    stiff, measured = (analyze(one, uncertainties=False).features.value("pull_off_distance_m") for one in (run, soft))
    assert measured == pytest.approx(stiff, abs=1e-9)


def test_fit_refuses_a_curve_without_tension() -> None:
    with pytest.raises(FeatureMissing, match="no tension"):
        fit_contact(np.linspace(-1e-4, 0, 500), np.linspace(0.1, 0.01, 500), RADIUS)


def test_the_papers_quantities() -> None:
    force = Quantity(0.88, 0.01, "N", budget={"force calibration": 0.008, "noise": 0.006})
    least = Quantity(0.30, 0.005, "N", budget={"force calibration": 0.004, "noise": 0.003})
    area = full_contact_area(7.3e-3)
    assert area.value * 1e4 == pytest.approx(1.674, abs=1e-3)
    stress = adhesion_stress(force, area)
    assert stress.value == pytest.approx(5256, rel=1e-3)
    assert adhesion_efficiency(stress, Quantity(100.8e3, 0, "Pa")).value == pytest.approx(0.0521, abs=1e-4)
    ratio = enhancement_ratio(force, least)
    assert ratio.value == pytest.approx(2.933, abs=1e-3)
    assert ratio.uncertainty == pytest.approx(ratio.value * np.hypot(0.006 / 0.88, 0.003 / 0.30))


def test_validity_by_tabor_and_confinement() -> None:
    thick = validity(78e-3, 4e-3, 2.7e6, 0.1, 0.5e-3, 10e6)
    assert thick.holds
    assert thick.tabor > 5
    film = validity(78e-3, 4e-3, 2.7e6, 250e-6, 0.5e-3, 10e6)
    assert not film.holds
    assert film.confinement == pytest.approx(2.0)
    assert film.bounds.half_space == pytest.approx(2 * film.bounds.incompressible_layer)
    stiff = validity(1e-8, 1e-6, 70e9, 1.0, None, 5e6)
    assert any("DMT" in remark for remark in stiff.remarks)


def test_fibers_reach_too_far_for_jkr() -> None:
    """4.1 J/m^2 at 100.8 kPa reach 41 um, not the 0.3 nm of bare surfaces: the transition between JKR and DMT."""
    force = 1.5 * np.pi * 4.1 * RADIUS
    found = validity(force, RADIUS, 8 / 3 * 1e6, 0.1, None, 100.8e3)
    assert found.tabor == pytest.approx(0.52, abs=0.03)
    assert found.maugis == pytest.approx(0.59, abs=0.04)
    (remark,) = found.remarks
    assert "transition" in remark
    assert "13% more" in remark
    words = analyze(indentation_run(), uncertainties=False).decisions["Work of adhesion (S13)"]
    assert "Tabor" in words
    assert "lambda" in words
