"""Commands that say how far an imagined world can be trusted; their options are sections of the config, or
words of their own.
"""

from __future__ import annotations

from envs.targets import ConfigError, nearest
from pipeline.cli.words import Words, listed, prepared, without_given


def policy_value(words: Words) -> None:
    """values of policies in an imagined world beside their true ones: worldloop policy-value experiment=...
    [policy_value.policies=[rl-1,rl-2]] [policy_value.starts=32] [imagined.simulator=<stage|folder>]
    """
    cfg, root = prepared(words)
    from pipeline.commands.worlds.policy_value import policy_value as estimate
    from pipeline.graph.owner import owning

    with owning(root, "policy-value"):
        print(estimate(cfg, root))


def fidelity(words: Words) -> None:
    """generated against true video under recorded actions, long rollouts, and options at inference: worldloop
    fidelity experiment=... [fidelity.masks=FILE] [fidelity.grid={simulator.<option>:[1,2]}]
    """
    cfg, root = prepared(words)
    from pipeline.commands.worlds.fidelity import fidelity as measure
    from pipeline.graph.owner import owning

    with owning(root, "fidelity"):
        print(measure(cfg, root))


def ewmbench(words: Words) -> None:
    """scene consistency, trajectories of grippers, semantics and diversity of generated video, as in
    EWMBench: worldloop ewmbench experiment=... [ewmbench.samples=3] [ewmbench.strict_parity=true] [judge=vlm]
    """
    cfg, root = prepared(words)
    from pipeline.commands.worlds.ewmbench import ewmbench as measure
    from pipeline.graph.owner import owning

    with owning(root, "ewmbench"):
        print(measure(cfg, root))


def summary(words: Words) -> None:
    """one page of a simulator, of what fidelity, ewmbench and policy-value measured: worldloop summary
    experiment=... [name=<run>]
    """
    from pipeline.cli.words import root_of
    from pipeline.config import load_config

    cfg = load_config(words)
    from pipeline.commands.worlds.summary import summary as joined

    print(joined(cfg, root_of(cfg)))


def evaluate_simulator(name: str, words: Words) -> None:
    """All that is measured of a simulator without policies, and its page.

    Args:
        name: a stage of the run or a folder with weights, as imagined.simulator; "" is the run's last.
        words: what else was said.
    """
    words = [*words, f"imagined.simulator={name}"] if name else words
    for measure in (fidelity, ewmbench, summary):
        measure(words)


def sweep(words: Words) -> None:
    """move one number of the action at a time and draw what is imagined: worldloop sweep experiment=...
    [sweep.episode=0] [sweep.levels=[-2,2]]
    """
    cfg, root = prepared(words)
    from pipeline.commands.worlds.sweep import sweep as draw
    from pipeline.graph.owner import owning

    with owning(root, "sweep"):
        for path in draw(cfg, root):
            print(path)


def rewards(words: Words) -> None:
    """rewards side by side along the same episodes of seen and unseen scenes: worldloop rewards
    [rewards=[learned,proxy,embedding,golden_goal,rule]] [episodes=64] [variants=[out_of_domain]]
    experiment=...
    """
    from pipeline.config import choices, load_config, read_config

    own, rest = {"rewards": "learned,proxy,embedding,golden_goal,rule", "episodes": "64", "variants": ""}, []
    for word in words:
        key, _, value = word.partition("=")
        if key in own:
            own[key] = value
        else:
            rest.append(word)
    names, known = listed(own["rewards"]), ["rule", *choices("judge", rest)]
    for name in names:
        if name not in known:
            raise ConfigError(f"rewards={own['rewards']}: no reward {name}{nearest(name, known)}")
    if not own["episodes"].isdigit() or int(own["episodes"]) < 2 or not names:
        raise ConfigError("say which rewards=[...], and episodes=N of at least 2")
    cfg, root = prepared(rest)
    from actors.world_config import check_world
    from pipeline.commands.worlds.rewards import Plan, compare_rewards
    from pipeline.graph.owner import owning
    from pipeline.loop import has_physics
    from pipeline.track import tracking

    if not has_physics(cfg) and not any(word.startswith("rewards=") for word in words):
        names.remove("rule")  # which asks physics
    others = [word for word in rest if not word.lstrip("+~").startswith(("judge=", "judge."))]
    # What judge.<option> says is said of the run's own judge; two choices may share a class.
    chosen = read_config([word for word in rest if not word.lstrip("+~").startswith("judge.")])["judge"]
    configs = {}
    for name in (name for name in names if name != "rule"):
        asked = [*others, f"judge={name}"]
        configs[name] = cfg if read_config(asked)["judge"] == chosen else load_config(asked)
    for own_cfg in configs.values():  # what the others need is told before any work, too
        check_world(own_cfg)
    if "rule" in names:
        configs["rule"] = cfg
    variants = listed(own["variants"]) if own["variants"] else list(cfg["task"].get("variants", {}))
    with owning(root, "rewards"), tracking(cfg, root) as tracker:
        print(compare_rewards(cfg, root, Plan(configs, int(own["episodes"]), variants), tracker))
    print(f"{root}/rewards.html, {root}/rewards.json")


def gridworld(words: Words) -> None:
    """how actions should be told to a world, by squares that move as they are told: worldloop gridworld
    experiment=gridworld [squares=1,3]
    """
    own = [word.removeprefix("squares=") for word in words if word.startswith("squares=")]
    counts = (own[-1] if own else "1,3").split(",")
    if not all(count.isdigit() and int(count) for count in counts):
        raise ConfigError(f"squares={own[-1]}: say whole numbers above 0, as in squares=1,3")
    rest = [word for word in words if not word.startswith("squares=")]
    cfg, root = prepared([*without_given(["experiment=gridworld"], rest), *rest])
    from pipeline.commands.worlds.gridworld import gridworld as study
    from pipeline.graph.owner import owning
    from pipeline.track import tracking

    with owning(root, "gridworld"), tracking(cfg, root) as tracker:
        print(study(cfg, root, [int(count) for count in counts], tracker))
