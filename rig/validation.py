"""Files and tables the user writes, checked; what is wrong is one sentence an operator can act on."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
    model_validator,
)

from rig.errors import FileError

Schema = TypeVar("Schema", bound=BaseModel)

BOUNDS = frozenset(
    {
        "greater_than",
        "greater_than_equal",
        "less_than",
        "less_than_equal",
        "string_pattern_mismatch",
        "string_too_long",
        "too_short",
    }
)
"""Findings that say what may be run, and nothing against reading what has been."""


class Section(BaseModel):
    """A table of a file: unknown keys and wrong types are refused.

    What a recording was made with is read whatever bounds and rules have become since; its structure is checked.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    @field_validator("*", mode="wrap")
    @classmethod
    def _within_bounds(cls, value: Any, check: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
        try:
            return check(value)
        except ValidationError as error:
            if _recorded(info) and all(finding["type"] in BOUNDS for finding in error.errors()):
                return _as_it_stands(value)
            raise


def rule(check: Callable[[Schema], Schema]) -> Any:
    """Make a method of a ``Section``, which may raise ``ValueError``, a rule for its values; none for recorded ones."""

    def checked(section: Schema, info: ValidationInfo) -> Schema:
        return section if _recorded(info) else check(section)

    return model_validator(mode="after")(checked)


def _recorded(info: ValidationInfo) -> bool:
    return bool(info.context)


def _as_it_stands(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_as_it_stands, value))
    return _printable(value) if isinstance(value, str) else value


def parsed(schema: type[Schema], kind: str, text: str, source: str, *, recorded: bool = False) -> Schema:
    """Check the text of a TOML file.

    Parameters
    ----------
    kind, source
        What the file is, and where: the beginning of every message.
    recorded
        The text is that of a recording: bounds and rules, which are for a run to come, are left out.

    Raises
    ------
    FileError
        It is not TOML, or as ``validated``.
    """
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, brackets thousands deep
        raise FileError(f"{kind} {source}: not valid TOML: {error}. Remedy: mend the line it names.") from error
    return validated(schema, kind, content, source, recorded=recorded)


def validated(
    schema: type[Schema], kind: str, content: dict[str, Any], source: str, *, recorded: bool = False
) -> Schema:
    """Check the content of a file, as ``parsed`` its text.

    Raises
    ------
    FileError
        Names key, value, reason and remedy of every finding.
    """
    try:
        return schema.model_validate(content, context={"recorded": True} if recorded else None)
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
