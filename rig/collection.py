"""The recordings a command works on: files and folders, each once and under a name of its own.

One that cannot be analysed is named with its reason; the others are not held up by it.
"""

from __future__ import annotations

import hashlib
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rig.errors import FileError

if TYPE_CHECKING:
    from analysis.batch import Analyzed, Source
    from rig.areas import Areas
    from rig.calibrate import Calibration
    from rig.recording import Recording


@dataclass(frozen=True)
class Calibrated:
    """A calibration recording and what it gives."""

    source: Source
    protocol: str
    calibration: Calibration


@dataclass
class Collection:
    """Recordings of one command.

    Attributes
    ----------
    files
        Every recording that was named, in order, each once.
    left
        What was not analysed, and why.
    notes
        What else the user should know.
    """

    files: list[Path] = field(default_factory=list)
    runs: list[Analyzed] = field(default_factory=list)
    calibrations: list[Calibrated] = field(default_factory=list)
    left: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def exit_code(self) -> int:
        """0, 1 where something was left out, 2 where nothing could be analysed."""
        if not self.left:
            return 0
        return 1 if self.runs or self.calibrations else 2

    def leave_calibrations(self) -> None:
        """Leave calibrations out: features and curves are asked for, and they hold none."""
        for one in self.calibrations:
            self.left[str(Path(one.source.path))] = (
                f"a calibration ({one.protocol}) has no features. Remedy: analyse it without options, or with --json."
            )
        self.calibrations.clear()

    def tell(self) -> None:
        """Say on standard error what was not analysed."""
        for note in self.notes:
            print(note, file=sys.stderr)
        for name, reason in self.left.items():
            print(f"not analysed: {name}: {reason}", file=sys.stderr)


def collect(
    paths: Iterable[Path],
    *,
    model: str = "cone",
    pictures: bool = False,
    jobs: int | None = None,
    scheduler: str | None = None,
    areas: Areas | None = None,
) -> Collection:
    """Analyse recordings, with progress on standard error; on several processes where there are more than three.

    Parameters
    ----------
    paths
        Recordings, and folders of recordings; of a campaign's folder only what its journal names.
    areas
        Contact areas measured since, by the recordings' own names.

    Raises
    ------
    NoScheduler
        None answers at ``scheduler``.
    """
    from tqdm import tqdm

    from analysis.batch import Analyzed, on_all_cores

    found = Collection()
    _list_files(found, paths)
    items = list(zip(found.files, own_names(found.files), strict=True))
    workers = 1 if jobs is None and len(items) <= 3 else jobs
    outcomes = on_all_cores(
        partial(analyze_file, model=model, pictures=pictures, areas=areas),
        items,
        workers=workers,
        scheduler=scheduler,
        lost=lambda _, reason: reason,
    )
    quiet = len(items) < 2 or not sys.stderr.isatty()
    seen: dict[str, str] = {}
    for (path, _), outcome in zip(items, tqdm(outcomes, total=len(items), unit="run", disable=quiet), strict=True):
        if isinstance(outcome, str):
            found.left[str(path)] = outcome
            continue
        source = outcome.source
        assert source is not None
        if source.sha256 in seen:
            found.left[str(path)] = f"is a copy of {seen[source.sha256]}; it counts once"
            continue
        seen[source.sha256] = str(path)
        if isinstance(outcome, Analyzed):
            found.runs.append(outcome)
        else:
            found.calibrations.append(outcome)
    return found


def _list_files(found: Collection, paths: Iterable[Path]) -> None:
    known: set[Path] = set()
    for given in paths:
        files = _in_folder(found, given) if given.is_dir() else [given]
        if not files:
            found.left[str(given)] = "holds no recording (.h5)"
        for path in files:
            if path.resolve() in known:
                found.notes.append(f"{path}: named twice; it counts once")
                continue
            known.add(path.resolve())
            found.files.append(path)


def _in_folder(found: Collection, folder: Path) -> list[Path]:
    """Return a folder's recordings by name; a campaign's journal says which are its own."""
    from rig.campaign import JOURNAL, Journal

    journals = (path.with_suffix("") for path in folder.glob("*.h5.journal") if path.is_file())
    files = sorted({*journals, *(path for path in folder.glob("*.h5") if path.is_file())})
    if not (folder / JOURNAL).exists():
        return files
    entries = {folder / name for name in Journal(folder).done().values()}
    found.notes += [f"{path}: not in the campaign's {JOURNAL}; left out" for path in files if path not in entries]
    return sorted(entries)


def own_names(paths: Sequence[Path]) -> list[str]:
    """Return a name for each file: its own without ending, with as many folders before it as tell it from others."""
    whole = [path.absolute() for path in paths]

    def called(path: Path, depth: int) -> str:
        folders = path.parts[1:-1]
        return "-".join((*folders[max(0, len(folders) - depth) :], path.stem))

    names = [called(path, 0) for path in whole]
    for depth in range(1, max((len(path.parts) for path in whole), default=2) - 1):
        shared = _repeated(names)
        names = [called(p, depth) if name.casefold() in shared else name for name, p in zip(names, whole, strict=True)]
    shared = _repeated(names)
    names = [path.name if name.casefold() in shared else name for name, path in zip(names, whole, strict=True)]
    return [_printable(name) for name in names]


def _repeated(names: Iterable[str]) -> set[str]:
    return {name for name, count in Counter(name.casefold() for name in names).items() if count > 1}


def _printable(text: str) -> str:
    return "".join(character if character.isprintable() else ascii(character)[1:-1] for character in text)


def analyze_file(
    item: tuple[Path, str], *, model: str = "cone", pictures: bool = False, areas: Areas | None = None
) -> Analyzed | Calibrated | str:
    """Analyse one recording under a name; a text says why that was not possible."""
    from analysis.batch import analyze_run
    from analysis.errors import AnalysisError
    from model.errors import ModelError
    from rig.areas import with_area
    from rig.calibrate import calibrate
    from rig.measured import as_run
    from rig.recording import load_recording

    path, name = item
    try:
        recording = load_recording(path)
        source = source_of(recording, name)
        calibration = calibrate(recording)
        if calibration is not None:
            return Calibrated(source, recording.scene.protocol.name, calibration)
        run = with_area(replace(as_run(recording), name=name), areas or {})
        return replace(analyze_run(run, model=model, pictures=pictures), source=source)
    except (FileError, AnalysisError, ModelError) as error:
        return str(error).removeprefix(f"recording {path}: ").removeprefix(f"{path}: ").removeprefix(f"{name}: ")
    except (ArithmeticError, LookupError, ValueError) as error:  # of data nobody has thought of
        return f"the analysis failed ({type(error).__name__}: {error}). Remedy: report it, with the recording."


def source_of(recording: Recording, name: str) -> Source:
    """Return where a run came from: file, SHA-256, and what the recording says of its making."""
    from analysis.batch import Source
    from rig.measured import provenance

    path = recording.path
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return Source(path.as_posix(), f"{name}{path.suffix}", digest, provenance(recording))
