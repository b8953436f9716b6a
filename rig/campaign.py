"""Campaigns: a matrix of scenes, pressures, places and repeats, taken up again where a crash has left it.

Every test is a recording of its own. The journal, one JSON line per finished test, is written and synced after the
recording is closed; a test without a line is done again under a new name, and what a crash has left is kept.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tomlkit
from pydantic import Field

from rig.errors import FileError
from rig.journal import journal_of
from rig.library import find, load_scene
from rig.scene import PRINTABLE, Scene, Title, parse_scene
from rig.validation import Section, parsed

JOURNAL = "journal.jsonl"
MOST_REPEATS = 1000


class EntrySection(Section):
    """``[[test]]``: a scene, the pressures it is run at, how often, and what the operator has to do before.

    ``name`` (by default the scene's) names recordings and titles of tests at other pressures than the scene's.
    """

    scene: Annotated[str, Field(pattern=PRINTABLE)]
    name: Title | None = None
    initial_pressures_kPa: Annotated[tuple[float, ...], Field(min_length=1, strict=False)] | None = None
    repeats: Annotated[int, Field(ge=1, le=MOST_REPEATS)] | None = None
    prompt: Annotated[str, Field(max_length=1000, pattern=PRINTABLE)] = ""


class Campaign(Section):
    """A campaign file."""

    title: Title
    order: Literal["given", "random"] = "given"
    seed: int = 0
    repeats: Annotated[int, Field(ge=1, le=MOST_REPEATS)] = 1
    test: Annotated[tuple[EntrySection, ...], Field(min_length=1, strict=False)]


@dataclass(frozen=True, slots=True)
class PlannedTest:
    """One test of a campaign.

    Attributes
    ----------
    key
        Names the test in the journal and its recording; the same in every process that reads the file.
    scene_text
        The scene with the pressure of this test.
    place
        Position on the membrane, or sample; empty where the protocol names none.
    setup
        Tests with the same setup need no hands between them.
    prompt
        What the operator has to do before the first test of a setup.
    """

    key: str
    scene: Scene
    scene_text: str
    place: str
    repeat: int
    repeats: int
    seed: int
    setup: str
    prompt: str

    @property
    def digest(self) -> str:
        """What was to be measured, in short; the journal keeps it to notice that a scene has been changed since."""
        return hashlib.sha256(f"{self.scene_text}\0{self.place}".encode()).hexdigest()[:16]


def load_campaign(path: Path) -> tuple[Campaign, list[PlannedTest]]:
    """Read and check a campaign file, or one that ships by its name, and every scene in it.

    Raises
    ------
    FileError
        Names the file, the key, the value and the allowed range.
    """
    campaign = parsed(Campaign, "campaign", *find("campaign", path))
    return campaign, list(_ordered(campaign, _distinct(_tests(campaign, path.parent), f"campaign {path}")))


def single(scene: Scene, text: str, stem: str, repeats: int, seed: int) -> list[PlannedTest]:
    """Return the tests of one scene: its places, each so often."""
    return _distinct(_places(scene, text, stem, repeats, seed, ""), stem)


def _distinct(tests: Iterable[PlannedTest], source: str) -> list[PlannedTest]:
    """Refuse places whose recordings would have one name."""
    found: dict[str, PlannedTest] = {}
    for test in tests:
        if test.key in found:
            raise FileError(
                f"{source}: {found[test.key].place!r} and {test.place!r} would both be recorded as {test.key}. "
                "Remedy: let them differ in letters or digits."
            )
        found[test.key] = test
    return list(found.values())


def _tests(campaign: Campaign, folder: Path) -> Iterator[PlannedTest]:
    for number, section in enumerate(campaign.test):
        beside = folder / section.scene
        source = beside if beside.is_file() else section.scene
        scene, text = load_scene(source)
        repeats = section.repeats or campaign.repeats
        name = section.name or Path(source).stem
        stem = f"{number + 1:02d}-{_word(name)}"
        if section.initial_pressures_kPa is None:
            yield from _places(scene, text, stem, repeats, campaign.seed, section.prompt, in_campaign=True)
            continue
        for pressure in section.initial_pressures_kPa:
            changed, changed_text = _at_pressure(text, name, pressure, f"{source} at {pressure:g} kPa")
            yield from _places(
                changed,
                changed_text,
                f"{stem}_{pressure:+g}kPa",
                repeats,
                campaign.seed,
                section.prompt,
                in_campaign=True,
            )


def _at_pressure(text: str, name: str, pressure: float, source: str) -> tuple[Scene, str]:
    """Return scene and text at another pressure; what is recorded is what is run, in its title too."""
    changed = tomlkit.parse(text)
    changed["title"] = f"{name} at {pressure:+g} kPa"
    changed.setdefault("protocol", {"name": "pull_off"})["initial_pressure_kPa"] = pressure
    changed_text = tomlkit.dumps(changed)
    return parse_scene(changed_text, source), changed_text


def _places(
    scene: Scene, text: str, stem: str, repeats: int, seed: int, prompt: str, *, in_campaign: bool = False
) -> Iterator[PlannedTest]:
    """Yield the tests at each place.

    A campaign numbers them even if there is one, since more may be asked for later, and gives each a seed of its own:
    repeats of different conditions must not share their noise.
    """
    places: Sequence[str] = getattr(scene.protocol, "positions", ("",))
    repeats = max(repeats, getattr(scene.protocol, "repeats", 1))
    for index, place in enumerate(places):
        hands = prompt if not place else " ".join(filter(None, (prompt, f"Bring the probe over {place}.")))
        for repeat in range(1, repeats + 1):
            parts = [stem, _word(place), f"{repeat}" if in_campaign or repeats > 1 else ""]
            key = "-".join(filter(None, parts))
            yield PlannedTest(
                key=key,
                scene=scene,
                scene_text=text,
                place=place,
                repeat=repeat,
                repeats=repeats,
                seed=_seed(seed, key) if in_campaign else seed + 1000 * index + repeat - 1,
                setup=f"{stem.split('-', maxsplit=1)[0]} {place}",
                prompt=hands,
            )


def _seed(campaign: int, key: str) -> int:
    return int(hashlib.sha256(f"{campaign}\0{key}".encode()).hexdigest()[:8], 16)


def _word(place: str) -> str:
    return "".join(letter if letter.isalnum() or letter == "-" else "_" for letter in place)


def _ordered(campaign: Campaign, tests: list[PlannedTest]) -> Iterator[PlannedTest]:
    """Yield the tests; ``random`` shuffles within each setup, since a change of setup needs hands."""
    if campaign.order == "given":
        yield from tests
        return
    shuffled = random.Random(campaign.seed)
    for setup in dict.fromkeys(test.setup for test in tests):
        group = [test for test in tests if test.setup == setup]
        shuffled.shuffle(group)
        yield from group


@dataclass
class Journal:
    """What of a campaign is done, on disk in its folder."""

    folder: Path

    def done(self) -> dict[str, str]:
        """Return the recordings of the finished tests by key; a torn last line counts as unwritten.

        Raises
        ------
        FileError
            A line in the middle of the journal is no entry.
        """
        return {key: str(entry["recording"]) for key, entry in self._entries().items()}

    def check(self, tests: Sequence[PlannedTest]) -> None:
        """Refuse a campaign whose scenes are no longer those that were measured.

        Raises
        ------
        FileError
            Names the test.
        """
        entries = self._entries()
        for test in tests:
            if test.key in entries and entries[test.key].get("scene", test.digest) != test.digest:
                raise FileError(
                    f"{self.folder / JOURNAL}: {test.key} was measured with another scene than the campaign names now. "
                    "Remedy: restore the scene, or begin a new folder with --out."
                )

    def _entries(self) -> dict[str, dict[str, Any]]:
        path = self.folder / JOURNAL
        if not path.exists():
            return {}
        entries: dict[str, dict[str, Any]] = {}
        lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
        for number, line in enumerate(lines, 1):
            if not line:
                continue
            try:
                entry = json.loads(line)
                name = str(entry["recording"])
                if not name or Path(name).name != name:
                    raise ValueError(f"{name!r} is no file of this folder")
                entries[str(entry["key"])] = {**entry, "recording": name}
            except (ValueError, KeyError, TypeError) as error:
                if number == len(lines):
                    continue  # the program died while writing it
                raise FileError(f"{path}, line {number}: no entry ({error}). Remedy: remove that line.") from error
        return entries

    def write(self, key: str, recording: str, **more: Any) -> None:
        """Append one finished test and sync it to the disk; ``more`` is kept with it."""
        self._mend()
        with (self.folder / JOURNAL).open("a", encoding="utf-8") as file:
            file.write(json.dumps({"key": key, "recording": recording, **more}) + "\n")
            file.flush()
            os.fsync(file.fileno())

    def adopt(self, tests: Sequence[PlannedTest], is_whole: Callable[[Path, PlannedTest], bool]) -> list[str]:
        """Enter tests whose recording is whole although the journal does not know them; return their keys."""
        done, adopted = self.done(), []
        for test in tests:
            if test.key in done:
                continue
            for recording in sorted(self.folder.glob(f"{test.key}*.h5")):
                if self._belongs(recording, test.key) and is_whole(recording, test):
                    self.write(test.key, recording.name, scene=test.digest, adopted=True)
                    adopted.append(test.key)
                    break
        return adopted

    def free_name(self, key: str) -> Path:
        """Return a name for the test's recording that nothing has yet."""
        for number in range(1, 10_000):
            path = self.folder / (f"{key}.h5" if number == 1 else f"{key}~{number}.h5")
            if not path.exists() and not journal_of(path).exists():
                return path
        raise FileError(f"{self.folder}: ten thousand recordings of {key}. Remedy: clear the folder.")

    @staticmethod
    def _belongs(recording: Path, key: str) -> bool:
        return recording.stem.partition("~")[0] == key

    def _mend(self) -> None:
        """Cut a torn last line off."""
        path = self.folder / JOURNAL
        if not path.exists():
            return
        content = path.read_bytes()
        if content and not content.endswith(b"\n"):
            path.write_bytes(content[: content.rfind(b"\n") + 1])
