"""Where retraction begins: z_0 and r_i of EML Eqs. 12-14, and what makes a scene impossible."""

from __future__ import annotations

import itertools
import math

from model.errors import InvalidParameter
from model.parameters import GasAnchor, Gripper, Parameters, Substrate


def start_position(substrate: Substrate, gripper: Gripper) -> float:
    """Return z_0 in m: the rim at the sphere's equator, or touching a sphere wider than itself (EML Eqs. 12-14)."""
    if substrate.shape == "flat":
        return 0.0
    sphere, rim = substrate.radius, gripper.radius
    if sphere <= rim:
        return -sphere
    return -(rim**2) / (sphere + math.sqrt((sphere - rim) * (sphere + rim)))


def start_radius(substrate: Substrate, gripper: Gripper) -> float:
    """Return r_i in m.

    On a sphere no wider than the rim this is the tangent point r_b^2 / R_0 unless that exceeds r_e, which is
    continuous in r_b; SI Eq. S5 jumps there instead.
    """
    if substrate.shape == "flat":
        return (
            gripper.effective_radius
            if substrate.diameter is None
            else min(substrate.diameter / 2, gripper.effective_radius)
        )
    if substrate.radius <= gripper.radius:
        return min(substrate.radius**2 / gripper.radius, gripper.effective_radius)
    return gripper.effective_radius


def check(parameters: Parameters) -> None:
    """Refuse what is not a physical scene.

    Raises
    ------
    InvalidParameter
        Names the quantity, its value and the allowed range.
    """
    gripper, membrane, gas = parameters.gripper, parameters.membrane, parameters.gas
    _positive("R_0", gripper.radius, "m")
    _positive("r_e", gripper.effective_radius, "m")
    _positive("V_0", gripper.chamber_volume, "m^3")
    _positive("E_m", membrane.youngs_modulus, "Pa")
    _positive("h_0", membrane.thickness, "m")
    _positive("P_atm", gas.atmospheric_pressure, "Pa")
    if parameters.substrate.shape not in ("sphere", "flat"):
        raise InvalidParameter(f"substrate {parameters.substrate.shape!r} is neither 'sphere' nor 'flat'")
    if parameters.substrate.diameter is not None:
        _positive("d_b", parameters.substrate.diameter, "m")
    elif parameters.substrate.shape == "sphere":
        raise InvalidParameter("a sphere needs its diameter d_b")
    if gripper.effective_radius > gripper.radius:
        raise InvalidParameter(
            f"r_e = {gripper.effective_radius:g} m exceeds R_0 = {gripper.radius:g} m; "
            "the contact cannot be wider than the gripper"
        )
    if not (math.isfinite(membrane.work_of_adhesion) and membrane.work_of_adhesion >= 0):
        raise InvalidParameter(f"omega_a = {membrane.work_of_adhesion:g} J/m^2 must be finite and at least 0")
    if not math.isfinite(gas.initial_pressure) or gas.initial_pressure <= -gas.atmospheric_pressure:
        raise InvalidParameter(
            f"P_0 = {gas.initial_pressure:g} Pa (gauge) must be finite and above vacuum, "
            f"-{gas.atmospheric_pressure:g} Pa"
        )
    if gas.anchor is GasAnchor.MEASURED:
        _check_measured(parameters)


def _positive(name: str, value: float, unit: str) -> None:
    if not (math.isfinite(value) and value > 0):
        raise InvalidParameter(f"{name} = {value:g} {unit} must be finite and above 0")


def _check_measured(parameters: Parameters) -> None:
    gas = parameters.gas
    if gas.measured is None:
        raise InvalidParameter("a measured pressure was asked for but none is given; set Gas.measured = (z, P_a)")
    position, pressure = gas.measured
    if len(position) != len(pressure) or not position:
        raise InvalidParameter(
            f"measured pressure: {len(position)} positions for {len(pressure)} pressures; they must match"
        )
    if not all(map(math.isfinite, (*position, *pressure))):
        raise InvalidParameter("measured pressure: every position and pressure must be finite")
    if any(after <= before for before, after in itertools.pairwise(position)):
        raise InvalidParameter("measured pressure: the positions must rise strictly")
    if min(pressure) <= -gas.atmospheric_pressure:
        raise InvalidParameter(f"measured pressure: {min(pressure):g} Pa (gauge) lies below vacuum")
