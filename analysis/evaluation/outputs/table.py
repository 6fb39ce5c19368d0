"""The outputs of `evaluate` by the key that they are asked for with, in the order in which they are measured."""

from __future__ import annotations

from analysis.evaluation.outputs.advice import Advice
from analysis.evaluation.outputs.band import Band
from analysis.evaluation.outputs.deadline import Deadline
from analysis.evaluation.outputs.experience import Experience
from analysis.evaluation.outputs.knowledge import Knowledge
from analysis.evaluation.outputs.map_doubt import MapDoubt
from analysis.evaluation.outputs.output import Output
from analysis.evaluation.outputs.team import Mates
from analysis.evaluation.outputs.threat_scale import ThreatScale
from analysis.evaluation.outputs.turning import Turning
from analysis.evaluation.outputs.value import Value

OUTPUTS: dict[str, type[Output]] = {
    "threat_scale": ThreatScale,
    "deadline": Deadline,
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
