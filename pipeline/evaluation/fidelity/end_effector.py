"""How far end effectors stray in generated video, in cm: by one gripper detector on generated and on recorded
pictures, against where they truly were.

The detector is the sounder ruler: it looks at nothing but pictures. A state expert reads a simulator's
features and the commands themselves, so it can be right about an arm that the video shows elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from actors.world_config import pose_style
from envs.embodiment import EmbodimentError
from envs.episodes.clips import ClipStore
from envs.simulators.replay import Replay
from pipeline.evaluation.grippers.end_effectors import EndEffectors, true_end_effectors
from pipeline.evaluation.grippers.ruler import GripperRuler, gripper_ruler
from pipeline.evaluation.objects.rays import nearest_on_ray, rays, triangulate
from pipeline.evaluation.statistics import quantiles


@dataclass(frozen=True)
class EndEffectorRuler:
    """Measures end effectors in space.

    Args:
        ruler: finds them in pictures.
        truth: where they were.
        cameras: names of those that the detector looks through.
    """

    ruler: GripperRuler
    truth: EndEffectors
    cameras: tuple[str, ...]

    @property
    def method(self) -> str:
        """How pixels become places, in words."""
        if len(self.cameras) > 1:
            return f"triangulated through {', '.join(self.cameras)}"
        return f"across the line of sight of {self.cameras[0]}, the one camera on no wrist: a lower bound"

    def measure(self, store: ClipStore, episodes: Tensor, made: Replay, truth: Tensor) -> dict[str, Tensor]:
        """Errors in cm, float32 [N, T, arms], of generated ("made") and recorded ("recorded") frames; NaN
        where no gripper was found, or the frame does not exist.

        Args:
            truth: uint8 [N, T, V, 3, H, W], the true frames beside made.frames.
        """
        views = list(self.ruler.views)
        intrinsic = store.intrinsic[episodes][:, None, views, None]  # [N, 1, V, 1, 3, 3]
        c2w = store.arrays["c2w"][made.rows][:, :, views, None]  # [N, T, V, 1, 4, 4]
        true = self.truth.positions[made.rows]  # [N, T, arms, 3]
        out = {}
        for name, frames in (("made", made.frames), ("recorded", truth)):
            seen = frames[:, :, views]
            pixels = self.ruler.detector.detect(seen.flatten(0, 1), torch.arange(len(views)))
            pixels = pixels.unflatten(0, seen.shape[:2])  # [N, T, V, arms, 2]
            origin, direction = rays(
                pixels, intrinsic.expand(*pixels.shape[:-1], 3, 3), c2w.expand(*pixels.shape[:-1], 4, 4)
            )
            if len(views) > 1:
                place = triangulate(origin.transpose(2, 3), direction.transpose(2, 3))
            else:
                place = nearest_on_ray(origin[:, :, 0], direction[:, :, 0], true)
            off = 100 * (place - true).norm(dim=-1)
            out[name] = torch.where(made.valid[..., None], off, torch.nan)
        return {**out, "valid": made.valid[..., None].expand_as(out["made"])}


def end_effector_ruler(
    cfg: Mapping[str, Any], store: ClipStore, data: Sequence[Path], root: Path
) -> EndEffectorRuler | str:
    """What measures end effectors in space; why nothing can, in words, where nothing can."""
    if not cfg["fidelity"]["end_effectors"]:
        return "fidelity.end_effectors=false"
    try:
        ruler = gripper_ruler(cfg, store, data, root)
    except EmbodimentError as error:
        return str(error)
    if ruler.sights is None:
        return "cameras are not calibrated, or nobody knows where end effectors are"
    truth = true_end_effectors(store, ruler.sights.ends, pose_style(cfg).tool_offset)
    if truth is None:
        return (
            "nobody knows where end effectors truly were: commands alone are recorded; record x, y, z of"
            " each arm"
            " in observation.state"
        )
    names = store.spec.embodiment.views
    return EndEffectorRuler(ruler, truth, tuple(names[view] for view in ruler.views))


def end_effector_summary(
    ruler: EndEffectorRuler | str, parts: Sequence[Mapping[str, Tensor]]
) -> dict[str, Any]:
    """Figures of what was measured part by part: generated_cm and recorded_cm (median and 90th percentile
    over frames and arms; the latter is the detector's own), lost and recorded_lost (shares of frames in which
    a gripper was not found), how they were found and who knows the truth. {"unknown": why} where nothing was.
    """
    if isinstance(ruler, str):
        return {"unknown": ruler}
    flat = {name: torch.cat([part[name][part["valid"]] for part in parts]) for name in ("made", "recorded")}
    if not torch.isfinite(flat["recorded"]).any():
        return {
            "unknown": "the detector finds no gripper in recorded video; raise ewmbench.detector.fit.steps"
        }
    return {
        "generated_cm": quantiles(flat["made"]),
        "recorded_cm": quantiles(flat["recorded"]),
        "lost": float((~torch.isfinite(flat["made"])).float().mean()),
        "recorded_lost": float((~torch.isfinite(flat["recorded"])).float().mean()),
        "method": ruler.method,
        "truth": ruler.truth.source,
    }


def end_effector_text(found: Mapping[str, Any]) -> str:
    """The same in a sentence."""
    if "unknown" in found:
        return f"End effectors are not measured: {found['unknown']}."
    made, own = found["generated_cm"], found["recorded_cm"]
    how = f"({found['method']}; truth: {found['truth']})"
    floor = (
        f"in recorded video the same detector errs {own['median']:.2f} cm (90% within {own['p90']:.2f})"
        " and misses"
        f" {100 * found['recorded_lost']:.1f}%"
    )
    if made is None:
        return f"No end effector is found in generated video {how}; {floor}."
    return (
        f"End effectors lie {made['median']:.2f} cm off (median; 90% within {made['p90']:.2f}) and are not"
        " found in"
        f" {100 * found['lost']:.1f}% {how}; {floor}."
    )
