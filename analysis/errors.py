"""Errors of the analysis."""


class AnalysisError(Exception):
    """A run cannot be analysed; the message names the run, the step and why."""


class NoScheduler(AnalysisError):
    """No Dask scheduler answers at the address given."""

    exit_code = 2


class WorkerLost(AnalysisError):
    """Every process at work on an item was killed from outside; or the cluster is gone."""


class UnknownFormat(AnalysisError):
    """A picture is asked for in a format that is not written."""

    exit_code = 2


class FeatureMissing(AnalysisError):
    """The run holds no such feature, e.g. no pull-off because it was aborted before."""
