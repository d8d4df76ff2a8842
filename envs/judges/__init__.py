"""Judges: from video and an instruction to success and progress."""

from envs.judges.base import Judge, JudgeError, Judgement, MissingFeatures
from envs.judges.learned import LearnedJudge
from envs.judges.rule import RuleJudge

__all__ = ["Judge", "JudgeError", "LearnedJudge", "RuleJudge", "Judgement", "MissingFeatures"]
