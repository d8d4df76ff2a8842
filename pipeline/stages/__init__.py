"""What each stage of the loop does, given the config, its own folder and its parents' folders."""

from pipeline.stages.gathering import collect, deploy
from pipeline.stages.learning import clone, imitation, judge, rl, state, tokenizer, vision
from pipeline.stages.proof import evaluate_imagined, evaluate_physics, gap, measure, report, videos

__all__ = [
    "clone",
    "collect",
    "deploy",
    "evaluate_imagined",
    "evaluate_physics",
    "gap",
    "imitation",
    "judge",
    "measure",
    "report",
    "rl",
    "state",
    "tokenizer",
    "videos",
    "vision",
]
