"""The papers' derived quantities with uncertainties: ratio, stress, efficiency; and whether S13 is valid."""

from __future__ import annotations

import math
from dataclasses import dataclass

from analysis.quantity import Quantity
from analysis.run import Run
from model import jkr
from model.parameters import Parameters

INTERFACE_STRENGTH = 100.8e3
"""Stress over the contact at pull-off of the fibres in Table S3, Pa, where no area of the run's own is known."""

LARGEST_RATIO_FOR_HALF_SPACE = 0.1
"""Contact radius over film thickness up to which a film on glass counts as a half-space."""


def quotient(numerator: Quantity, denominator: Quantity, unit: str, explanation: str) -> Quantity:
    """Return numerator / denominator; their uncertainties are taken as independent."""
    value = numerator.value / denominator.value
    parts = {
        "numerator": abs(numerator.uncertainty / denominator.value),
        "denominator": abs(value * denominator.uncertainty / denominator.value),
    }
    return Quantity(value, math.hypot(*parts.values()), unit, explanation, parts)


def enhancement_ratio(largest: Quantity, least: Quantity) -> Quantity:
    """Return F_off|Max / F_off|Min (Table S1). The common error of the load cell's gain cancels and is left out."""
    return quotient(_without_gain(largest), _without_gain(least), "", "largest over least pull-off force")


def _without_gain(force: Quantity) -> Quantity:
    parts = {source: part for source, part in force.budget.items() if source != "force calibration"}
    total = math.sqrt(sum(part**2 for part in parts.values())) if parts else force.uncertainty
    return Quantity(force.value, total, force.unit, force.explanation, parts)


def area_of(run: Run, key: str) -> float | None:
    """Return an area of the run's settings, m^2, or ``None``."""
    area = run.settings.get(key)
    return float(area) * (1e-6 if key.endswith("_mm2") else 1e-12) if isinstance(area, int | float) else None


def full_contact_radius(parameters: Parameters) -> float:
    """Return r_e, or the radius of a flat disk that is smaller, m."""
    return min(parameters.gripper.effective_radius, (parameters.substrate.diameter or math.inf) / 2)


def full_contact_area(radius: float, uncertainty: float = 0.0) -> Quantity:
    """Return A_c = pi r_e^2 (m in, m^2 out)."""
    return Quantity(math.pi * radius**2, 2 * math.pi * radius * uncertainty, "m^2", "π r_e²")


def adhesion_stress(force: Quantity, area: Quantity) -> Quantity:
    """Return sigma_ad = F_off / A_c, Pa."""
    return quotient(force, area, "Pa", "pull-off force over contact area")


def adhesion_efficiency(stress: Quantity, reference: Quantity) -> Quantity:
    """Return eps_ad = (F_off / A_c) / sigma_ad, sigma_ad from the JKR test of the same membrane."""
    return quotient(stress, reference, "", "adhesion stress over that of the JKR test")


@dataclass(frozen=True)
class Validity:
    """Whether S13 may be read as a work of adhesion.

    Attributes
    ----------
    tabor, maugis
        Tabor parameter, for the reach w / strength, and Maugis' lambda: JKR above 5, DMT below 0.1.
    confinement
        Contact radius over film thickness: a half-space below about 0.1.
    bounds
        Works of adhesion that the same force means for other supports, J/m^2.
    remarks
        What speaks against S13, in words; empty where nothing does.
    """

    tabor: float
    maugis: float
    confinement: float
    bounds: jkr.WorkOfAdhesionBounds
    remarks: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether nothing speaks against S13."""
        return not self.remarks


def validity(
    force: float, radius: float, modulus: float, thickness: float, contact_radius: float | None, strength: float
) -> Validity:
    """Check the assumptions behind S13.

    JKR lets adhesion act at the edge of the contact alone. Fibres hold over a reach of w / strength, some of their own
    height; van der Waals forces of bare surfaces over 0.3 nm.

    Parameters
    ----------
    force, radius
        F_off (N) and R (m).
    modulus
        Contact modulus E*, Pa.
    thickness
        Of the film on its rigid support, m.
    contact_radius
        At pull-off, m; ``None``: the one JKR gives.
    strength
        Stress that the interface carries, Pa.
    """
    work = jkr.work_of_adhesion_jkr(force, radius)
    tabor = jkr.tabor_parameter(work, radius, modulus, work / strength)
    maugis = jkr.maugis_parameter(work, radius, modulus, strength)
    contact = (3 * force * radius / (4 * modulus)) ** (1 / 3) if contact_radius is None else contact_radius
    confinement = contact / thickness
    remarks = []
    if tabor < 5:
        regime = "DMT" if tabor < 0.1 else "the transition between DMT and JKR"
        excess = jkr.pull_off_force_maugis(work, radius, modulus, strength) / force - 1
        remarks.append(
            f"Tabor parameter {tabor:.2g}, Maugis' lambda {maugis:.2g}: {regime}, not JKR; adhesion that reaches "
            f"{work / strength * 1e6:.2g} µm holds {excess:.0%} more force, so w is about as much too high"
        )
    bounds = jkr.thin_layer_bounds(force, radius)
    if confinement > LARGEST_RATIO_FOR_HALF_SPACE:
        remarks.append(
            f"contact radius {confinement:.2g} times the film's thickness: no half-space; "
            f"thin-layer limits give {bounds.incompressible_layer:.2g} to {bounds.half_space:.2g} J/m²"
        )
    return Validity(tabor, maugis, confinement, bounds, tuple(remarks))
