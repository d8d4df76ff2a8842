"""What each stage of the loop does, given the config, its own folder and its parents' folders."""

from pipeline.work.gathering import collect, deploy
from pipeline.work.learning import clone, imitation, judge, rl, state, tokenizer, vision
from pipeline.work.proof import evaluate_imagined, evaluate_physics, gap, measure, report, videos

__all__ = ["clone", "collect", "deploy", "evaluate_imagined", "evaluate_physics", "gap", "imitation", "judge", "measure", "report", "rl", "state", "tokenizer", "videos", "vision"]
