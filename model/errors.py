"""Errors of the physics: what a caller can catch by kind."""


class ModelError(Exception):
    """Any failure of a solver or of its input."""


class InvalidParameter(ModelError, ValueError):
    """A physical parameter lies outside the range the model is defined for."""


class UnsupportedScene(ModelError):
    """The papers hold no model for this combination (the soft gripper, for instance)."""


class NotConverged(ModelError, ArithmeticError):
    """A solver ended without a converged error estimate: there is no number to return."""
