"""A store that ends with the process: what `Store` keeps in a file, kept as it is."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import reduce
from operator import add

from analysis.sweeps.cases import Label
from analysis.sweeps.store.packed import add_sums, sums_of
from analysis.sweeps.store.ranges import Ranges, joined
from analysis.sweeps.store.store import Run, Store, check_identity, united
from analysis.sweeps.tasks import RunResult
from planner.files import Json
from planner.limits import BLOCK
from planner.tally import Tally


@dataclass
class _Held:
    """A run: its labels, its facts, and a tally of each block, by number."""

    what: dict[str, Label]
    facts: Json
    blocks: dict[int, Tally] = field(default_factory=dict)

    def tallies(self) -> list[Tally]:
        """In order of their ids."""
        return [self.blocks[number] for number in sorted(self.blocks)]


class Memory(Store):
    """Runs and their tallies, 20 kB each for 400 cells."""

    def __init__(self) -> None:
        self.path = None
        self._held: dict[str, _Held] = {}

    def close(self) -> None:
        """There is no file to let go of."""

    def forget(self, keys: Iterable[str]) -> None:
        """Hold these runs no longer: whoever needed them is done."""
        for key in keys:
            self._held.pop(key, None)

    def __len__(self) -> int:
        return len(self._held)

    def held(self, key: str) -> Ranges:
        found = self._held.get(key)
        return () if found is None else joined(pair for tally in found.tallies() for pair in tally.ids)

    def tally(self, key: str) -> Tally | None:
        found = self._held.get(key)
        return None if found is None else reduce(add, found.tallies())

    def run(self, key: str) -> Run | None:
        found = self._held.get(key)
        if found is None:
            return None
        return Run(key, found.what, found.facts, self.held(key), reduce(add_sums, map(sums_of, found.tallies())))

    def runs(self) -> Iterator[Run]:
        return (run for key in list(self._held) if (run := self.run(key)) is not None)

    def labels(self) -> Iterator[dict[str, Label]]:
        return (held.what for held in self._held.values())

    def label(self, key: str, what: Mapping[str, Label]) -> None:
        self._held[key].what = dict(sorted((dict(what) | self._held[key].what).items()))

    def add(self, results: Iterable[RunResult]) -> dict[str, Ranges]:
        lost: dict[str, Ranges] = {}
        for result in results:
            for tally in result.tallies:
                held = self._held.setdefault(result.key, _Held({}, result.facts))
                for other in held.tallies()[:1]:
                    check_identity(result.key, other.key, tally.key, result.what, None)
                self.label(result.key, result.what)
                number = tally.ids[0][0] // BLOCK
                here = held.blocks.get(number)
                held.blocks[number], left_out = (tally, ()) if here is None else united(result.key, here, tally, None)
                if left_out:
                    lost[result.key] = joined([*lost.get(result.key, ()), *left_out])
        return lost

    def _results(self, notes: list[str]) -> Iterator[RunResult]:
        for key, held in self._held.items():
            yield RunResult(key, held.what, held.facts, tuple(held.tallies()))
