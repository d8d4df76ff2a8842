"""What turns a bare WorldEnv into an environment for policies: action decoding, the robot's state, reward."""

from torchrl.envs import Compose

from envs.conditioning import PoseMapStyle
from envs.geometry.kinematics import Kinematics
from envs.judges.base import Judge
from envs.simulators.state_experts.base import StateDecoder
from envs.specs import Rewards, WorldSpec
from envs.transforms.action_decoding import ActionDecoding
from envs.transforms.judge_reward import JudgeReward
from envs.transforms.state_expert import StateExpertTransform

__all__ = ["ActionDecoding", "JudgeReward", "StateExpertTransform", "world_transforms"]


def world_transforms(
    spec: WorldSpec,
    decoder: StateDecoder,
    judge: Judge | None,
    rewards: Rewards,
    *,
    later: bool = False,
    style: PoseMapStyle | None = None,
    kinematics: Kinematics | None = None,
) -> Compose:
    """The transforms in their order: chunks to conditioned commands going in, states and rewards coming out.

    Args:
        judge: decides rewards; None for video that nobody judges, which has none.
        later: rewards arrive after the episode, see JudgeReward.
        style: how pose maps are drawn; must be that of training.
        kinematics: of the robot, for pose maps of joint commands.
    """
    reward = [] if judge is None else [JudgeReward(judge, rewards, later)]
    return Compose(ActionDecoding(spec, style, kinematics), StateExpertTransform(decoder), *reward)
