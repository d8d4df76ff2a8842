"""Judges: from video and an instruction to success and progress."""

from envs.judges.base import Judge, Verdict
from envs.judges.learned import LearnedJudge
from envs.judges.rule import RuleJudge

__all__ = ["Judge", "LearnedJudge", "RuleJudge", "Verdict"]
