"""The registry of the papers' figures, and what each is given to draw with.

A figure is one function: it draws into a Matplotlib figure and returns the drawn data as one long table, which is saved
as CSV beside the picture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from analysis.errors import AnalysisError
from analysis.figures.style import canvas, encode, mark_emulated, save
from analysis.repeats import Group
from model.parameters import Parameters

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from model.prediction import Prediction


@dataclass
class Material:
    """What a figure is drawn from.

    Attributes
    ----------
    groups
        Analysed recordings by condition; empty: the models alone.
    model
        Which model draws the theory: ``"cone"``, ``"cone-2017"``, ``"membrane"``.
    used
        Names of the runs that figures drawn so far show.
    """

    groups: Sequence[Group] = ()
    model: str = "cone"
    used: set[str] = field(default_factory=set)
    _known: dict[tuple[Parameters, str], Prediction] = field(default_factory=dict)

    def predict(self, parameters: Parameters, model: str | None = None) -> Prediction:
        """Predict one scene; each is computed once."""
        from model import predict

        key = (parameters, model or self.model)
        if key not in self._known:
            self._known[key] = predict(key[0], key[1])
        return self._known[key]

    def pull_offs(self, gripper: str = "rigid") -> list[Group]:
        """Return the groups of pull-off tests that have a curve."""
        return [
            members
            for members in self.groups
            if members.condition.protocol == "pull_off"
            and members.condition.gripper == gripper
            and any(member.curve is not None for member in members.kept)
        ]


Draw = Callable[["Figure", Material], "pd.DataFrame"]


@dataclass(frozen=True)
class PaperFigure:
    """One figure: its number, what it shows, its size in inches, and the function that draws it."""

    number: str
    title: str
    size: tuple[float, float]
    draw: Draw

    def draw_marked(self, figure: Figure, material: Material) -> pd.DataFrame:
        """Draw it, and say where what it shows comes from emulated instruments; return the data."""
        data = self.draw(figure, material)
        if "EMULATED" in data:
            real = (data["source"] == "measured") & (data["EMULATED"] != "yes")
            mark_emulated(figure, partly=bool(real.any()))
        return data


FIGURES: dict[str, PaperFigure] = {}
"""Registered figures by number; ``load`` fills it."""


def paper_figure(number: str, title: str, size: tuple[float, float] = (5.2, 3.8)) -> Callable[[Draw], Draw]:
    """Register a figure under its number in the papers."""

    def register(function: Draw) -> Draw:
        FIGURES[number] = PaperFigure(number, title, size, function)
        return function

    return register


def load() -> dict[str, PaperFigure]:
    """Import every module with figures; return them by number, in the papers' order."""
    from importlib import import_module

    for module in ("experiments", "theory", "sampling_error"):
        import_module(f"analysis.figures.{module}")
    return dict(sorted(FIGURES.items()))


def find(number: str) -> PaperFigure:
    """Return a figure by its number.

    Raises
    ------
    AnalysisError
        There is no such figure; the message lists those there are.
    """
    figures = load()
    if number not in figures:
        raise AnalysisError(f"no figure {number!r}. Remedy: choose one of {', '.join(figures)}")
    return figures[number]


def draw(number: str, material: Material, path: Path) -> Path:
    """Draw a figure to ``path`` and its data to the same name with ``.csv``; return the latter."""
    chosen = find(number)
    with canvas(*chosen.size) as figure:
        data = chosen.draw_marked(figure, material)
        save(figure, path)
    material.used.update(data.attrs.get("runs", ()))
    table = path.with_suffix(".csv")
    table.write_text(data.to_csv(index=False, float_format="%.9g", lineterminator="\n"), encoding="utf-8")
    return table


def picture(number: str, material: Material, kind: str = "png") -> bytes:
    """Return a figure as bytes."""
    chosen = find(number)
    with canvas(*chosen.size) as figure:
        chosen.draw_marked(figure, material)
        return encode(figure, kind)
