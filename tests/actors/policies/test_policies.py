"""Conformance: what every policy that configs offer does, for every robot."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from actors.policies.chunk_tokens import ChunkTokens
from actors.policies.contract import (
    VISUAL_FEATURES,
    action_key,
    distribution,
    imitation_loss,
    input_keys,
    inputs_for,
    rl_rate,
    trained_part,
    with_text,
    writes_features,
)
from actors.policies.safe import SafePolicyWrapper
from envs.embodiment import Embodiment
from envs.specs import (
    CHUNK,
    COMMAND,
    IMAGE,
    INSTRUCTION,
    INSTRUCTION_UTF8,
    INVALID_ACTION,
    LOG_PROB,
    STATE,
    ActionMode,
    WorldSpec,
    bytes_to_text,
)
from envs.targets import ConfigError, build
from tests.embodiments import ARM_DELTAS, ARM_JOINTS, BIMANUAL_POSES, EMBODIMENTS, observations, world_spec
from tests.sections import offered, section

SMALL: dict[str, dict[str, Any]] = {
    "chunk_gaussian": {"width": 32},
    "chunk_tokens": {
        "width": 32,
        "instruction_keypoints": 3,
        "channels": 8,
    },  # with an encoder that is told what is asked for
}
POLICIES = [name for name in offered("policy") if name != "openpi"]  # that one needs a server
MAIN_VIEW_ALONE = ("tiny_vla",)  # all others look at every view


def policy_of(name: str, spec: WorldSpec, mode: str = "relative") -> TensorDictModuleBase:
    """A policy of configs/policy, with the same weights every time."""
    torch.manual_seed(0)
    chosen = section(f"policy/{name}", mode, **SMALL.get(name, {}))
    policy: TensorDictModuleBase = build(chosen, "policy", spec=spec)
    return policy


def acted(policy: TensorDictModuleBase, spec: WorldSpec, mode: ActionMode, batch: int = 4) -> TensorDict:
    """Random observations and what a policy writes there, sampling."""
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        return SafePolicyWrapper(policy, spec, mode)(observations(spec, batch))


@pytest.mark.parametrize("robot", EMBODIMENTS.values(), ids=list(EMBODIMENTS))
@pytest.mark.parametrize("name", POLICIES)
def test_writes_chunks_of_the_robot_and_scores_them_as_written(name: str, robot: Embodiment) -> None:
    spec = world_spec(robot)
    policy = policy_of(name, spec)
    out = acted(policy, spec, ActionMode.ABSOLUTE)
    assert out[CHUNK].shape == (4, spec.chunk, spec.action_dim) and out[CHUNK].dtype == torch.float32
    assert not bool(out[INVALID_ACTION].any())
    scored = distribution(trained_part(policy), out).log_prob(out[action_key(policy)])
    assert torch.allclose(scored, out[LOG_PROB], atol=1e-4)
    assert float(out[CHUNK].std(0).max()) > 0  # it explores
    again = acted(policy, spec, ActionMode.ABSOLUTE)
    assert not torch.equal(again[CHUNK], out[CHUNK])
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        wrapper = SafePolicyWrapper(policy, spec, ActionMode.ABSOLUTE)
        one, two = (wrapper(observations(spec, 4))[CHUNK] for _ in range(2))
    assert torch.equal(one, two)


@pytest.mark.parametrize("name", [name for name in POLICIES if name.startswith("chunk_")])
def test_explores_more_narrowly_around_the_same_mode(name: str) -> None:
    spec = world_spec(ARM_DELTAS)
    policy = policy_of(name, spec)
    seen = observations(spec, 4)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        before = policy(inputs_for(seen, policy))[CHUNK]
        wide = distribution(policy, seen).entropy()
        policy.scale_exploration(0.25, 1.0)
        assert torch.allclose(policy(inputs_for(seen, policy))[CHUNK], before)
        narrow = distribution(policy, seen).entropy()
        policy.scale_exploration(4.0, 1.0)
        again = distribution(policy, seen).entropy()
    assert bool((narrow < wide).all()) and torch.allclose(again, wide, atol=1e-3)


@pytest.mark.parametrize("name", [name for name in POLICIES if name.startswith("chunk_")])
def test_some_decisions_are_drawn_and_the_others_are_the_mode(name: str) -> None:
    spec = world_spec(ARM_DELTAS)
    policy = policy_of(name, spec)
    seen = observations(spec, 1)
    mode = likeliest(policy, seen)
    many = TensorDict.cat([seen] * 400)
    policy.scale_exploration(1.0, 0.25)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        said = policy(inputs_for(many, policy))
    drawn = ((said[CHUNK] - mode).abs() > 1e-5).flatten(1).any(1)
    assert 60 < int(drawn.sum()) < 140  # 100 expected, 8.7 standard deviation
    assert torch.allclose(distribution(policy, many).log_prob(said[CHUNK]), said[LOG_PROB], atol=1e-4)


def test_tokens_say_how_likely_the_mode_is_when_it_stands_for_what_is_not_drawn() -> None:
    logits = torch.tensor([[[[0.0, 2.0, 0.0]], [[1.0, 0.0, 0.0]]]])  # one chunk of two numbers
    low, high = torch.zeros(1), torch.full((1,), 3.0)
    dist = ChunkTokens(logits, low, high, torch.tensor([0.25]))
    every = torch.tensor([[[a], [b]] for a in (0.5, 1.5, 2.5) for b in (0.5, 1.5, 2.5)])
    shares = torch.stack([dist.log_prob(one[None]).exp() for one in every])
    assert float(shares.sum()) == pytest.approx(1.0)
    drawn = dist.held().log_prob(dist.mode).exp()
    assert float(dist.log_prob(dist.mode).exp()) == pytest.approx(float(0.25 * drawn + 0.75))


def test_nothing_is_learned_of_a_mean_that_stands_for_a_drawn_chunk() -> None:
    policy = policy_of("chunk_gaussian", world_spec(ARM_DELTAS))
    seen = observations(world_spec(ARM_DELTAS), 4)
    dist = distribution(policy, seen)
    gradient = torch.autograd.grad(dist.log_prob(dist.mode.detach()).sum(), dist.loc)[0]
    assert float(gradient.abs().max()) < 1e-4


@pytest.mark.parametrize(("name", "share"), [("chunk_gaussian", 0.25), ("chunk_tokens", 1.0)])
def test_a_mean_steps_as_far_as_it_was_explored(name: str, share: float) -> None:
    policy = policy_of(name, world_spec(ARM_DELTAS))
    assert rl_rate(policy, 3e-4) == pytest.approx(3e-4)
    policy.scale_exploration(0.25, 0.5)
    assert rl_rate(policy, 3e-4) == pytest.approx(share * 3e-4)
    assert rl_rate(torch.nn.Identity(), 3e-4) == 3e-4  # of anybody's policy, which says nothing of it


def said(policy: TensorDictModuleBase, observed: TensorDict, action: torch.Tensor) -> torch.Tensor:
    """How likely a policy finds an action [B, ...] on these observations, [B]."""
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        seen = policy(inputs_for(observed, policy))
        return distribution(trained_part(policy), seen).log_prob(action)


def likeliest(policy: TensorDictModuleBase, observed: TensorDict) -> torch.Tensor:
    """What a policy does, as it is scored: chunks or tokens."""
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return policy(inputs_for(observed, policy))[action_key(policy)]  # type: ignore[no-any-return]


@pytest.mark.parametrize("robot", [ARM_DELTAS, BIMANUAL_POSES], ids=lambda robot: robot.robot)
@pytest.mark.parametrize("name", POLICIES)
def test_every_view_word_and_state_matters(name: str, robot: Embodiment) -> None:
    spec = world_spec(robot)
    policy = policy_of(name, spec, "absolute")
    seen = observations(spec, 4)
    action = likeliest(policy, seen)
    score = said(policy, seen, action)

    def matters(other: TensorDict) -> bool:
        same = torch.equal(likeliest(policy, other), action) and torch.equal(
            said(policy, other, action), score
        )
        return not same

    assert not matters(seen.clone())
    for view in range(spec.views):
        other = seen.clone()
        other[IMAGE][:, view] = 255 - other[IMAGE][:, view]
        looked_at = view == robot.main_view or name not in MAIN_VIEW_ALONE
        assert matters(other) == looked_at, f"view {view}"
    words = seen.clone()
    words[INSTRUCTION_UTF8] = words[INSTRUCTION_UTF8].roll(1, 0)
    assert matters(words)
    for number in range(spec.state_dim):
        moved = seen.clone()
        moved[STATE][:, number] += 1.0
        assert matters(moved), f"state {number}"
    for number in range(spec.action_dim if COMMAND in policy.in_keys else 0):
        moved = seen.clone()
        moved[COMMAND][:, number] += 1.0
        assert matters(moved), f"command in force {number}"


@pytest.mark.parametrize("robot", EMBODIMENTS.values(), ids=list(EMBODIMENTS))
@pytest.mark.parametrize("name", POLICIES)
def test_acts_the_same_in_any_slot_of_any_batch(name: str, robot: Embodiment) -> None:
    spec = world_spec(robot)
    policy = policy_of(name, spec, "absolute")
    seen = observations(spec, 4)
    action = likeliest(policy, seen)
    score = said(policy, seen, action)
    assert torch.equal(likeliest(policy, seen.flip(0)).flip(0), action)
    assert torch.equal(said(policy, seen.flip(0), action.flip(0)).flip(0), score)
    others = seen.clone()
    others[[0, 2, 3]] = observations(spec, 3, seed=1)
    assert torch.equal(likeliest(policy, others)[1], action[1])
    assert torch.equal(said(policy, others, action)[1], score[1])
    # Other batch sizes may choose other kernels, which sum in another order.
    assert torch.allclose(said(policy, seen[1:2], action[1:2]), score[1:2], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("robot", EMBODIMENTS.values(), ids=list(EMBODIMENTS))
@pytest.mark.parametrize("name", POLICIES)
def test_log_probabilities_reach_every_weight(name: str, robot: Embodiment) -> None:
    spec = world_spec(robot)
    policy = policy_of(name, spec, "absolute")
    with torch.no_grad():
        for parameter in policy.parameters():
            if not parameter.any():  # what begins at zero keeps gradients from what stands before it
                parameter.normal_(std=0.05)
    out = acted(policy, spec, ActionMode.ABSOLUTE)
    scored = distribution(policy, out.select(*input_keys(policy), action_key(policy)))
    scored.log_prob(out[action_key(policy)]).sum().backward()
    unused = [key for key, p in policy.named_parameters() if p.grad is None or not bool(p.grad.any())]
    assert not unused


@pytest.mark.parametrize("name", POLICIES)
def test_imitates_a_few_chunks_after_taking_units_from_them(name: str) -> None:
    spec = world_spec(ARM_JOINTS)
    policy = policy_of(name, spec, "absolute")
    seen = observations(spec, 6)
    rise = torch.linspace(0, 1, spec.chunk)[None, :, None]
    chunks = 20.0 + rise * 3 * torch.randn(6, 1, spec.action_dim)
    chunks[..., 1] = 5.0  # a joint that never moves
    policy.normalise(chunks, seen[STATE], seen[COMMAND])
    assert getattr(policy, "constants", ["joint1.pos"]) == ["joint1.pos"]
    optimiser = torch.optim.Adam(policy.parameters(), 3e-3)
    losses = []
    for _ in range(60):
        optimiser.zero_grad()
        loss = imitation_loss(policy, seen, chunks)
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.6 * losses[0]
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        said = policy(inputs_for(seen, policy))[CHUNK]
    assert float((said[..., 1] - 5.0).abs().max()) < 1e-3
    assert float((said - chunks).abs().mean()) < float((chunks - chunks.mean(0)).abs().mean())


@pytest.mark.parametrize("name", POLICIES)
def test_weights_saved_are_weights_loaded(name: str, tmp_path: Any) -> None:
    from actors.weights import load

    spec = world_spec(BIMANUAL_POSES)
    policy = policy_of(name, spec)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter))
    save_file({key: value.contiguous() for key, value in policy.state_dict().items()}, tmp_path / "w")
    other = load(policy_of(name, spec), tmp_path / "w")
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        one, two = (p(inputs_for(observations(spec, 2), p))[CHUNK] for p in (policy, other))
    assert torch.equal(one, two)
    with pytest.raises(ConfigError, match="another architecture or robot"):
        load(policy_of(name, world_spec(ARM_JOINTS)), tmp_path / "w")


class Diverged(TensorDictModuleBase):
    """Says NaN in its first row."""

    def __init__(self, spec: WorldSpec):
        super().__init__()
        self.spec = spec
        self.in_keys, self.out_keys = [COMMAND, INSTRUCTION], [CHUNK]
        self.heard: list[str] = []

    def forward(self, observed: TensorDict) -> TensorDict:
        self.heard = list(observed[INSTRUCTION])
        chunk = torch.ones(len(observed), self.spec.chunk, self.spec.action_dim)
        chunk[0, 0, 0] = float("nan")
        observed[CHUNK] = chunk
        return observed


@pytest.mark.parametrize(
    ("robot", "mode", "rests"),
    [
        (BIMANUAL_POSES, ActionMode.RELATIVE, "zeros"),
        (BIMANUAL_POSES, ActionMode.ABSOLUTE, "command"),
        (ARM_DELTAS, ActionMode.ABSOLUTE, "gripper"),
    ],
)
def test_nan_never_reaches_a_world_and_text_reaches_the_policy(
    robot: Embodiment, mode: ActionMode, rests: str
) -> None:
    spec = world_spec(robot)
    seen, policy = observations(spec, 3), Diverged(spec)
    out = SafePolicyWrapper(policy, spec, mode)(seen.clone())
    still = seen[COMMAND][0] if rests == "command" else torch.zeros(spec.action_dim)
    if rests == "gripper":  # of changes it alone is not one
        still[-1] = seen[COMMAND][0, -1]
    assert torch.equal(out[CHUNK][0], still.expand(spec.chunk, -1))
    assert bool((out[CHUNK][1:] == 1).all())
    assert out[INVALID_ACTION].flatten().tolist() == [True, False, False]
    assert policy.heard == bytes_to_text(seen[INSTRUCTION_UTF8])
    assert INSTRUCTION not in out.keys()  # rollouts carry numbers only


def test_features_of_the_decision_before_are_not_handed_to_a_policy() -> None:
    spec = world_spec(ARM_DELTAS)
    policy = policy_of("chunk_gaussian", spec)
    seen = observations(spec, 2)
    seen[VISUAL_FEATURES] = torch.ones(2, 5)
    given: list[bool] = []
    policy.register_forward_pre_hook(lambda _, args: given.append(VISUAL_FEATURES in args[0].keys(True)))
    SafePolicyWrapper(policy, spec, ActionMode.ABSOLUTE)(seen)
    assert given == [False]


def test_text_has_the_batch_of_a_rollout() -> None:
    spec = world_spec(ARM_DELTAS)
    rollout = torch.stack([observations(spec, 3)] * 2, 1)
    text = with_text(rollout, Diverged(spec)).get(INSTRUCTION)
    assert text.shape == (3, 2)
    assert text.tolist() == [bytes_to_text(row) for row in rollout[INSTRUCTION_UTF8]]


def test_chunks_of_another_robot_are_refused() -> None:
    spec, other = world_spec(ARM_DELTAS), world_spec(ARM_JOINTS)
    with pytest.raises(ValueError, match=r"\[4, 7\], but one_arm_deltas takes \[4, 4\]"):
        SafePolicyWrapper(Diverged(other), spec, ActionMode.ABSOLUTE)(observations(spec, 2))


def test_a_head_of_another_size_and_unknown_options_are_named() -> None:
    spec = world_spec(ARM_DELTAS)

    def built(**changes: Any) -> Any:
        return build(section("policy/chunk_gaussian", "absolute", **changes), "policy", spec=spec)

    with pytest.raises(ConfigError, match="takes 4 x 4; a head must use the chunk and actions"):
        built(head={"_target_": "tests.actors.policies.test_heads.WrongHead"})
    with pytest.raises(ConfigError, match=r"policy\.widht is not an option .* did you mean width"):
        built(widht=3)
    with pytest.raises(ConfigError, match=r"policy\.head\._target_=no\.such\.Head does not import"):
        built(head={"_target_": "no.such.Head"})
    with pytest.raises(ConfigError, match=r"policy\._target_=.*did you mean ChunkPolicy"):
        built(_target_="actors.policies.vla.ChunkPolice")
    with pytest.raises(ConfigError, match="knots=9 must be between 1 and"):
        built(head={"knots": 9})


@pytest.mark.parametrize("name", [name for name in POLICIES if name != "tiny_vla"])
def test_frozen_perception_is_neither_trained_nor_run_again(name: str) -> None:
    spec = world_spec(ARM_DELTAS)
    policy = policy_of(name, spec, "absolute")
    policy.freeze_perception()
    assert writes_features(policy)
    out = acted(policy, spec, ActionMode.ABSOLUTE)
    part = trained_part(policy)
    assert IMAGE not in part.in_keys
    scored = distribution(part, out.exclude("observation", "camera").update(out.select(*part.in_keys)))
    assert torch.allclose(scored.log_prob(out[CHUNK]), out[LOG_PROB], atol=1e-4)
    names = {key for key, value in policy.named_parameters() if not value.requires_grad}
    assert names == {f"module.0.module.{key}" for key, _ in policy.perception.named_parameters()}
