"""Errors of the application. Every one names the place, the value and the remedy."""


class RigError(Exception):
    """Any failure the operator can act on. ``exit_code`` is what the command line returns."""

    exit_code = 1


class FileError(RigError):
    """A scene, bench, recording or output file is missing, unreadable or holds an impossible value."""

    exit_code = 2


class BeingWritten(FileError):
    """A recording cannot be repaired while a program still writes it."""


class Interlock(RigError):
    """A limit was passed; everything has been stopped."""

    exit_code = 3


class Refused(RigError):
    """The scene cannot be run on this bench; nothing has moved."""

    exit_code = 5


class StoppedByOperator(RigError):
    """The operator ended the run."""

    exit_code = 130
