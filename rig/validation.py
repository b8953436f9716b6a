"""Files and tables the user writes, checked; what is wrong is one sentence an operator can act on."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from rig.errors import FileError

Schema = TypeVar("Schema", bound=BaseModel)


def parsed(schema: type[Schema], kind: str, text: str, source: str) -> Schema:
    """Check the text of a TOML file.

    Parameters
    ----------
    kind, source
        What the file is, and where: the beginning of every message.

    Raises
    ------
    FileError
        It is not TOML, or as ``validated``.
    """
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"{kind} {source}: not valid TOML: {error}. Remedy: mend the line it names.") from error
    return validated(schema, kind, content, source)


def validated(schema: type[Schema], kind: str, content: dict[str, Any], source: str) -> Schema:
    """Check the content of a file, as ``parsed`` its text.

    Raises
    ------
    FileError
        Names key, value, reason and remedy of every finding.
    """
    try:
        return schema.model_validate(content)
    except ValidationError as error:
        lines = [_line(finding, schema, content) for finding in error.errors(include_url=False)]
        raise FileError(_printable(f"{kind} {source}: " + "; ".join(dict.fromkeys(lines)))) from error


def _printable(text: str) -> str:
    """Keep what a file holds from doing anything to the terminal, or from looking like another line."""
    return "".join(character if character.isprintable() else ascii(character)[1:-1] for character in text)


def _line(finding: Any, schema: type[BaseModel], content: dict[str, Any]) -> str:
    key = ".".join(_place(finding["loc"], content))
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


def _place(location: tuple[str | int, ...], content: Any) -> Iterable[str]:
    """Yield the keys as they stand in the file: the tag of a table that has several forms is none of them."""
    for number, part in enumerate(location):
        inside = isinstance(content, dict) and part in content
        if isinstance(content, dict) and not inside and number + 1 < len(location):
            continue
        yield str(part)
        content = content[part] if inside or (isinstance(content, list) and isinstance(part, int)) else None


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
