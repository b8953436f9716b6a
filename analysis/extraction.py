"""The registry of extraction steps and the state they share.

A step is one function: it reads what earlier steps found, decides something, stores the numbers it ``gives`` and
returns the ``details`` that show *why* it decided so; the overview picture and the report draw them. Adding a feature
is adding one function:

    @extraction_step("pull-off", title="Pull-off force", after=("tare",), gives={"pull_off_force_N": "largest tension"})
    def pull_off(work: Extraction) -> Details: ...
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from analysis.creep import Creep
from analysis.errors import FeatureMissing
from analysis.numerics import Array, ForceJump, Noise, block_means
from analysis.run import Run

MODULES = ("preparation", "loading", "retraction", "indentation", "chamber")
"""Modules of ``analysis`` that register steps, in the order in which these are reported."""

SMOOTHING = 0.02
"""Width of the running mean used to find places (never values), s."""

Details = Mapping[str, object]
"""Decision in words under ``"decision"``; arrays, indices and thresholds for the plot under other keys."""


@dataclass(frozen=True, slots=True)
class Windows:
    """Sample ranges of one run, (start, stop), stop exclusive; ``None`` where the run has no such part."""

    free: tuple[int, int]
    approach: tuple[int, int] | None
    dwell: tuple[int, int] | None
    pressurize: tuple[int, int] | None
    retraction: tuple[int, int] | None
    end: int


@dataclass
class Extraction:
    """One pass over one run. Steps set the attributes; those that follow read them.

    Sample indices (``zero``, ``release``, ``peak``) and separations are ``nan`` until they are found.
    ``earlier`` is the pass over the run of which this is a changed copy: its creep stays, its fits are where others
    begin.
    """

    run: Run
    creep: Creep | None = None
    earlier: Extraction | None = None
    values: dict[str, float] = field(default_factory=dict)
    details: dict[str, Details] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    methods: dict[str, dict[str, float]] = field(default_factory=dict)
    stated: dict[str, float] = field(default_factory=dict)
    windows: Windows = field(init=False)
    noise: Noise = field(init=False)
    baseline: np.polynomial.Polynomial = field(init=False)
    detached: int | None = field(init=False, default=None)
    force: Array = field(init=False)
    separation: Array = field(init=False)
    contact_start: int = field(init=False)
    jumps: list[ForceJump] = field(init=False, default_factory=list)
    zero: float = field(init=False, default=math.nan)
    zero_separation: float = field(init=False, default=math.nan)
    release: float = field(init=False, default=math.nan)
    release_separation: float = field(init=False, default=math.nan)
    release_uncertainty: float = field(init=False, default=0.0)
    peak: float = field(init=False, default=math.nan)
    peak_shift: float = field(init=False, default=math.nan)

    def set(self, **values: float) -> None:
        """Store features by their registered names."""
        self.values.update(values)

    def samples(self, seconds: float, least: int = 3) -> int:
        """Return how many samples a time holds, ``least`` at the least."""
        return max(least, round(seconds * self.run.rate))

    def retraction(self) -> tuple[int, int]:
        """Return start and stop of the retraction, or raise ``FeatureMissing``."""
        if self.windows.retraction is None:
            raise FeatureMissing("the run has no retraction")
        return self.windows.retraction

    def at(self, signal: Array, index: float) -> float:
        """Return a signal between two samples."""
        return float(np.interp(index, np.arange(signal.size), signal)) if index % 1 else float(signal[int(index)])

    def thinned(self, run: Run, length: int) -> Extraction:
        """Return the state for a run averaged over ``length`` samples: signals, places, decisions."""
        windows = self.windows
        light = Extraction(run, values=dict(self.values), missing=dict(self.missing), failed=dict(self.failed))
        light.methods = self.methods
        light.windows = Windows(
            free=(windows.free[0] // length, windows.free[1] // length),
            approach=_thin(windows.approach, length),
            dwell=_thin(windows.dwell, length),
            pressurize=_thin(windows.pressurize, length),
            retraction=_thin(windows.retraction, length),
            end=windows.end // length,
        )
        light.details = {
            name: {
                key: value / length if key == "index" and isinstance(value, int | float) else value
                for key, value in details.items()
                if key in ("decision", "index", "methods")
            }
            for name, details in self.details.items()
        }
        light.force, light.separation = block_means(self.force, length), block_means(self.separation, length)
        light.noise, light.baseline = replace(self.noise, residual=np.empty(0)), self.baseline
        light.contact_start = self.contact_start // length
        light.zero, light.release, light.peak = self.zero / length, self.release / length, self.peak / length
        light.zero_separation, light.release_separation = self.zero_separation, self.release_separation
        return light


def _thin(window: tuple[int, int] | None, length: int) -> tuple[int, int] | None:
    return None if window is None else (window[0] // length, window[1] // length)


@dataclass(frozen=True)
class ExtractionStep:
    """One registered step."""

    name: str
    title: str
    gives: Mapping[str, str]
    after: tuple[str, ...]
    uses: tuple[str, ...]
    protocols: tuple[str, ...]
    function: Callable[[Extraction], Details]

    @property
    def explanation(self) -> str:
        """How the step decides: the function's docstring."""
        return (self.function.__doc__ or "").strip()


CONTACT_TESTS = ("pull_off", "indentation", "fiber", "punch")
"""Protocols that touch a sample and pull it off."""

STEPS: dict[str, ExtractionStep] = {}
"""Registered steps by name, in no particular order; ``ordered`` puts them in the order they run."""


def extraction_step(
    name: str,
    *,
    title: str,
    gives: Mapping[str, str] | None = None,
    after: Iterable[str] = (),
    uses: Iterable[str] = (),
    protocols: Iterable[str] = (),
) -> Callable[[Callable[[Extraction], Details]], Callable[[Extraction], Details]]:
    """Register a step.

    Parameters
    ----------
    name, title
        Short and readable name.
    gives
        Features the step finds, with what they are. The unit is the end of the name.
    after
        Steps that must have succeeded.
    uses
        Steps that come first but may have failed.
    protocols
        Protocols the step belongs to; all where empty.
    """

    def register(function: Callable[[Extraction], Details]) -> Callable[[Extraction], Details]:
        order = (tuple(after), tuple(uses), tuple(protocols))
        STEPS[name] = ExtractionStep(name, title, dict(gives or {}), *order, function)
        return function

    return register


UNITS = {
    "N": "N",
    "m": "m",
    "Pa": "Pa",
    "J": "J",
    "s": "s",
    "m2": "m^2",
    "m3": "m^3",
    "N_m": "N/m",
    "N_s": "N/s",
    "J_m2": "J/m^2",
    "Pa_s": "Pa/s",
    "m3_s": "m^3/s",
    "count": "",
    "fraction": "",
}


def unit_of(feature: str) -> str:
    """Return the SI unit that ends a feature's name."""
    ends = (end for end in sorted(UNITS, key=len, reverse=True) if feature.endswith("_" + end))
    return UNITS[next(ends)]


def meanings() -> dict[str, str]:
    """Return what each registered feature is, in order."""
    return {name: text for step in ordered() for name, text in step.gives.items()}


def ordered() -> list[ExtractionStep]:
    """Return the registered steps as their modules list them, but each behind those it needs or uses.

    The order is that of ``MODULES`` and of the lines within a module, whatever was imported first; steps registered
    elsewhere come last, by the name of their module.
    """
    done: dict[str, ExtractionStep] = {}

    def place(step: ExtractionStep) -> None:
        for name in (*step.after, *step.uses):
            if name not in done:
                place(STEPS[name])
        done.setdefault(step.name, step)

    for step in sorted(STEPS.values(), key=_place_in_source):
        place(step)
    return list(done.values())


def _place_in_source(step: ExtractionStep) -> tuple[int, str, int]:
    module = step.function.__module__
    known = [f"analysis.{name}" for name in MODULES]
    place = known.index(module) if module in known else len(known)
    return place, module, step.function.__code__.co_firstlineno


def extract(run: Run, *, before: Extraction | None = None) -> Extraction:
    """Run every step that applies; a step that finds nothing leaves its features missing, with the reason.

    A run that differs a little from one extracted ``before`` keeps its creep, and its fits begin at those of that one.
    """
    work = Extraction(run, None if before is None else before.creep, before)
    for step in ordered():
        if step.protocols and run.protocol not in step.protocols:
            continue
        reason = next((f"needs {name}: {work.failed[name]}" for name in step.after if name in work.failed), None)
        if reason is None:
            try:
                work.details[step.name] = step.function(work)
            except FeatureMissing as error:
                reason = str(error)
        if reason is not None:
            work.failed[step.name] = reason
            work.missing.update(dict.fromkeys(step.gives, reason))
    return work


def markdown() -> str:
    """Return every step with its decision and its features, as Markdown for the documentation."""
    lines: list[str] = []
    for step in ordered():
        limits = f" ({', '.join(step.protocols)} only)" if step.protocols else ""
        lines += [
            f"### {step.title}{limits}",
            "",
            *(line.removeprefix("    ") for line in step.explanation.splitlines()),
            "",
        ]
        lines += [*(f"- `{name}`: {text}" for name, text in step.gives.items()), ""] if step.gives else []
    return "\n".join(lines)
