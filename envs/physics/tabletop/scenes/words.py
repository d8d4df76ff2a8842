"""What is said to the robot: each task in several phrasings, in which the object and the goal are named."""

from __future__ import annotations

PHRASINGS: dict[str, dict[str, str]] = {
    "push": {
        "plain": "push the {thing} forward",
        "polite": "please push the {thing} forward, away from you",
        "brief": "{thing} forward",
        "synonym": "shove the {thing} ahead",
        "purpose": "the {thing} should stand further forward",
        "colloquial": "give the {thing} a push away from yourself",
        "inverted": "forward is where the {thing} must be pushed",
    },
    "pull": {
        "plain": "pull the {thing} back",
        "polite": "please pull the {thing} back, towards you",
        "brief": "{thing} back",
        "synonym": "drag the {thing} backwards",
        "purpose": "the {thing} should stand further back",
        "colloquial": "get the {thing} a bit nearer to yourself",
        "inverted": "back is where the {thing} must be pulled",
    },
    "pick_place": {
        "plain": "pick up the {thing} and place it in the {goal}",
        "polite": "please put the {thing} into the {goal}",
        "brief": "{thing} into {goal}",
        "synonym": "drop the {thing} into the {goal}",
        "purpose": "the {thing} should lie in the {goal}",
        "colloquial": "pop the {thing} in the {goal} for me",
        "inverted": "into the {goal} is where the {thing} goes",
    },
    "move_to_aim": {
        "plain": "move the {thing} onto the {goal}",
        "polite": "please set the {thing} down on the {goal}",
        "brief": "{thing} onto {goal}",
        "synonym": "bring the {thing} to the {goal}",
        "purpose": "the {thing} should stand on the {goal}",
        "colloquial": "get the {thing} over on the {goal} for me",
        "inverted": "onto the {goal} is where the {thing} goes",
    },
    "carry": {
        "plain": "carry the {thing} over the {goal} with both hands",
        "polite": "please hold the {thing} above the {goal} with both hands",
        "brief": "{thing} over {goal}, both hands",
        "synonym": "lift the {thing} above the {goal} using both arms",
        "purpose": "both hands should hold the {thing} over the {goal}",
        "colloquial": "take the {thing} up over the {goal}, two hands",
        "inverted": "over the {goal} is where both hands hold the {thing}",
    },
}
STYLES = tuple(PHRASINGS["push"])


def instruction(task: str, style: str, thing: str, goal: str) -> str:
    """The words for an episode."""
    return PHRASINGS[task][style].format(thing=thing, goal=goal)
