"""Judges: from video and an instruction to success and progress."""

from envs.judges.base import Judge, Judgement, MissingFeatures
from envs.judges.learned import LearnedJudge
from envs.judges.rule import RuleJudge

__all__ = ["Judge", "LearnedJudge", "RuleJudge", "Judgement", "MissingFeatures"]
