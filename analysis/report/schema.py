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
    "check_paper": "analysis.reproduction:Reproduction",
    "check_worlds": "analysis.checking.check:Survey",
    "compare": "analysis.comparison:Comparison",
    "debrief": "analysis.debrief:Debrief",
    "evaluate": "analysis.evaluation.evaluate:Evaluation",
    "front": "analysis.search.pareto:Front",
    "inspect": "analysis.recording.replay:Inspection",
    "inspect_repair": "analysis.recording.container:Recovered",
    "inspect_replay": "analysis.recording.replay:Replayed",
    "judge": "analysis.policy_evaluation.policy_evaluation:PolicyEvaluation",
    "record": "analysis.recording.record:Recorded",
    "results": "analysis.sweeps.results:Results",
    "size": "analysis.search.team_size:TeamSize",
    "starts": "analysis.search.start_positions:Starts",
    "suite": "analysis.policy_evaluation.leaderboard:Leaderboard",
    "sweep": "analysis.sweeps.sweep:Sweep",
    "threats_add": "analysis.search.threats:Attack",
    "threats_remove": "analysis.search.threats:Clearing",
}
"""The class of each command's result, as "module:class"."""


def schema() -> Json:
    """The JSON Schema (draft 2020-12): `$defs` by class; `commands`, the definition of each command's result."""
    found = Schema()
    commands = {command: found.of(resolve_name(place)) for command, place in RESULTS.items()}
    # Each output of `evaluate` adds its key.
    outputs = resolve_name("analysis.evaluation.evaluate:OUTPUTS")
    added = {name: found.of(output) for name, output in outputs.items()}
    found.definitions["evaluate.Evaluation"]["properties"] |= added
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
