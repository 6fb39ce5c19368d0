"""The JSON Schema of all results, `schema.json` in this package; `python -m analysis.report.schema` writes it anew."""

from __future__ import annotations

from pathlib import Path
from pkgutil import resolve_name

from analysis.report.result import FORMAT
from analysis.utils.tables import json_text
from planner.files import Json
from planner.json_objects import Schema

FILE = Path(__file__).with_name("schema.json")
RESULTS = {
    "check": "analysis.checking.check:MapCheck",
    "check_worlds": "analysis.checking.check:Survey",
    "compare": "analysis.comparison:Comparison",
    "debrief": "analysis.debrief:Debrief",
    "evaluate": "analysis.evaluation.evaluate:Evaluation",
    "front": "analysis.search.pareto:Front",
    "judge": "analysis.policy_evaluation.policy_evaluation:PolicyEvaluation",
    "size": "analysis.search.team_size:TeamSize",
    "starts": "analysis.search.start_positions:Starts",
    "suite": "analysis.policy_evaluation.leaderboard:Leaderboard",
    "threats_add": "analysis.search.threats:Attack",
    "threats_remove": "analysis.search.threats:Clearing",
}
"""The class of each command's result, as "module:class"."""


def schema() -> Json:
    """The JSON Schema (draft 2020-12): `$defs` by class; `commands`, the definition of each command's result."""
    found = Schema()
    commands = {command: found.of(resolve_name(place)) for command, place in RESULTS.items()}
    # Each output of `evaluate` adds its key.
    evaluation, outputs = (
        found.definitions["evaluate.Evaluation"],
        resolve_name("analysis.evaluation.evaluate:OUTPUTS"),
    )
    evaluation["properties"] |= {name: found.of(output) for name, output in outputs.items()}
    about = (
        f"JSON objects of mrac-jax, format {FORMAT}. Fractions are not percent. Times are steps; where the length of a "
        "step is known, each time also has a key with the suffix _minutes, and step_seconds is its length in seconds. "
        "A value that is not known is null."
    )
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Results of mrac-jax",
        "description": about,
        "commands": commands,
        "$defs": dict(sorted(found.definitions.items())),
    }


if __name__ == "__main__":
    FILE.write_text(json_text(schema()), encoding="utf-8")
