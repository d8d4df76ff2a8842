"""The one sentence that the figures of a finished run come to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.evaluation.statistics import percent_line, rise

IMAGINED = "evaluate-imagined"  # the stage that judges imagined episodes of the policy before and after
_BLIND = 0.3  # imagined minus true success from which on imagination says nothing of the truth
_CHANCE = 0.05  # below it a difference is more than that


def verdict(result: Mapping[str, Any]) -> str:
    """One sentence: gain or none, and in the latter case what the figures say of why."""
    imagined = _points(result, "imagined")
    if result["physics_before"] is None:
        if imagined is None:
            return f"nobody knows whether the policy is better: {_no_judgement(result)}"
        return (
            f"imagined success moved by {imagined:+.1f} points; without physics nobody knows what that is"
            " worth: try the policy on the robot"
        )
    points = _points(result, "physics")
    if points is None:
        return (
            "nobody knows whether the policy is better: no evaluation episode in physics could be counted;"
            " mend the task's suite (task.suite) or evaluate on more episodes (evaluate.episodes)"
        )
    before, after, paired = result["physics_before"], result["physics_after"], result["paired"]
    head = (
        f"true success {before['successes']}/{before['episodes']} -> {after['successes']}/{after['episodes']}"
        f" ({points:+.1f} points, McNemar p = {paired['p']:.2g})"
    )
    if points > 0 and paired["p"] < 0.01:
        return f"gain: {head}"
    return f"no gain: {head}. {_why(result, points, imagined)}"


def _points(result: Mapping[str, Any], where: str) -> float | None:
    """By how many points success in `where`, physics or imagined, rose; None where nobody knows."""
    share = rise(result[f"{where}_before"], result[f"{where}_after"])
    return None if share is None else 100 * share


def _no_judgement(result: Mapping[str, Any]) -> str:
    """That imagination was not judged at all, and what to do."""
    said = [text for text in result["alarms"] if text.startswith(IMAGINED)]
    return (
        said[0] if said else f"{IMAGINED}: the judge judged no imagined episode; choose another (judge=...)"
    )


def _why(result: Mapping[str, Any], points: float, imagined: float | None) -> str:
    """What the figures say of why true success did not rise by enough."""
    if imagined is None:
        return f"What imagined success did is not known: {_no_judgement(result)}"
    gap = result["rounds"][-1]["gap"] if result["rounds"] else None
    if min(points, imagined) > 0 and imagined - points < 5:
        return (
            f"true success rose as imagined success did ({imagined:+.0f} points), but too little to tell from"
            " chance; give RL more iterations (rounds.iterations) or evaluate on more episodes"
        )
    if imagined > 5:
        rose = (
            f"imagined success rose by {imagined:.0f} points to {percent_line(result['imagined_after'], 0)},"
            " and true success did not follow"
        )
        if (rise(result["physics_after"], result["imagined_after"]) or 0.0) > 0:
            return f"{rose}: the policy exploits the simulator; deploy more episodes per round"
        return (
            f"{rose}, which is higher: the imagined world is too bleak, and RL may have learned what it alone"
            " asks for; see by the judge's table whether simulator or judge misses successes, and train it"
            " longer"
        )
    if gap is not None and gap > _BLIND:
        true, predicted = (percent_line(result["rounds"][-1][key], 0) for key in ("true", "imagined"))
        return (
            f"the imagined world is no guide: in the last round it says {predicted} of a policy that"
            f" succeeds in {true}, so RL has little to learn from; see by `worldloop trust` and"
            " the judge's table whether simulator or judge mistakes failures for successes, and train it"
            " longer"
        )
    tried = ("physics_before", "physics_after", "imagined_before", "imagined_after")
    if not any(result[key]["successes"] for key in tried):
        return (
            "no policy succeeded even once, in truth or in imagination, so RL had nothing to go on; give"
            " imitation more demonstrations (imitation.demos) or steps (imitation.fit.steps)"
        )
    alarms = [text for text in result["alarms"] if text.startswith("rl-")]
    if imagined > -2 and alarms:
        return f"RL did not improve even imagined success; {alarms[0]}"
    if points < 0 and result["paired"]["p"] < _CHANCE:
        return (
            f"the policy got worse, and imagined success moved by {imagined:+.0f} points only: RL followed"
            " noise or forgot; give it shorter steps (rl.lr), more episodes an iteration (rl.envs) or a"
            " stronger hold on what worked (rl.anchor), and look whether cloning did it (rounds.clone=0)"
        )
    return (
        f"RL moved imagined success by {imagined:+.0f} points only; give it more iterations"
        " (rounds.iterations) or a higher rl.lr"
    )
