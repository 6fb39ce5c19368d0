"""Random worlds: exact counts, the shape of areas, streams of their own, and the pinned hash of one of each kind."""

from __future__ import annotations

import time

import numpy as np
import pytest
from scipy import ndimage

from planner.errors import WorldError
from planner.failure_model import key_of, threefry2x32
from planner.world.generate import OBSTACLES, PAPER_LEVELS, Stream, ThreatPattern, random_threats, random_world

PINNED = {
    "contiguous": "02e61d25c7a3b4b4584d28b19787a6c0c4956652fd486954710e263cc87e1759",
    "scattered": "85e3e4a9ff8783a6bbc3b42492304d1f97b12b4162451a67027ba03fc39fd591",
}


def areas_of(threat: np.ndarray) -> list[tuple[float, int]]:
    """(level, size) of every 4-connected set of cells of one level."""
    found = []
    for level in np.unique(threat[threat > 0]):
        labels, _ = ndimage.label(threat == level)
        found += [(float(level), int(size)) for size in np.bincount(labels.ravel())[1:]]
    return found


@pytest.mark.parametrize("kind", ["contiguous", "scattered"])
def test_one_world_of_each_kind_is_the_same_everywhere(kind: str) -> None:
    world = random_world(14, 23, ThreatPattern(kind=kind, seed=5))  # type: ignore[arg-type]
    assert world.sha256 == PINNED[kind]


@pytest.mark.parametrize("kind", ["contiguous", "scattered"])
@pytest.mark.parametrize("seed", [0, 1, 2**64 - 1])
def test_the_papers_worlds_have_exact_counts(kind: str, seed: int) -> None:
    world = random_world(20, 20, ThreatPattern(kind=kind, seed=seed))  # type: ignore[arg-type]
    assert (~world.free).sum() == 100
    levels, counts = np.unique(world.threat[world.threat > 0], return_counts=True)
    assert levels.tolist() == [np.float32(level) for level in PAPER_LEVELS]
    assert counts.tolist() == [20] * 5


@pytest.mark.parametrize("seed", range(30))
def test_contiguous_areas_are_ten_of_equal_size_and_apart(seed: int) -> None:
    world = random_world(20, 20, ThreatPattern(seed=seed))
    assert areas_of(world.threat) == [(np.float32(level), 10) for level in PAPER_LEVELS for _ in range(2)]


def test_sizes_differ_by_one_cell_when_the_count_does_not_divide() -> None:
    world = random_world(31, 17, ThreatPattern(areas=7, levels=(0.1, 0.2, 0.3), seed=4), obstacles=0.1, threats=0.2)
    sizes = sorted(size for _, size in areas_of(world.threat))
    assert sum(sizes) == round(0.2 * 31 * 17) == 105
    assert sizes == [15] * 7
    free = np.ones((9, 13), dtype=bool)
    assert sorted(size for _, size in areas_of(random_threats(free, 23, ThreatPattern(areas=5)))) == [4, 4, 5, 5, 5]


@pytest.mark.parametrize("kind", ["contiguous", "scattered"])
@pytest.mark.parametrize("areas", [1, 3, 50])
def test_every_free_cell_can_become_dangerous(kind: str, areas: int) -> None:
    free = np.random.default_rng(3).random((12, 19)) < 0.55  # many small pockets
    count = int(free.sum())
    for wanted in (count, count - 1, count // 2):
        threat = random_threats(free, wanted, ThreatPattern(kind=kind, areas=areas, seed=9))  # type: ignore[arg-type]
        assert (threat > 0).sum() == wanted
        assert not threat[~free].any()


def test_no_threats_and_fewer_threats_than_areas() -> None:
    free = np.ones((3, 4), dtype=bool)
    assert not random_threats(free, 0, ThreatPattern()).any()
    assert (random_threats(free, 3, ThreatPattern(areas=10)) > 0).sum() == 3


def test_both_kinds_of_a_seed_share_their_obstacles_and_other_seeds_do_not() -> None:
    one, other = (random_world(11, 16, ThreatPattern(kind=kind, seed=8)) for kind in ("contiguous", "scattered"))
    assert (one.free == other.free).all()
    assert one.sha256 != other.sha256
    assert (random_world(11, 16, ThreatPattern(seed=9)).free != one.free).any()


def test_worlds_share_no_stream_with_the_rollouts_of_their_seed() -> None:
    seed = 2**40 + 3
    rollouts, _ = threefry2x32(key_of(seed), np.arange(64), 0)
    world = Stream(seed, OBSTACLES).words(64) & np.uint64(0xFFFFFFFF)
    assert not (rollouts == world).any()


def test_below_is_uniform() -> None:
    stream, draws, bound = Stream(1, 7), 21_000, 7
    counts = np.bincount([stream.below(bound) for _ in range(draws)], minlength=bound)
    spread = np.sqrt(draws * (1 / bound) * (1 - 1 / bound))
    assert len(counts) == bound
    assert np.abs(counts - draws / bound).max() < 5 * spread


def test_sampled_cells_are_different_and_uniform() -> None:
    hits = np.zeros(30)
    for seed in range(400):
        chosen = Stream(seed, OBSTACLES).sample(10, 30)
        assert len(set(chosen.tolist())) == 10
        hits[chosen] += 1
    assert np.abs(hits - 400 / 3).max() < 5 * np.sqrt(400 * 1 / 3 * 2 / 3)


@pytest.mark.parametrize(
    ("pattern", "options", "names"),
    [
        (ThreatPattern(kind="round"), {}, "'round'"),  # type: ignore[arg-type]
        (ThreatPattern(areas=0), {}, "areas=0"),
        (ThreatPattern(levels=()), {}, "levels"),
        (ThreatPattern(levels=(0.1, 1.0)), {}, "levels"),
        (ThreatPattern(levels=(float("nan"),)), {}, "levels"),
        (ThreatPattern(levels=(1e-60,)), {}, "expected probabilities 1e-30 <= p < 1"),
        (ThreatPattern(levels=(1e300,)), {}, "levels"),
        (ThreatPattern(seed=-1), {}, "seed=-1"),
        (ThreatPattern(seed=2**64), {}, "seed"),
        (ThreatPattern(), {"threats": 0.8}, "320 threats"),
        (ThreatPattern(), {"obstacles": 1.0, "threats": 0.0}, "400 obstacles"),
        (ThreatPattern(), {"obstacles": -0.1}, "obstacles=-0.1"),
        (ThreatPattern(), {"threats": float("nan")}, "threats=nan"),
        (ThreatPattern(), {"height": 0}, "0 x 20"),
        (ThreatPattern(), {"height": 10**6, "width": 10**6}, "1000000 x 1000000"),
    ],
)
def test_worlds_that_cannot_be(pattern: ThreatPattern, options: dict, names: str) -> None:
    with pytest.raises(WorldError) as caught:
        random_world(pattern=pattern, **options)
    assert names in str(caught.value)


def test_a_large_map_takes_no_time() -> None:
    start = time.perf_counter()
    world = random_world(256, 256, ThreatPattern(seed=2), obstacles=0.28)
    assert (world.threat > 0).sum() == 16384
    assert time.perf_counter() - start < 5


def test_more_areas_than_cells_are_refused_but_never_the_default() -> None:
    with pytest.raises(WorldError, match="401 areas on 400 cells"):
        random_world(pattern=ThreatPattern(areas=401))
    assert (random_world(20, 20, ThreatPattern(areas=400)).threat > 0).sum() == 100
    assert (random_world(2, 2).threat > 0).sum() == 1
    assert (random_world(pattern=ThreatPattern("scattered", areas=401)).threat > 0).sum() == 100
