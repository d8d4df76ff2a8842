"""Meta-World's tasks in words; it has names alone."""

from __future__ import annotations

# Names that do not read as thing, verb, manner.
_INSTRUCTIONS = {
    "assembly": "put the ring onto the peg",
    "basketball": "put the ball into the basket",
    "bin-picking": "move the puck to the other bin",
    "coffee-button": "press the button of the coffee machine",
    "coffee-pull": "pull the mug away from the coffee machine",
    "coffee-push": "push the mug under the coffee machine",
    "disassemble": "take the ring off the peg",
    "hammer": "hammer the nail into the wall",
    "hand-insert": "put the gripper into the hole",
    "peg-unplug-side": "unplug the peg sideways",
    "pick-out-of-hole": "pick the puck out of the hole",
    "pick-place": "pick up the puck and bring it to the goal",
    "pick-place-wall": "pick up the puck and bring it over the wall to the goal",
    "push": "push the puck to the goal",
    "push-back": "push the puck back to the goal",
    "push-wall": "push the puck around the wall to the goal",
    "reach": "reach the goal",
    "reach-wall": "reach the goal over the wall",
    "shelf-place": "place the block on the shelf",
    "soccer": "kick the ball into the goal",
    "stick-pull": "pull the thermos with the stick",
    "stick-push": "push the thermos with the stick",
    "sweep": "sweep the puck off the table",
    "sweep-into": "sweep the puck into the hole",
}
_MANNERS = {"topdown": "from above", "wall": "behind the wall", "side": "sideways", "back": "back"}


def instruction_of(task: str) -> str:
    """A task's name as words: 'drawer-open-v3' is 'open the drawer'."""
    name = task.rsplit("-v", 1)[0]
    if name in _INSTRUCTIONS:
        return _INSTRUCTIONS[name]
    thing, verb, *manner = name.split("-")
    return " ".join([verb, "the", thing, *(_MANNERS[word] for word in manner)])
