"""Commands that say how far an imagined world can be trusted; their options are sections of the config."""

from __future__ import annotations

from pipeline.cli.words import Words, prepared


def policy_value(words: Words) -> None:
    """values of policies in an imagined world beside their true ones: worldloop policy-value experiment=...
    [policy_value.policies=[rl-1,rl-2]] [policy_value.starts=32] [imagined.simulator=<stage|folder>]
    """
    cfg, root = prepared(words)
    from pipeline.commands.worlds.policy_value import policy_value as estimate
    from pipeline.graph.owner import owning

    with owning(root, "policy-value"):
        print(estimate(cfg, root))
    print(f"{root}/policy-value.html, {root}/policy-value.json")


def fidelity(words: Words) -> None:
    """generated against true video under recorded actions, long rollouts, and options at inference: worldloop
    fidelity experiment=... [fidelity.masks=FILE] [fidelity.grid={simulator.<option>:[1,2]}]
    """
    cfg, root = prepared(words)
    from pipeline.commands.worlds.fidelity import fidelity as measure
    from pipeline.graph.owner import owning

    with owning(root, "fidelity"):
        print(measure(cfg, root))
    print(f"{root}/fidelity.html, {root}/fidelity.json")


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
