"""Turn pydantic's findings into one sentence an operator can act on."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel, ValidationError


def explain(what: str, source: str, error: ValidationError, schema: type[BaseModel]) -> str:
    """Return file, key, value, reason and remedy for every finding, one line each."""
    lines = [_line(finding, schema) for finding in error.errors(include_url=False)]
    return _printable(f"{what} {source}: " + "; ".join(dict.fromkeys(lines)))


def _printable(text: str) -> str:
    """Keep what a file holds from doing anything to the terminal, or from looking like another line."""
    return "".join(character if character.isprintable() else ascii(character)[1:-1] for character in text)


def _line(finding: Any, schema: type[BaseModel]) -> str:
    key = ".".join(str(part) for part in finding["loc"])
    if finding["type"] == "extra_forbidden":
        known = sorted(_keys(schema))
        close = difflib.get_close_matches(str(finding["loc"][-1]), known, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]}?" if close else f"known keys: {', '.join(known)}"
        return f"unknown key {key} ({hint})"
    if finding["type"] == "missing":
        return f"{key} is missing. Remedy: add it"
    reason = finding["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    if finding["type"] == "value_error":
        return f"{key + ': ' if key else ''}{reason}"
    return f"{key} = {finding['input']!r} is not allowed; it should be {reason}"


def _keys(schema: type[BaseModel]) -> Iterable[str]:
    for name, field in schema.model_fields.items():
        yield name
        for part in _models(field.annotation):
            yield from _keys(part)


def _models(annotation: Any) -> Iterable[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in getattr(annotation, "__args__", ()):
        yield from _models(argument)
