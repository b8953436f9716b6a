"""How the load is shared along the interface: linear finite elements of the film above its contact (SI section S1).

The film is a rectangle 0 <= x <= R_0, 0 <= y <= h_0; it sticks where x <= contact radius, its rim is lifted by u_0, the
gas presses on its top. The problem is linear in (u_0, P): two solutions serve every displacement and pressure.

Fig. 3a of the PNAS paper, which holds the dimensions and boundary conditions, was not at hand: the geometry here is an
assumption. Inside the solver lengths are in units of h_0 and stresses of E_m.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidParameter

if TYPE_CHECKING:
    from model.parameters import Parameters

Array = NDArray[np.float64]

FIBRE_PITCH = 100e-6
"""Centre distance of the fibres: 69 um tips and 31 um gaps (SI Fig. S2), m."""
FIBRE_HEIGHT = 42e-6
"""SI Fig. S2, m."""
AREA_FRACTION = np.pi * (69e-6 / 2) ** 2 / FIBRE_PITCH**2
"""Tips of 69 um on a square lattice of 100 um; the lattice is an assumption."""


class Formulation(StrEnum):
    """Which equations are solved."""

    PUBLISHED = "published"
    """SI Eq. S1 as printed: plane-stress moduli, half the shear modulus; the sign of the top traction as meant."""
    PLANE_STRAIN = "plane-strain"
    """Incompressible plane strain, displacement and pressure (Taylor-Hood)."""
    AXISYMMETRIC = "axisymmetric"
    """Incompressible, with the hoop strain of the round film (Taylor-Hood)."""


@dataclass(frozen=True, slots=True)
class Film:
    """Geometry and material, SI: R_0, contact radius, h_0, E_m; ``poissons_ratio`` 1/2 is incompressible."""

    radius: float = 8e-3
    contact_radius: float = 7.3e-3
    thickness: float = 200e-6
    youngs_modulus: float = 2.0e6
    poissons_ratio: float = 0.5

    @classmethod
    def of(cls, parameters: Parameters) -> Film:
        """Return the film of a flat scene: full contact up to r_e."""
        gripper, membrane = parameters.gripper, parameters.membrane
        return cls(gripper.radius, gripper.effective_radius, membrane.thickness, membrane.youngs_modulus)


@dataclass(frozen=True, slots=True)
class Fibres:
    """The fibre layer as a Winkler foundation: independent springs, E phi / h_f along the fibre, a third across."""

    normal_stiffness: float
    """Pa/m."""

    @classmethod
    def of(cls, youngs_modulus: float, height: float = FIBRE_HEIGHT, area_fraction: float = AREA_FRACTION) -> Fibres:
        """Return the layer of fibres of the film's material."""
        return cls(youngs_modulus * area_fraction / height)


@dataclass(frozen=True, slots=True)
class Discretisation:
    """Mesh and elements.

    Attributes
    ----------
    smallest
        Element size at the contact edge, m; elements are halved towards it.
    largest
        Element size near the edge before halving, in units of h_0.
    element
        ``"mixed"`` (P2/P1 displacement and pressure), ``"P1"`` or ``"P2"`` (displacement only).
    graded
        Without, the mesh is uniform of size ``largest``.
    """

    smallest: float = 0.2e-6
    largest: float = 0.125
    element: str = "mixed"
    graded: bool = True

    def coarser(self) -> Discretisation:
        """Return the mesh that the error is estimated against: twice coarser throughout, four times at the edge."""
        return replace(self, smallest=4 * self.smallest, largest=2 * self.largest)


class Load(NamedTuple):
    """Lift of the rim, m, and gauge pressure in the chamber, Pa."""

    lift: float
    pressure: float


@dataclass(frozen=True)
class LoadSharing:
    """Solution for unit lift and unit pressure; every method superposes them.

    Forces are N for the axisymmetric film and N per metre of depth for the plane ones; tension is positive.

    Attributes
    ----------
    position
        (n,), interface nodes from the axis to the contact edge, m.
    traction_by_lift, traction_by_pressure
        (n,), vertical stress sigma_22 there by lift (Pa/m) and by pressure (1). Without a fibre layer the values next
        to the edge grow without bound with the mesh: use the measures below.
    edge_error
        Relative change of the edge force on a mesh four times coarser at the edge, divided by three (first order).
    """

    formulation: Formulation
    film: Film
    fibres: Fibres | None
    position: Array
    traction_by_lift: Array
    traction_by_pressure: Array
    nodal_force: Array
    release: Array
    stress: StressMap = field(repr=False)
    edge_error: float
    runtime_s: float
    unknowns: int
    assumptions: Mapping[str, str]

    def traction(self, load: Load) -> Array:
        """Return sigma_22 at ``position``, Pa, tension positive."""
        return load.lift * self.traction_by_lift + load.pressure * self.traction_by_pressure

    def edge_force(self, load: Load) -> float:
        """Return the pull of the film on the substrate, N or N/m."""
        return float((np.asarray(load) @ self.nodal_force).sum())

    def area(self) -> float:
        """Return the contact area, m^2, or the contact width, m, of the plane film."""
        radius = self.film.contact_radius
        return float(np.pi * radius**2) if self.formulation is Formulation.AXISYMMETRIC else radius

    def mean_stress(self, load: Load) -> float:
        """Return pull over contact area, Pa."""
        return self.edge_force(load) / self.area()

    def edge_stress(self, load: Load, width: float = FIBRE_PITCH) -> float:
        """Return the mean of sigma_22 over the outermost ``width`` of the contact, Pa: what the last fibres carry.

        Summed from nodal forces; the node on the boundary counts half.
        """
        inner = self.film.contact_radius - width
        share = np.clip((self.position - inner) / (1e-9 * width) + 0.5, 0, 1)
        radius = self.film.contact_radius
        area = radius**2 - inner**2 if self.formulation is Formulation.AXISYMMETRIC else width
        area *= np.pi if self.formulation is Formulation.AXISYMMETRIC else 1
        return float((np.asarray(load) @ self.nodal_force) @ share) / area

    def peak_stress(self, load: Load) -> float:
        """Return the largest sigma_22, Pa; only the fibre layer makes it a number of physics and not of the mesh.

        Raises
        ------
        InvalidParameter
            Without a fibre layer.
        """
        if self.fibres is None:
            raise InvalidParameter(
                "the peak of a sticking film grows without bound as the mesh is refined; "
                "ask for edge_stress, or solve with a fibre layer"
            )
        return float(self.traction(load).max())

    def sharing(self, load: Load) -> float:
        """Return mean over peak stress: the predicted adhesion efficiency."""
        return self.mean_stress(load) / self.peak_stress(load)

    def release_rate(self, load: Load) -> float:
        """Return the energy release rate when the contact edge recedes, J/m^2."""
        return float(np.asarray(load) @ self.release @ np.asarray(load))

    def lift_at_peeling(self, work_of_adhesion: float, pressure: float) -> float:
        """Return the lift at which the release rate equals the work of adhesion, m; nan where none does."""
        quadratic, cross, rest = self.release[0, 0], self.release[0, 1], self.release[1, 1]
        discriminant = (cross * pressure) ** 2 - quadratic * (rest * pressure**2 - work_of_adhesion)
        if discriminant < 0:
            return float("nan")
        return float((-cross * pressure + np.sqrt(discriminant)) / quadratic)


@dataclass(frozen=True)
class StressMap:
    """sigma_22 at the corners of the mesh by unit lift and pressure: coordinates (2, n) in m, triangles (3, m)."""

    points: Array
    triangles: NDArray[np.int64]
    by_lift: Array
    by_pressure: Array


def solve(
    film: Film,
    formulation: Formulation | str = Formulation.AXISYMMETRIC,
    *,
    fibres: Fibres | None = None,
    discretisation: Discretisation | None = None,
    estimate_error: bool = True,
) -> LoadSharing:
    """Solve the film for unit lift and unit pressure.

    Raises
    ------
    InvalidParameter
        Impossible geometry, or an incompressible film without the mixed element.
    """
    began = time.perf_counter()
    kind = Formulation(formulation)
    mesh = discretisation or Discretisation(element="P2" if kind is Formulation.PUBLISHED else "mixed")
    _check(film, kind, mesh)
    fine = _Problem(film, kind, fibres, mesh)
    force = fine.interface_forces()
    error = float("nan")
    if estimate_error:
        other = _Problem(film, kind, fibres, mesh.coarser()).interface_forces()[0].sum()
        error = abs(float(other / force[0].sum()) - 1) / 3
    position, tractions = fine.tractions(force)
    return LoadSharing(
        formulation=kind,
        film=film,
        fibres=fibres,
        position=position,
        traction_by_lift=tractions[0],
        traction_by_pressure=tractions[1],
        nodal_force=force,
        release=fine.release(),
        stress=fine.stress_map(),
        edge_error=error,
        runtime_s=time.perf_counter() - began,
        unknowns=fine.unknowns,
        assumptions={
            "geometry": "rectangle R_0 x h_0, stuck up to the contact radius, lifted at the rim",
            "interface": "stick" if fibres is None else f"fibre layer, {fibres.normal_stiffness:.3g} Pa/m",
            "elasticity": kind.value,
        },
    )


def _check(film: Film, kind: Formulation, mesh: Discretisation) -> None:
    if not 0 < film.contact_radius < film.radius:
        raise InvalidParameter(
            f"contact radius {film.contact_radius:g} m must lie between 0 and R_0 = {film.radius:g} m: "
            "the film needs a free rim"
        )
    if mesh.element not in ("mixed", "P1", "P2"):
        raise InvalidParameter(f"element {mesh.element!r}: choose mixed, P1 or P2")
    if kind is Formulation.PUBLISHED and mesh.element == "mixed":
        raise InvalidParameter("the published equations hold no pressure; choose the element P1 or P2")
    if film.poissons_ratio >= 0.5 and kind is not Formulation.PUBLISHED and mesh.element != "mixed":
        raise InvalidParameter("an incompressible film needs the mixed element")


class _Problem:
    """One assembled and solved mesh, in units of h_0 and E_m."""

    def __init__(self, film: Film, kind: Formulation, fibres: Fibres | None, mesh: Discretisation) -> None:
        from skfem import Basis, ElementTriP1, ElementTriP2, ElementVector, FacetBasis

        self.film, self.kind, self.fibres, self.resolution = film, kind, fibres, mesh
        self.mixed = mesh.element == "mixed"
        scalar = ElementTriP1() if mesh.element == "P1" else ElementTriP2()
        self.mesh = _graded_mesh(film, mesh)
        self.elements = ElementVector(scalar), ElementTriP1(), scalar
        self.u = Basis(self.mesh, self.elements[0], intorder=4)
        self.q = self.u.with_element(self.elements[1])
        self.facets = FacetBasis
        self.matrix, self.loads = self._assemble(self.mesh)
        self._solve()

    @property
    def unknowns(self) -> int:
        """Number of equations."""
        return int(self.matrix.shape[0])

    def _assemble(self, mesh: Any) -> tuple[Any, Array]:
        """Return the symmetric matrix and the load vectors of unit lift (none) and unit pressure."""
        from scipy.sparse import bmat
        from skfem import Basis, FacetBasis

        basis = Basis(mesh, self.elements[0], intorder=4)
        forms = _forms(self.kind, self.film.poissons_ratio, mixed=self.mixed)
        stiffness = forms.stiffness.assemble(basis)
        if self.fibres is not None:
            contact = FacetBasis(mesh, self.elements[0], facets=mesh.boundaries["contact"], intorder=4)
            spring = self.fibres.normal_stiffness * self.film.thickness / self.film.youngs_modulus
            stiffness = stiffness + spring * forms.foundation.assemble(contact)
        top = FacetBasis(mesh, self.elements[0], facets=mesh.boundaries["top"], intorder=4)
        push = forms.pressure.assemble(top)
        if not self.mixed:
            return stiffness.tocsc(), np.stack([np.zeros_like(push), push])
        pressure = basis.with_element(self.elements[1])
        divergence = forms.divergence.assemble(basis, pressure)
        volume = forms.compressibility.assemble(pressure)
        matrix = bmat([[stiffness, divergence.T], [divergence, volume]], format="csc")
        push = np.concatenate([push, np.zeros(pressure.N)])
        return matrix, np.stack([np.zeros_like(push), push])

    def _solve(self) -> None:
        from scipy.sparse.linalg import splu

        u = self.u
        axis = u.get_dofs("axis").all("u^1")
        rim = u.get_dofs("rim").all("u^1")
        lifted = u.get_dofs("rim").all("u^2")
        held = [axis, rim, lifted]
        if self.fibres is None:
            held.append(u.get_dofs("contact").all(["u^1", "u^2"]))
        fixed = np.unique(np.concatenate(held))
        free = np.setdiff1d(np.arange(self.unknowns), fixed)
        solution = np.zeros((2, self.unknowns))
        solution[0, lifted] = 1.0
        right = self.loads - solution @ self.matrix.T
        inner = self.matrix[free][:, free]
        scale = 1 / np.sqrt(np.maximum(abs(inner).max(axis=1).toarray().ravel(), 1e-300))
        balanced = inner.multiply(scale[:, None]).multiply(scale).tocsc()
        factor = splu(balanced, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True})
        solution[:, free] = factor.solve((right[:, free] * scale).T).T * scale
        self.solution = solution

    def interface_forces(self) -> Array:
        """Return vertical nodal forces on the substrate (2, n) by lift and pressure, ordered by position, SI."""
        order, dofs = self._interface()
        if self.fibres is None:
            residual = self.loads - self.solution @ self.matrix.T
            forces = residual[:, dofs]
        else:
            forces = self.solution[:, dofs] @ self._interface_mass(order, dofs) * self._spring()
        return np.asarray(forces[:, order] * self._force_units()[:, None])

    def _interface(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        dofs = self.u.get_dofs("contact").all("u^2")
        return np.argsort(self.u.doflocs[0, dofs]), dofs

    def _spring(self) -> float:
        assert self.fibres is not None
        return self.fibres.normal_stiffness * self.film.thickness / self.film.youngs_modulus

    def _interface_mass(self, order: NDArray[np.int64], dofs: NDArray[np.int64]) -> Any:
        from skfem import BilinearForm

        axisymmetric = self.kind is Formulation.AXISYMMETRIC
        contact = self.facets(self.mesh, self.elements[0], facets=self.mesh.boundaries["contact"], intorder=4)
        mass = BilinearForm(lambda u, v, w: u[1] * v[1] * (2 * np.pi * w.x[0] if axisymmetric else 1.0))
        return mass.assemble(contact).tocsr()[dofs][:, dofs]

    def tractions(self, force: Array) -> tuple[Array, Array]:
        """Return positions (n,) and sigma_22 (2, n) from nodal forces, projected with the mass of the interface."""
        from scipy.sparse.linalg import spsolve

        order, dofs = self._interface()
        mass = self._interface_mass(order, dofs)[order][:, order].tocsc()
        area = self.film.thickness ** (2 if self.kind is Formulation.AXISYMMETRIC else 1)
        position = self.u.doflocs[0, dofs][order] * self.film.thickness
        return position, spsolve(mass, force.T).T / area

    def _force_units(self) -> Array:
        """Return N (or N/m) per unit lift in m and per unit pressure in Pa."""
        size = self.film.thickness ** (2 if self.kind is Formulation.AXISYMMETRIC else 1)
        return np.array([self.film.youngs_modulus * size / self.film.thickness, size])

    def release(self) -> Array:
        """Return the quadratic form of the energy release rate in (lift, pressure), SI.

        The energy is stationary in the solution, so that its derivative by the place of the contact edge needs only
        the matrices of a mesh whose edge is moved, not another solution.
        """
        edge = self.film.contact_radius / self.film.thickness
        step = 1e-4 * self.resolution.smallest / self.film.thickness
        ahead, behind = (self._energy(self._moved(edge, sign * step)) for sign in (1, -1))
        rate = (ahead - behind) / (2 * step)
        rate = 0.5 * (rate + rate.T)
        perimeter = 2 * np.pi * edge if self.kind is Formulation.AXISYMMETRIC else 1.0
        units = np.array([self.film.youngs_modulus / self.film.thickness, 1.0])
        return np.asarray(rate / perimeter * np.outer(units, units) * self.film.thickness / self.film.youngs_modulus)

    def _moved(self, edge: float, step: float) -> Any:
        points = self.mesh.p.copy()
        x, end = points[0], self.film.radius / self.film.thickness
        reach = min(edge, end - edge)
        points[0] = x + step * np.clip(1 - np.abs(x - edge) / reach, 0, 1)
        return type(self.mesh)(points, self.mesh.t, _boundaries=self.mesh.boundaries)

    def _energy(self, mesh: Any) -> Array:
        """Return the quadratic form of the potential energy (2, 2) of the solutions on a mesh of the same topology."""
        matrix, loads = self._assemble(mesh)
        work = self.solution @ loads.T
        return np.asarray(0.5 * self.solution @ (matrix @ self.solution.T) - 0.5 * (work + work.T))

    def stress_map(self) -> StressMap:
        """Return sigma_22 projected to the corners."""
        from skfem import BilinearForm, LinearForm

        mass = BilinearForm(lambda p, q, w: p * q).assemble(self.q)
        load = LinearForm(lambda q, w: w["stress"] * q)
        fields = [self._vertical_stress(solution) for solution in self.solution]
        lumped = np.asarray(mass.sum(axis=1)).ravel()
        corners = [load.assemble(self.q, stress=stress) / lumped for stress in fields]
        thickness, modulus = self.film.thickness, self.film.youngs_modulus
        return StressMap(
            self.mesh.p * thickness, self.mesh.t.astype(np.int64), corners[0] * modulus / thickness, corners[1]
        )

    def _vertical_stress(self, solution: Array) -> Array:
        gradient = self.u.interpolate(solution[: self.u.N]).grad
        nu = self.film.poissons_ratio
        if self.kind is Formulation.PUBLISHED:
            return np.asarray((gradient[1][1] + nu * gradient[0][0]) / (1 - nu**2))
        shear = 0.5 / (1 + nu)
        if self.mixed:
            pressure = np.asarray(self.q.interpolate(solution[self.u.N :]))
            return np.asarray(2 * shear * gradient[1][1] - pressure)
        bulk = nu / ((1 + nu) * (1 - 2 * nu))
        return np.asarray(2 * shear * gradient[1][1] + bulk * (gradient[0][0] + gradient[1][1]))


class _Forms(NamedTuple):
    stiffness: Any
    divergence: Any
    compressibility: Any
    pressure: Any
    foundation: Any


def _forms(kind: Formulation, nu: float, *, mixed: bool) -> _Forms:
    from skfem import BilinearForm, LinearForm

    axisymmetric = kind is Formulation.AXISYMMETRIC
    shear = 0.5 / (1 + nu)
    lame = 0.0 if mixed else nu / ((1 + nu) * (1 - 2 * nu)) if nu < 0.5 else np.inf

    def weight(w: Any) -> Any:
        return 2 * np.pi * w.x[0] if axisymmetric else 1.0

    def hoop(u: Any, w: Any) -> Any:
        return u[0] / w.x[0] if axisymmetric else 0.0

    def divergence(u: Any, w: Any) -> Any:
        return u.grad[0][0] + u.grad[1][1] + hoop(u, w)

    def printed(u: Any, v: Any, w: Any) -> Any:
        du, dv = u.grad, v.grad
        plane = 1 / (1 - nu**2)
        first = plane * (du[0][0] + nu * du[1][1])
        second = plane * (nu * du[0][0] + du[1][1])
        sheared = 0.25 / (1 + nu) * (du[0][1] + du[1][0])
        return first * dv[0][0] + second * dv[1][1] + sheared * (dv[0][1] + dv[1][0])

    def correct(u: Any, v: Any, w: Any) -> Any:
        du, dv = u.grad, v.grad
        direct = du[0][0] * dv[0][0] + du[1][1] * dv[1][1] + hoop(u, w) * hoop(v, w)
        sheared = 0.5 * (du[0][1] + du[1][0]) * (dv[0][1] + dv[1][0])
        volume = 0.0 if mixed else lame * divergence(u, w) * divergence(v, w)
        return (2 * shear * (direct + sheared) + volume) * weight(w)

    inverse_lame = (1 + nu) * (1 - 2 * nu) / nu if nu > 0 else np.inf
    return _Forms(
        stiffness=BilinearForm(printed if kind is Formulation.PUBLISHED else correct),
        divergence=BilinearForm(lambda u, q, w: -q * divergence(u, w) * weight(w)),
        compressibility=BilinearForm(lambda p, q, w: -inverse_lame * p * q * weight(w)),
        pressure=LinearForm(lambda v, w: -v[1] * weight(w)),
        foundation=BilinearForm(lambda u, v, w: (u[1] * v[1] + u[0] * v[0] / 3) * weight(w)),
    )


def _graded_mesh(film: Film, resolution: Discretisation) -> Any:
    """Return a triangle mesh of the film in units of h_0, halved again and again towards its singular corners."""
    from skfem import MeshTri

    radius, edge = film.radius / film.thickness, film.contact_radius / film.thickness
    pitch = min(FIBRE_PITCH / film.thickness, edge / 2)
    size, smallest = resolution.largest, resolution.smallest / film.thickness
    inner = edge - pitch - _growing(edge - pitch, size, 1.5 if resolution.graded else 1.0)
    x = np.concatenate([inner[::-1], _even(edge - pitch, edge, size), _even(edge, radius, size)])
    x[0], x[-1] = 0.0, radius
    mesh = MeshTri.init_tensor(x, _even(0.0, 1.0, size, first=True))
    if resolution.graded:
        levels = max(int(np.ceil(np.log2(size / smallest))), 0)
        mesh = _refined(mesh, np.array([edge, 0.0]), size, levels)
        for height in (0.0, 1.0):
            mesh = _refined(mesh, np.array([radius, height]), size, levels * 2 // 3)
    return mesh.with_boundaries(
        {
            "axis": lambda p: p[0] < 1e-9 * radius,
            "rim": lambda p: p[0] > radius * (1 - 1e-9),
            "top": lambda p: p[1] > 1 - 1e-12,
            "contact": lambda p: (p[1] < 1e-12) & (p[0] < edge),
        }
    )


def _refined(mesh: Any, corner: Array, size: float, levels: int) -> Any:
    """Halve the elements around a corner ``levels`` times, each time within half the distance."""
    for level in range(levels):
        centres = mesh.p[:, mesh.t].mean(axis=1)
        near = np.hypot(*(centres - corner[:, None])) < 1.6 * size / 2**level
        mesh = mesh.refined(np.flatnonzero(near))
    return mesh


def _even(begin: float, end: float, size: float, *, first: bool = False) -> Array:
    """Return evenly spaced positions no further apart than ``size``, without the first unless asked for."""
    places = np.linspace(begin, end, max(int(np.ceil((end - begin) / size - 1e-9)), 1) + 1)
    return places if first else places[1:]


def _growing(length: float, size: float, growth: float) -> Array:
    """Return positions from 0 to ``length``, their distances growing from ``size`` up to 4 ``size``."""
    sizes = [size]
    while sum(sizes) < length:
        sizes.append(min(sizes[-1] * growth, max(4 * size, size) if growth > 1 else size))
    steps = np.array(sizes)
    return np.concatenate([[0.0], np.cumsum(steps) * (length / steps.sum())])
