"""A chain's values by the model checker Storm: an oracle that nobody here wrote (extra `oracle`, GPL-3, tests only)."""

from __future__ import annotations

import tempfile
from fractions import Fraction
from pathlib import Path

from oracle_markov import REWARDS, Chain, ChainValues, write_drn
from oracle_tree import OUTCOMES, Chance


def storm_values(chain: Chain) -> ChainValues:
    """The expected values of the chain: Fractions of an exact one, else floats (Storm's sound methods).

    Raises ImportError without stormpy 2.
    """
    import stormpy

    exact = isinstance(chain.rewards[0][0], Fraction)
    build = stormpy.build_model_from_drn[stormpy.Rational] if exact else stormpy.build_model_from_drn
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "chain.drn"
        write_drn(chain, file)
        model = build(str(file))

    def value(formula: str) -> Chance:
        (asked,) = stormpy.parse_properties(formula)
        found = stormpy.model_checking(model, asked).get_value(model.initial_states[0])
        return Fraction(str(found)) if exact else float(found)

    visited, survived, time, lost = (value(f'R{{"{reward}"}}=? [F "over"]') for reward in REWARDS)
    chances = (value(f'P=? [F "{outcome}"]') for outcome in OUTCOMES)
    return ChainValues(visited, survived, time, chain.robots - lost, *chances)
