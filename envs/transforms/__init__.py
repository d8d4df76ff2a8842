"""What turns a bare WorldEnv into an environment for policies: conditioning, proprioception, reward."""

from torchrl.envs import Compose

from envs.conditioning import PoseMapStyle
from envs.geometry.kinematics import Kinematics
from envs.judges import Judge
from envs.simulators.state_experts.base import StateDecoder
from envs.specs import Rewards
from envs.transforms.judge_reward import JudgeReward
from envs.transforms.pose_map import PoseMapTransform
from envs.transforms.state_expert import StateExpertTransform

__all__ = ["JudgeReward", "PoseMapTransform", "StateExpertTransform", "world_transforms"]


def world_transforms(
    decoder: StateDecoder,
    judge: Judge,
    rewards: Rewards,
    views: tuple[str, ...],
    later: bool = False,
    style: PoseMapStyle | None = None,
    kinematics: Kinematics | None = None,
) -> Compose:
    """The three transforms in their order: commands to pose maps going in, joint states and rewards coming
    out, the latter at once or `later`.
    """
    return Compose(
        PoseMapTransform(views, style, kinematics),
        StateExpertTransform(decoder),
        JudgeReward(judge, rewards, later),
    )
