"""What a study hands to the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

Progress = Callable[[str], None]
"""Told what is being computed."""


@dataclass
class Section:
    """A part of the report: text (Markdown), tables and pictures by file name without suffix."""

    title: str
    text: str = ""
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    figures: dict[str, Callable[[Path], None]] = field(default_factory=dict)
    captions: dict[str, str] = field(default_factory=dict)
    """What a table or picture shows, by its name."""
    csv_only: frozenset[str] = frozenset()
    """Tables too long for the page; written as CSV and linked."""
