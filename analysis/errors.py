"""Errors of the analysis."""


class AnalysisError(Exception):
    """A run cannot be analysed; the message names the run, the step and why."""


class FeatureMissing(AnalysisError):
    """The run holds no such feature, e.g. no pull-off because it was aborted before."""
