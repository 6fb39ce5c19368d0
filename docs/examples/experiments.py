"""Experiments in addition to the paper's: `python docs/examples/experiments.py policies|online|moving --out FOLDER`.

policies: coverage of other policies than the paper's; online: the value of the map; moving: moving threats. A quarter
of an hour each on two cores; fewer `--maps` and `--rollouts` are faster.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from information_value import study_knowing
from policies_study import study_policies

from analysis.sweeps.store import Store

ROLLOUTS = {"policies": 200, "online": 10, "moving": 40}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("experiment", choices=ROLLOUTS)
    parser.add_argument("--maps", type=int, default=500, help="random maps per setting")
    parser.add_argument("--rollouts", type=int, help=f"per map (default: {ROLLOUTS})")
    parser.add_argument("--seed", type=int, default=0, help="of the first map and its rollouts")
    parser.add_argument("--processes", type=int, help="default: one per core")
    parser.add_argument("--out", type=Path, help="folder for the page, pictures, JSON and CSV")
    parser.add_argument("--store", type=Path, help="keep results in this file, and reuse those that it has")
    asked = parser.parse_args()
    how: dict[str, Any] = {"maps": asked.maps, "seed": asked.seed, "processes": asked.processes}
    how["rollouts"] = asked.rollouts or ROLLOUTS[asked.experiment]
    with nullcontext() if asked.store is None else Store.open(asked.store) as store:
        if asked.experiment == "policies":
            answer = study_policies(**how, store=store)
        else:
            answer = study_knowing(asked.experiment, **how, store=store)
    sys.stdout.write(f"{answer}\n")
    if asked.out is not None:
        answer.save(asked.out, force=True)


if __name__ == "__main__":
    main()
