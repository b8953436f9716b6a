"""The pull-off test with the true shape of the membrane instead of the truncated cone.

Everything but the shape is as in EML: the contact line stays at r_i while the energy release rate lies below the work
of adhesion, then peels at equality; the chamber gas follows Boyle's law. The peeling branch is a Chebyshev series in
ln(R_0 / a), a the reference radius of the contact line: features are roots of series, not points of a grid.

Sources: energy EML Eq. 1 with W_1 the neo-Hookean density of Eq. 2 at the true stretches instead of Eqs. 3 and 4, gas
Eq. 6, peeling where the energy is stationary in the contact radius (Eq. 10), force Eq. 11, start Eqs. 12-14.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import NDArray

from model.errors import InvalidParameter, NotConverged
from model.membrane_branch import Counter, Line, pinned_state, release_branch
from model.membrane_contact import Contact, Surface, frozen
from model.membrane_equilibrium import Annulus, Closure, Gas, resample, shape
from model.membrane_equilibrium import solve as solve_states
from model.membrane_path import (
    Coarse,
    Features,
    Memory,
    Panel,
    Piece,
    Place,
    Resolution,
    features,
    neighbour,
    path,
    peel_panels,
    pinned_panels,
)
from model.parameters import ContactStretch, GasAnchor, Parameters
from model.prediction import Jump, Outcome, Prediction
from model.start import check, start_position, start_radius

Array = NDArray[np.float64]

NARROWEST = 1e-7
"""Width of the annulus that stands for r_i = R_0, where the membrane is a strip."""
ORDERS = (12, 18, 27, 40)
COARSE_ORDERS = (10, 20, 36)
"""Orders of the coarse branch: the next where the one before leads nowhere."""
EXTRA_ORDER = 8
"""The error of the shape is the change of the features when the order rises by this."""
HALVINGS = 12
"""How often a panel may be halved: near slack states height and force turn within a narrow range."""
MEASURED_TAIL = 1e-5
MEASURED_HALVINGS = 3
ENDS_HIGHEST = (
    "membrane: the branch ends where it is highest, so that detachment is unknown; a contact that slides ends where "
    "the membrane would push it together, leaving at more than a right angle: choose another contact stretch"
)
ACCEPTABLE = 1e-3
"""Relative error above which a result is refused instead of returned with its error."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A scene in scaled units: z_0 and ln(R_0 / r_i) beside the annulus, and the units in m, N, Pa."""

    annulus: Annulus
    start: float
    width: float
    length: float
    force: float
    pressure: float


class Errors(NamedTuple):
    """Absolute errors of the features, scaled."""

    force: float
    zero: float
    detachment: float
    peak_height: float
    detachment_radius: float


class Found(NamedTuple):
    """The path of one scene with its features, their errors and the larger relative one of F_p and D_p."""

    pieces: list[Piece]
    features: Features
    errors: Errors
    relative: float


def solve(
    parameters: Parameters,
    *,
    points: int = 200,
    contact_stretch: ContactStretch | str = ContactStretch.EML,
    tension_field: bool = False,
    tolerance: float = 1e-8,
    memory: Memory | None = None,
) -> Prediction:
    """Predict one pull-off test with the membrane in exact equilibrium.

    Parameters
    ----------
    parameters
        The scene, SI units.
    points
        Number of points of the returned profile; the features do not depend on it.
    contact_stretch
        How the membrane is stretched in contact; named in the result.
    tension_field
        Whether the hoop direction wrinkles instead of carrying compression.
    tolerance
        Relative error aimed at in F_p and D_p.
    memory
        Keeps what the next call with nearby parameters can start from: pass the same object to every call.

    Raises
    ------
    InvalidParameter
        A parameter lies outside its physical range.
    NotConverged
        The error could not be bounded.
    """
    began = time.perf_counter()
    check(parameters)
    stretch = _stretch(contact_stretch)
    assumptions = {
        "gas anchor": parameters.gas.anchor.value,
        "contact stretch": stretch.value,
        "tension field": "on" if tension_field else "off",
    }
    counter = Counter()
    prediction = Prediction("membrane", Outcome.NO_ADHESION, assumptions)
    if parameters.membrane.work_of_adhesion > 0:
        scaled = anchored_scene(parameters, stretch, counter, tension_field=tension_field)
        if isinstance(scaled, Outcome):
            prediction = replace(prediction, outcome=scaled)
        else:
            prediction = _solve(scaled, prediction, points, tolerance, counter, memory or Memory())
    return replace(prediction, runtime_s=time.perf_counter() - began, evaluations={"membrane states": counter.states})


def _stretch(name: ContactStretch | str) -> ContactStretch:
    try:
        return ContactStretch(name)
    except ValueError as error:
        known = ", ".join(ContactStretch)
        raise InvalidParameter(f"contact_stretch {name!r} is unknown; choose one of {known}") from error


def scene(parameters: Parameters, stretch: ContactStretch, *, tension_field: bool = False) -> Scene:
    """Return the scene in scaled units: lengths by R_0, tensions by E_m h_0 / 3; gas anchored at V_0 or held."""
    gripper, membrane, substrate = parameters.gripper, parameters.membrane, parameters.substrate
    length = gripper.radius
    tension = membrane.youngs_modulus * membrane.thickness / 3
    pressure = tension / length
    curvature = 0.0 if substrate.shape == "flat" else length / substrate.radius
    start = start_position(substrate, gripper) / length
    width = max(-math.log(start_radius(substrate, gripper) / length), NARROWEST)
    annulus = Annulus(
        surface=Surface(curvature),
        gas=_gas(parameters, length, pressure),
        work=membrane.work_of_adhesion / tension,
        contact=_contact(stretch, Surface(curvature), width),
        tension_field=tension_field,
    )
    return Scene(annulus, start, width, length, tension * length, pressure)


def anchored_scene(
    parameters: Parameters, stretch: ContactStretch, counter: Counter, *, tension_field: bool = False
) -> Scene | Outcome:
    """Return the scene in scaled units with its gas anchored, also at the start of retraction; or why it has none."""
    scaled = scene(parameters, stretch, tension_field=tension_field)
    if parameters.gas.anchor is not GasAnchor.START:
        return scaled
    anchored = _anchored_at_start(scaled.annulus, scaled.width, scaled.start, counter)
    return anchored if isinstance(anchored, Outcome) else replace(scaled, annulus=anchored)


def _contact(stretch: ContactStretch, surface: Surface, width: float) -> Contact:
    if stretch is ContactStretch.LOADING:
        from model.membrane_loading import loading_contact

        return loading_contact(surface, width)
    if stretch is ContactStretch.FRICTIONLESS:
        from model.membrane_sliding import Sliding

        return Sliding()
    return frozen(stretch)


def _gas(parameters: Parameters, length: float, unit: float) -> Gas:
    gas = parameters.gas
    free = parameters.gripper.chamber_volume / length**3
    measured = None
    if gas.anchor is GasAnchor.MEASURED and gas.measured is not None:
        heights, pressures = (np.asarray(values, dtype=float) for values in gas.measured)
        measured = heights / length, pressures / unit
    return Gas(
        pressure=gas.initial_pressure / unit,
        atmosphere=gas.atmospheric_pressure / unit,
        volume=free if gas.anchor is GasAnchor.FREE else math.inf,
        free_volume=free,
        measured=measured,
    )


def _anchored_at_start(annulus: Annulus, width: float, start: float, counter: Counter) -> Annulus | Outcome:
    """Return the annulus whose gas has P_0 at the volume of the pinned state at z_0."""
    gas, change = annulus.gas, 0.0
    if annulus.surface.curvature > 0 or gas.pressure != 0:  # else flat and unstressed
        found = pinned_state(annulus, width, start, counter)
        if found.state is None and not found.turned:
            raise NotConverged("membrane: the state at the start of retraction could not be solved to anchor the gas")
        if found.state is None:
            return _no_equilibrium(gas)
        change = float(shape(annulus, np.array([width]), found.state).volume_change[0])
    if gas.free_volume + change <= 0:
        return Outcome.CHAMBER_CLOSED
    return replace(annulus, gas=replace(gas, volume=gas.free_volume + change))


def _solve(
    scaled: Scene, empty: Prediction, points: int, tolerance: float, counter: Counter, memory: Memory
) -> Prediction:
    found = _restarted(scaled, tolerance, counter, memory) or _from_nothing(scaled, tolerance, counter, memory)
    if isinstance(found, Outcome):
        return replace(empty, outcome=found)
    if found.features.peak.pull <= 0:
        return replace(empty, outcome=Outcome.NO_ADHESION)
    return _prediction(scaled, found, empty, points)


def _from_nothing(
    scaled: Scene, tolerance: float, counter: Counter, memory: Memory, orders: Sequence[int] = COARSE_ORDERS
) -> Found | Outcome:
    """Search the branch and refine it; where that leads nowhere, again with shapes of higher order."""
    branch: list[Line] = []
    try:
        branch = release_branch(scaled.annulus, scaled.width, scaled.start, counter, orders[0])
        coarse = Coarse.of(scaled.annulus, branch)
        if not coarse.rises_above(scaled.start):
            return _no_equilibrium(scaled.annulus.gas)
        if _ends_highest(scaled, coarse):
            raise NotConverged(ENDS_HIGHEST)
        return _refined(scaled, coarse, tolerance, counter, memory, orders[0])
    except NotConverged:
        if _folds_back(scaled, branch):
            return Outcome.SELF_CONTACT
        if len(orders) == 1:
            raise
    return _from_nothing(scaled, tolerance, counter, memory, orders[1:])


def _ends_highest(scaled: Scene, coarse: Coarse) -> bool:
    """Whether the branch breaks off at its highest point towards wider contacts: a higher one may be missing."""
    highest = coarse.highest
    return int(np.argmax(coarse.heights[highest])) == 0 and coarse.lines[highest].coordinate[0] != scaled.width


def _folds_back(scaled: Scene, branch: list[Line]) -> bool:
    """Whether the membrane leaves the line at more than half a turn, where it would lie on the substrate again."""
    angles = [shape(scaled.annulus, line.coordinate, line.state).peel_angle for line in branch]
    return any(((angle > math.pi) | (angle < -math.pi / 2)).any() for angle in angles)


def _no_equilibrium(gas: Gas) -> Outcome:
    """Name what peels a contact that holds at no height: suction, or the tension of an inflated membrane."""
    return Outcome.BLOWN_OFF if gas.pressure > 0 else Outcome.NO_EQUILIBRIUM


def _restarted(scaled: Scene, tolerance: float, counter: Counter, memory: Memory) -> Found | None:
    """Return the path of a scene next to the one remembered; ``None`` if it is too far or less precise."""
    panels = neighbour(scaled.annulus, memory, scaled.width, scaled.start, counter)
    if panels is None:
        return None
    try:
        found = _read(scaled, *panels, counter)
    except NotConverged:
        return None
    reachable = 1.5 * memory.relative if memory.tolerance <= tolerance else 0.0
    if not found.relative <= max(tolerance, reachable):
        return None
    memory.peel, memory.pinned = panels
    return found


def _read(scaled: Scene, peel: list[Panel], pinned: list[Panel], counter: Counter) -> Found:
    pieces = path(peel, pinned, scaled.start)
    if not pieces:
        raise NotConverged("membrane: the branch rises above z_0 at a coarse order only")
    read = features(pieces, scaled.start)
    errors = _errors(scaled, read, counter)
    return Found(pieces, read, errors, _relative(read, errors))


def _refined(scaled: Scene, coarse: Coarse, tolerance: float, counter: Counter, memory: Memory, searched: int) -> Found:
    """Raise the order of the shape until the features stand still."""
    found: Found | None = None
    for order in (order for order in ORDERS if order > searched):
        resolution = _resolution(scaled, order, tolerance)
        peel = peel_panels(scaled.annulus, coarse, scaled.start, resolution, counter)
        begins_pinned = peel[0].coordinate[0] == scaled.width
        pinned = []
        if begins_pinned:
            pinned = pinned_panels(scaled.annulus, peel[0], scaled.start, resolution, counter)
        before, found = found, _read(scaled, peel, pinned, counter)
        memory.width, memory.tolerance, memory.relative = scaled.width, tolerance, found.relative
        memory.peel, memory.pinned = peel, pinned
        if found.relative <= tolerance or (before is not None and found.relative > 0.5 * before.relative):
            break
    assert found is not None
    read, errors = found.features, found.errors
    lost = max(errors.force / abs(read.peak.pull or 1.0), errors.detachment / max(read.travel, 1e-300))
    if lost > ACCEPTABLE:
        raise NotConverged(f"membrane: F_p or the detachment is uncertain by {lost:.1e} at the highest order")
    return found


def _resolution(scaled: Scene, order: int, tolerance: float) -> Resolution:
    """Return what a panel must reach; a measured pressure has a kink at every sample, which no series resolves."""
    if scaled.annulus.gas.measured is not None:
        return Resolution(order, max(0.1 * tolerance, MEASURED_TAIL), MEASURED_HALVINGS)
    return Resolution(order, 0.1 * tolerance, HALVINGS)


def _errors(scaled: Scene, read: Features, counter: Counter) -> Errors:
    """Estimate errors from the change with the order and from the last terms of the series."""
    annulus = scaled.annulus
    _, force = _change(annulus, read.peak, counter)
    detachment, _ = _change(annulus, read.detachment, counter)
    force += read.peak.piece.panel.tail * abs(read.peak.pull)
    detachment += read.detachment.piece.panel.tail * abs(read.detachment.height - read.start.height)
    return Errors(
        force,
        _zero_error(scaled, read, counter),
        detachment,
        peak_height=_drift(read.peak, read.peak.piece.panel.pull, read.peak.piece.panel.height),
        detachment_radius=_drift(
            read.detachment, read.detachment.piece.panel.height, read.detachment.piece.panel.radius
        ),
    )


def _drift(place: Place, extreme: Chebyshev, read: Chebyshev) -> float:
    """Return how far a quantity read at an extreme moves with the place of the extreme, as uncertain as its series."""
    low, high = extreme.domain
    noise = place.piece.panel.tail * float(np.abs(extreme.coef).max())
    curvature = abs(float(extreme.deriv(2)(place.coordinate)))
    shift = 2 * noise * len(extreme.coef) ** 2 / (high - low) / curvature if curvature else math.inf
    return float(min(shift, high - low)) * abs(float(read.deriv()(place.coordinate)))


def _zero_error(scaled: Scene, read: Features, counter: Counter) -> float:
    """Return the error of the height at which the force vanishes: its own over the slope of the force."""
    drawn_up = scaled.annulus.surface.curvature == 0 and scaled.annulus.gas.pressure <= 0
    if read.zero is None:
        return 0.0 if drawn_up else read.gap  # on a flat, suction pulls from z = 0 on
    panel = read.zero.piece.panel
    slope = float(panel.pull.deriv()(read.zero.coordinate))
    lift = float(panel.height.deriv()(read.zero.coordinate))
    height, pull = _change(scaled.annulus, read.zero, counter)
    pull += panel.tail * abs(read.peak.pull)
    own = height + (pull * abs(lift / slope) if slope else 0.0)
    piece = read.zero.piece
    rise = float(panel.height(piece.end) - panel.height(piece.begin))
    return read.gap + min(own, rise)  # the zero lies on its piece, however slack the membrane is there


def _change(annulus: Annulus, place: Place, counter: Counter) -> tuple[float, float]:
    """Return how much height and pull change at a place when the order rises."""
    panel = place.piece.panel
    width, target = np.array([place.width]), np.array([place.height])
    closure = Closure.HEIGHT if panel.pinned else Closure.RELEASE
    guess = panel.guess(np.array([place.coordinate]))
    order = guess.shape[1] // 2 - 2 + EXTRA_ORDER
    solved = counter.note(solve_states(annulus, width, resample(guess, order), closure=closure, target=target))
    if not solved.converged[0]:
        return math.inf, math.inf
    height = float(shape(annulus, width, solved.state).height[0])
    return abs(height - place.height), abs(float(solved.state[0, -1]) - place.pull)


def _relative(read: Features, errors: Errors) -> float:
    distance = read.detachment.height - (read.start if read.zero is None else read.zero).height
    travel = max(abs(distance), 1e-3 * read.travel, 1e-300)
    return max(errors.force / max(abs(read.peak.pull), 1e-300), (errors.zero + errors.detachment) / travel)


def _prediction(scaled: Scene, found: Found, empty: Prediction, points: int) -> Prediction:
    read, errors, pieces = found.features, found.errors, found.pieces
    length, newton = scaled.length, 2 * math.pi * scaled.force
    zero = scaled.start * length if read.zero is None else read.zero.height * length
    detachment = read.detachment.height * length
    profile = _profile(scaled, pieces, points)
    return replace(
        empty,
        outcome=Outcome.PULL_OFF,
        pull_off_force=newton * read.peak.pull,
        pull_off_distance=detachment - zero,
        retraction_at_pull_off=read.peak.height * length - zero,
        zero_force_position=zero,
        onset_position=read.onset.height * length,
        detachment_position=detachment,
        detachment_radius=length * read.detachment.radius,
        adhesion_energy=newton * length * read.energy,
        position=profile["position"],
        retraction=profile["position"] - zero,
        force=profile["force"],
        pressure=profile["pressure"],
        contact_radius=profile["radius"],
        stable=np.ones(profile["position"].size, dtype=bool),
        jumps=_jumps(scaled, pieces),
        numerical_error={
            "pull_off_force": newton * errors.force,
            "pull_off_distance": length * (errors.zero + errors.detachment),
            "zero_force_position": length * errors.zero,
            "retraction_at_pull_off": length * (errors.zero + errors.peak_height),
            "detachment_position": length * errors.detachment,
            "detachment_radius": length * errors.detachment_radius,
            "adhesion_energy": newton * length * (errors.force * read.travel + abs(read.peak.pull) * errors.detachment),
        },
        warnings=tuple(_warnings(scaled, pieces) + _doubts(read, errors)),
    )


def _doubts(read: Features, errors: Errors) -> list[str]:
    if errors.zero <= ACCEPTABLE * read.travel:
        return []
    return ["the membrane is slack where the force vanishes: D_p is uncertain as numerical_error says"]


def _jumps(scaled: Scene, pieces: list[Piece]) -> tuple[Jump, ...]:
    newton = -2 * math.pi * scaled.force
    jumps = []
    for before, after in pairwise(pieces):
        left, right = Place(before, before.end), Place(after, after.begin)
        if not _leaps(left, right):
            continue
        jumps.append(
            Jump(
                position=right.height * scaled.length,
                radius_before=scaled.length * left.radius,
                radius_after=scaled.length * right.radius,
                force_before=newton * left.pull,
                force_after=newton * right.pull,
            )
        )
    return tuple(jumps)


def _leaps(left: Place, right: Place) -> bool:
    """Whether the contact line jumps between the end of a piece and the beginning of the next."""
    return abs(left.width - right.width) > 1e-9


def _profile(scaled: Scene, pieces: list[Piece], points: int) -> Mapping[str, Array]:
    """Sample the path, points shared among its pieces by the height they rise."""
    columns: dict[str, list[Array]] = {"position": [], "force": [], "pressure": [], "radius": []}
    last: Place | None = None
    for piece, count in zip(pieces, _shares(pieces, points), strict=True):
        panel = piece.panel
        joined = last is not None and not _leaps(last, Place(piece, piece.begin))  # its first point is there already
        at = np.linspace(piece.begin, piece.end, count + joined)[int(joined) :]
        last = Place(piece, piece.end)
        columns["position"].append(panel.height(at) * scaled.length)
        columns["force"].append(-2 * math.pi * scaled.force * panel.pull(at))
        columns["pressure"].append(scaled.pressure * panel.pressure(at))
        columns["radius"].append(scaled.length * panel.radius(at))
    return {name: np.concatenate(parts) for name, parts in columns.items()}


def _shares(pieces: list[Piece], points: int) -> list[int]:
    rises = np.array([float(p.panel.height(p.end) - p.panel.height(p.begin)) for p in pieces])
    spare = max(points - 2 * len(pieces), 0)
    shares = 2 + np.floor(spare * rises / max(rises.sum(), 1e-300)).astype(int)
    shares[int(np.argmax(rises))] += max(points - int(shares.sum()), 0)
    return [int(share) for share in shares]


def _warnings(scaled: Scene, pieces: list[Piece]) -> list[str]:
    """Name what the model leaves out where the solved shapes meet it."""
    found: dict[str, None] = {}
    for piece in pieces:
        panel = piece.panel
        inside = (panel.coordinate >= piece.begin) & (panel.coordinate <= piece.end)
        if not inside.any():
            continue
        s = shape(scaled.annulus, panel.width[inside], panel.state[inside])
        if not scaled.annulus.tension_field and (s.hoop_tension < -1e-9).any():
            found["hoop tension turns negative: the membrane wrinkles; see tension_field"] = None
        reachable = s.r * scaled.annulus.surface.curvature < 1
        ground = scaled.annulus.surface.height(np.where(reachable, s.r, 0.0))
        if (reachable & (s.z < ground - 1e-9)).any():
            found["the free membrane touches the substrate outside the contact"] = None
        if ((s.r > 1 + 1e-9) & (s.z > s.height[:, None])).any():
            found["the membrane bulges over the rim"] = None
    return list(found)
