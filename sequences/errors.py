"""Errors of the sequences."""


class StepFailed(Exception):
    """A step could not reach its condition. Everything is stopped; the recording keeps what was measured."""

    exit_code = 4

    def __init__(self, step: str, message: str, remedy: str) -> None:
        self.step = step
        super().__init__(f"step {step}: {message}. Remedy: {remedy}.")
