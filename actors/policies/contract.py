"""What Worldloop asks of a policy, and how it treats any policy.

A policy is a TensorDictModule that reads observations by the keys of envs/specs.py (`in_keys`) and writes
("vla_action", "chunk") [B, K, A], with its log-probability [B] or without; `get_dist` gives the
distribution that learners differentiate. A policy that also writes ("vla_action", "tokens") is scored on
those, as TorchRL's are.

Whatever else a policy has is used if it is there:

- "language_instruction" among its in_keys: it is given the instruction as text;
- ("policy", "visual_features") among its out_keys, and `visual_dim`: critics read them instead of pictures;
- `encoder`: the module that writes those, if it can be run alone;
- `trained`: the part that learners train and score, if that is not all of it;
- `freeze_perception()`: for rl.freeze_perception;
- `normalise(chunks [N, K, A], states [N, S], commands in force [N, A])`: takes units from demonstrations;
- `constants`: names of the numbers of an action that it then always says the same of, which is told;
- `policy_features(observed)` [B, width] and `width`: through them perception is taught on all recorded
  frames;
- `gaze(observed)`, those features and what key-points look for (vla.py), `instruction_keypoints` and
  `views`: the last `instruction_keypoints` key-points are taught where hands go;
- `scale_exploration(width, share)`: with it, how widely chunks are drawn around the mode, and how many are
  drawn at all, is found in physics (section explore); without it the policy explores as it is;
- `exploration`: how widely they are drawn, over how widely the config says (see rl_rate);
- `imitation_loss(observed, chunks [B, K, A])`: a better one than the negative log-likelihood;
- `rehearsed = False` on its class: it is not built before any work, to see that it can (rehearsal.py), since
  that is dear.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey, NonTensorStack, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data.vla import ACTION_TOKENS_KEY

from envs.specs import CHUNK, INSTRUCTION, INSTRUCTION_UTF8, bytes_to_text
from envs.targets import ConfigError

VISUAL_FEATURES = ("policy", "visual_features")  # float32 [B, visual_dim]: of pictures and instruction
POLICY_FEATURES = ("policy", "policy_features")  # float32 [B, width]: those joined with the robot's state


def trained_part(policy: TensorDictModuleBase) -> TensorDictModuleBase:
    """What learners train and score: `policy.trained`, or all of it."""
    return getattr(policy, "trained", policy)


def rl_rate(policy: TensorDictModuleBase, lr: float) -> float:
    """RL's learning rate of a policy, whose `exploration` multiplies `lr`.

    What RL learns of actions reaches no further than they were tried, and Adam's steps are as long however
    small gradients are: a mean around which actions are drawn a third as widely leaves what is known of it
    three times as soon.
    """
    return lr * float(getattr(policy, "exploration", 1.0))


def freeze_perception(policy: TensorDictModuleBase) -> None:
    """Leave a policy's encoder as it is, for rl.freeze_perception=true.

    Raises:
        ConfigError: if the policy cannot tell its encoder from the rest.
    """
    freeze = getattr(policy, "freeze_perception", None)
    if freeze is None:
        raise ConfigError(
            f"rl.freeze_perception=true, but {type(policy).__name__} has no freeze_perception();"
            " set rl.freeze_perception=false"
        )
    freeze()


def action_key(policy: TensorDictModuleBase) -> NestedKey:
    """The key of what the policy's distribution scores: action tokens if it writes any, else the chunk."""
    return ACTION_TOKENS_KEY if ACTION_TOKENS_KEY in policy.out_keys else CHUNK


def input_keys(policy: TensorDictModuleBase) -> list[NestedKey]:
    """The keys of what a rollout must carry for a policy to be scored again; text travels as bytes."""
    return [INSTRUCTION_UTF8 if key == INSTRUCTION else key for key in policy.in_keys]


def writes_features(policy: TensorDictModuleBase) -> bool:
    """Whether critics may read ("policy", "visual_features") of this policy."""
    return VISUAL_FEATURES in policy.out_keys


def feature_part(policy: TensorDictModuleBase) -> TensorDictModuleBase:
    """The part of a policy that writes ("policy", "visual_features"), or all of it."""
    return getattr(policy, "encoder", policy)


def with_text(observed: TensorDictBase, policy: TensorDictModuleBase) -> TensorDictBase:
    """Observations [...] with the instruction as text, for policies that ask for it; the rest is shared.

    The text is decoded from the bytes that rollouts carry.
    """
    if INSTRUCTION not in policy.in_keys:
        return observed
    out = observed.copy()
    text = out[INSTRUCTION_UTF8]
    stack = NonTensorStack(*bytes_to_text(text.reshape(-1, text.shape[-1])))
    out[INSTRUCTION] = stack if out.ndim == 1 else stack.reshape(out.shape)
    return out


def device_of(module: nn.Module) -> torch.device:
    """Where a module's numbers live; the CPU if it has none."""
    return next((value.device for value in module.parameters()), torch.device("cpu"))


def inputs_for(observed: TensorDictBase, policy: TensorDictModuleBase) -> TensorDictBase:
    """The observations that a policy reads, on its device and with text if it asks for it.

    Visual features that are there go along, for policies whose encoder need not run again.
    """
    given = observed.select(*input_keys(policy), VISUAL_FEATURES, strict=False).to(device_of(policy))
    return with_text(given, policy)


def distribution(policy: TensorDictModuleBase, data: TensorDictBase) -> Any:
    """The policy's distribution for observations [B], which are left as they are."""
    return policy.get_dist(with_text(data, policy).copy())


def imitation_loss(policy: TensorDictModuleBase, observed: TensorDictBase, chunks: Tensor) -> Tensor:
    """Scalar loss of imitating chunks [B, K, A]: the policy's own, or their negative log-likelihood per
    number.
    """
    own = getattr(policy, "imitation_loss", None)
    if own is not None:
        return own(with_text(observed, policy), chunks)  # type: ignore[no-any-return]
    return -distribution(policy, observed).log_prob(chunks).mean() / chunks[0].numel()


def with_fixed_spread(dist: Any) -> Any:
    """A distribution whose spread does not learn, for those that tell mean and spread apart."""
    return dist.held() if hasattr(dist, "held") else dist
