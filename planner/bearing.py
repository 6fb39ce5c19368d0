"""What robots bear before they stop (SPEC section 14): how they wear, and how much exposure counts on each of them.

Simulators know neither. A robot is stopped once its exposure reaches its tolerance, and both say what tolerances are;
asked the other way round, which Exp(1) tolerances an exposure reaches (`fresh`), sets of rollouts part as before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import argument, check_each
from planner.errors import UsageError
from planner.luck_names import LuckName
from planner.tolerance import MOST, SCALE, susceptible, tolerances, unworn, wear_nodes, wear_scale, worn

Susceptibility = float | tuple[float, ...]


@dataclass(frozen=True)
class Bearing:
    """What a team bears.

    Attributes:
        shape: of its Weibull tolerances of mean 1 nat; 1: exponential, nothing wears out.
        susceptibility: how many times exposure counts, one number for all robots or one each.
        begun: the exposure that each robot is known to have borne before rollouts begin, in units of 2**-32 nat; none:
            it does not matter.
        types: of robots, whose maps differ (`World.of_robots`); None: there is one map.
    """

    shape: float = 1.0
    susceptibility: Susceptibility = 1.0
    begun: tuple[int, ...] = ()
    types: str | tuple[str, ...] | None = None

    @property
    def is_plain(self) -> bool:
        """True where the chance of each visit is the map's p, whoever makes it and whatever came before."""
        return self.is_even and self.types is None

    @property
    def is_even(self) -> bool:
        """True where it is p of the robot's own map."""
        return self.shape == 1 and bool((np.asarray(self.susceptibility) == 1).all())

    @property
    def said(self) -> str:
        """What is not plain of it, in words; "" where all is."""
        wear = f"robots that wear (shape {self.shape:g})" if self.shape != 1 else ""
        numbers = np.unique(np.asarray(self.susceptibility, dtype=np.float64))
        least, most = f"{numbers[0]:g}", f"{numbers[-1]:g}"
        between = least if least == most else f"{least} to {most}"
        count = f"exposure that counts {between}-fold" if (numbers != 1).any() else ""
        names = (self.types,) if isinstance(self.types, str) else dict.fromkeys(self.types or ())
        kinds = f"robots of type {' and '.join(names)}" if names else ""
        return " and ".join(filter(None, (wear, count, kinds)))

    def to_json(self) -> dict[str, Any]:
        """What is not the default of it, as plan files hold it."""
        of = self.susceptibility
        wear = {} if self.shape == 1 else {"wear": self.shape}
        kinds = {} if self.types is None else {"types": self.types}
        return wear | kinds | ({} if of == 1 else {"susceptibility": list(of) if isinstance(of, tuple) else of})

    def check(self, robots: int, source: str = "") -> None:
        """Raise PlanError where it is of another team."""
        check_each("susceptibility", self.susceptibility, robots, source)

    def check_luck(self, luck: LuckName) -> None:
        """Raise UsageError for luck that does not know what robots have borne."""
        if luck != "tolerance" and not self.is_even:
            raise UsageError(
                f"{self.said}, with {argument('luck', luck)}",
                expected="luck that knows what each robot has borne",
                fix=f"use {argument('luck', 'tolerance')}",
            )

    def check_known(self, what: str) -> None:
        """Raise UsageError where `what` presumes that every visit of a cell stops any robot with the chance p."""
        if not self.is_plain:
            problem = f"{what} presumes that each visit stops any robot with the map's p; here: {self.said}"
            named = ("wear", "susceptibility") if self.types is None else ("wear", "susceptibility", "types")
            raise UsageError(problem, fix=f"leave {' and '.join(map(argument, named))} out")

    def times(self, robots: int) -> NDArray[np.int64]:
        """Susceptibility of each robot `[K]`, in units of 1 / SCALE."""
        given = self.susceptibility[:robots] if isinstance(self.susceptibility, tuple) else self.susceptibility
        return np.broadcast_to(np.rint(np.asarray(given, dtype=np.float64) * SCALE).astype(np.int64), robots)

    @property
    def nodes(self) -> NDArray[np.int64]:
        """`planner.tolerance.wear_nodes`."""
        return wear_nodes(float(self.shape))

    def fresh(self, exposure: NDArray[np.int64], robot: int) -> NDArray[np.int64]:
        """The largest Exp(1) tolerances that such exposures `[..]` of the robot reach; 0: none."""
        return np.asarray(unworn(exposure, self.nodes, self.times(robot + 1)[robot]))

    def fresh_begun(self, robots: int) -> NDArray[np.int64]:
        """The same of what each robot `[K]` is known to have borne."""
        if not self.begun:
            return np.zeros(robots, dtype=np.int64)
        return np.asarray(unworn(np.array(self.begun[:robots]), self.nodes, self.times(robots)))

    def most(self, robots: int) -> NDArray[np.int64]:
        """The largest exposure after which any luck leaves each robot `[K]` alive."""
        largest = worn(MOST, self.shape)
        return np.array([susceptible(largest, times / SCALE) - 1 for times in self.times(robots).tolist()])

    def tolerances(self, seed: int, rollouts: ArrayLike, robots: int) -> NDArray[np.int64]:
        """What each robot still bears in each rollout, int64 `[B, K]`, beyond what it is known to have borne."""
        drawn, begun = tolerances(seed, rollouts, robots), self.fresh_begun(robots)
        if self.is_even:
            return drawn
        ones = [
            susceptible(worn(drawn[:, one] + begun[one], self.shape), times / SCALE)
            for one, times in enumerate(self.times(robots).tolist())
        ]
        return np.stack(ones, axis=1) - np.array(self.begun[:robots] or [0] * robots)

    def survival(self, exposure: NDArray[np.float64], robot: int) -> NDArray[np.float64]:
        """The chance to bear these exposures (nat), `exp(-(a E / s) ** B)`; from what was borne before on."""
        times, power = self.times(robot + 1)[robot] / SCALE, float(self.shape)

        def nats(borne: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray((times * borne / wear_scale(power)) ** power)

        begun = np.array(self.begun[robot] * 2.0**-32 if self.begun else 0.0)
        return np.asarray(np.exp(nats(begun) - nats(begun + exposure)))

    def first_chance(self, chance: float, robot: int = 0) -> float:
        """F(e): that a visit of threat `chance` stops a fresh robot."""
        return 1.0 - float(self.survival(-np.log1p(-np.array(min(chance, 1 - 1e-12))), robot))


PLAIN = Bearing()
