"""worldloop bench size simulator=NAME [judge=golden_goal_full]: what an engine, and a judge's text world,
take, counted on shapes alone, without computing it.

Parameters, floating-point operations of one training step and of one generated chunk, and memory. Works for
sizes that no machine at hand could hold: tensors lie on torch's meta device, which knows shapes and no
numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from actors.world_config import world_spec
from envs.rng import step_generator
from envs.simulators.base import WORLD_OPTIONS, Simulator
from envs.simulators.inputs import build_inputs
from envs.simulators.tokens.text_world import TextWorld
from envs.specs import WorldSpec, text_to_bytes
from envs.targets import ConfigError, build

_FLOAT = 4  # bytes: weights are kept in float32
_STATE = 4  # numbers beside each trained weight: gradient, AdamW's two moments, moving average


@dataclass(frozen=True)
class Size:
    """What an engine takes.

    Args:
        trained, frozen: parameters.
        training: floating-point operations of the loss of one sample, forward and backward.
        generating: of one chunk of one session.
        activations: bytes that the loss of one sample keeps for its backward pass, weights of attention
            among them, which fused kernels do without.
    """

    trained: int
    frozen: int
    training: float
    generating: float
    activations: int


class _Guess(TorchDispatchMode):
    """Answers 1 where code asks for the value of a tensor without numbers, as loops over what is drawn do."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.ops.aten._local_scalar_dense.default and args[0].is_meta:
            return torch.ones((), dtype=args[0].dtype).item()
        return func(*args, **(kwargs or {}))


class _Kept:
    """Bytes of the different tensors that autograd keeps, but for parameters."""

    def __init__(self, parameters: Sequence[Tensor]):
        self.known = {p.untyped_storage()._cdata for p in parameters}
        self.bytes = 0

    def keep(self, tensor: Tensor) -> Tensor:
        """Count a tensor's storage once."""
        storage = tensor.untyped_storage()
        if storage._cdata not in self.known:
            self.known.add(storage._cdata)
            self.bytes += storage.nbytes()
        return tensor


def size_of(section: Mapping[str, Any], spec: WorldSpec) -> Size:
    """Count an engine.

    Args:
        section: the section simulator of a config.

    Raises:
        ConfigError: if the engine asks for numbers that shapes do not tell.
    """
    own = {name: value for name, value in section.items() if name not in WORLD_OPTIONS}

    def works(world: Simulator) -> Works:
        clip, generator = _clip(spec, world.memory_frames), step_generator(0, 0)
        inputs = build_inputs(spec, clip, 0, generator=generator)
        return lambda: world.predict(inputs), lambda: world.loss(clip, generator)[0]

    return _size(own, "simulator", spec, works)


def text_world_size(section: Mapping[str, Any], spec: WorldSpec) -> Size:
    """Count a text world; what it generates is the first frame towards a goal.

    Args:
        section: judge.text_world of a config.

    Raises:
        ConfigError: see size_of.
    """

    def works(world: TextWorld) -> Works:
        frames = torch.zeros(1, world.window, spec.views, 3, *spec.size, dtype=torch.uint8, device="meta")
        known = torch.ones(1, world.window, device="meta")
        text = text_to_bytes(["text"])  # read, so it has numbers
        clip = TensorDict({"frames": frames, "valid": known.bool(), "success": known, "text": text}, [1])
        seed = torch.zeros(1, dtype=torch.int64)
        return (
            lambda: world.imagine(frames[:, 0], ["text"], seed),
            lambda: world.loss(clip, step_generator(0, 0))[0],
        )

    return _size(section, "judge.text_world", spec, works)


Works = tuple[Callable[[], Any], Callable[[], Tensor]]  # generate, and the loss of one sample


def _size(section: Mapping[str, Any], key: str, spec: WorldSpec, works: Callable[[Any], Works]) -> Size:
    """Count what a section builds."""
    try:
        with torch.device("meta"):
            world: nn.Module = build(section, key, spec=spec)
        parameters = list(world.parameters())
        trained = sum(p.numel() for p in parameters if p.requires_grad)
        generate, lose = works(world.eval())
        generating, kept = _counted(generate), _Kept(parameters)
        world.train()

        def learn() -> None:
            with torch.enable_grad(), torch.autograd.graph.saved_tensors_hooks(kept.keep, lambda x: x):
                loss = lose()
            if loss.requires_grad:
                loss.backward()

        training = _counted(learn)
    except (NotImplementedError, RuntimeError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"{key} ({section['_target_']}) cannot be counted on shapes alone, for something in it asks"
            f" for numbers: {type(error).__name__}: {str(error).partition(chr(10))[0]}"
        ) from error
    total = sum(p.numel() for p in parameters)
    return Size(trained, total - trained, training, generating, kept.bytes)


def _counted(work: Callable[[], Any]) -> float:
    """Floating-point operations of `work`."""
    with torch.no_grad(), FlopCounterMode(display=False) as counter, _Guess():
        work()
    return float(counter.get_total_flops())


def _clip(spec: WorldSpec, remembered: int) -> TensorDict:
    """A training clip [1] of one chunk (see episodes/clips.py) without numbers."""

    def part(count: int, *lead: int) -> dict[str, Tensor]:
        shape, views = (1, *lead, count), spec.views
        out = {
            "frames": torch.zeros(*shape, views, 3, *spec.size, dtype=torch.uint8, device="meta"),
            "commands": torch.zeros(*shape, spec.action_dim, device="meta"),
        }
        if spec.pose_map:
            out["pose_map"] = torch.zeros_like(out["frames"])
        if spec.embodiment.calibrated:
            out["c2w"] = torch.zeros(*shape, views, 4, 4, device="meta")
        return out

    index = torch.zeros(1, 1, remembered, dtype=torch.int64, device="meta")
    states = torch.zeros(1, max(spec.chunk, remembered), spec.state_dim, device="meta")
    clip = {
        "memory": TensorDict({"index": index, "present": index == 0, **part(remembered, 1)}, [1]),
        "future": TensorDict(
            {
                **part(spec.chunk),
                "states": states[:, : spec.chunk],
                "valid": torch.ones(1, spec.chunk, dtype=torch.bool, device="meta"),
                "success": torch.zeros(1, spec.chunk, device="meta"),
            },
            [1],
        ),
        "now": TensorDict(
            {"command": torch.zeros(1, spec.action_dim, device="meta"), "state": states[:, 0]}, [1]
        ),
        "history": TensorDict(
            {
                "commands": torch.zeros(1, remembered, spec.action_dim, device="meta"),
                "states": states[:, :remembered],
            },
            [1],
        ),
        "begin": torch.zeros(1, dtype=torch.int64, device="meta"),
        "stride": torch.ones(1, dtype=torch.int64, device="meta"),
    }
    if spec.embodiment.calibrated:
        clip["intrinsic"] = torch.zeros(1, spec.views, 3, 3, device="meta")
    return TensorDict(clip, [1])


def size(cfg: Mapping[str, Any]) -> None:
    """Print what the engine of the section simulator takes, for the robot and size of the section task, and
    what the text world of the section judge does, if it has one.
    """
    spec = world_spec(cfg)
    found, batch = size_of(cfg["simulator"], spec), int(cfg["simulator_fit"]["first"]["fit"]["batch"])
    name = str(cfg["simulator"]["_target_"]).rpartition(".")[2]
    print(_summary(name, f"chunks of {spec.chunk}", "one chunk", spec, found, batch))
    if text_world := cfg["judge"].get("text_world"):
        found, batch = text_world_size(text_world, spec), int(cfg["text_world_fit"]["first"]["batch"])
        print(_summary("TextWorld", f"clips of {text_world['window']}", "one frame", spec, found, batch))


def _summary(name: str, what: str, made: str, spec: WorldSpec, found: Size, batch: int) -> str:
    weights, state = (_FLOAT * n / 1e9 for n in (found.trained + found.frozen, _STATE * found.trained))
    kept = found.activations / 1e9
    return (
        f"{name}: {spec.views} x {spec.size[0]} x {spec.size[1]}, {what},"
        f" {found.trained / 1e6:.1f} M parameters that learn and {found.frozen / 1e6:.1f} M that do not\n"
        f"one training step at batch {batch}: {batch * found.training / 1e12:.3g} TFLOP\n"
        f"{made} at batch 1: {found.generating / 1e12:.3g} TFLOP\n"
        f"memory in float32: weights {weights:.3g} GB; gradients, AdamW's moments and the moving average"
        f" {state:.3g} GB; activations about {kept:.3g} GB a sample, {batch * kept:.3g} GB a step"
    )
