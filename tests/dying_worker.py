"""Work that ends the process it is done in, as an out-of-memory killer would; importable by worker processes."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path


def square(folder: Path, deaths: Mapping[int, int], number: int, seconds: float = 0.0) -> int:
    """Return the square of ``number`` after as many deaths as it is to have; ``folder`` counts them.

    All but 0 take so many seconds.
    """
    time.sleep(seconds if number else 0.0)
    died = len(list(folder.glob(f"{number}-death-*")))
    if died < deaths.get(number, 0):
        (folder / f"{number}-death-{died}").touch()
        os._exit(9)
    return number**2
