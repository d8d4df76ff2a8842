"""Who says "done": a learned judge over video, and the rule judge that knows the truth."""

from envs.judges.base import Judge, Verdict
from envs.judges.learned import LearnedJudge
from envs.judges.rule import RuleJudge

__all__ = ["Judge", "LearnedJudge", "RuleJudge", "Verdict"]
