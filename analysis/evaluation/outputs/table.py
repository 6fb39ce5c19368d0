"""The outputs of `evaluate` by the key that they are asked for with, in the order in which they are measured."""

from __future__ import annotations

from analysis.evaluation.outputs.advice import Advice
from analysis.evaluation.outputs.information import Experience, Knowledge
from analysis.evaluation.outputs.output import Output
from analysis.evaluation.outputs.over_time import Band, Deadline, Turning
from analysis.evaluation.outputs.value import Value
from analysis.evaluation.outputs.what_if import MapDoubt, Mates, ThreatScale

OUTPUTS: dict[str, type[Output]] = {
    "deadline": Deadline,
    "threat_scale": ThreatScale,
    "value": Value,
    "turn": Turning,
    "band": Band,
    "knowledge": Knowledge,
    "experience": Experience,
    "team": Mates,
    "map_doubt": MapDoubt,
    "advice": Advice,
}
"""The key is that of `Evaluation.outputs` and of the JSON object too."""
