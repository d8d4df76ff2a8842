"""One recorded episode, whatever it came from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.physics.pool import Track
from envs.specs import ACTION_DIM, STATE_DIM


class EpisodeError(ValueError):
    """A recorded episode or data set is damaged, foreign or incomplete; the message names the file and the
    fix.
    """


@dataclass
class Episode:
    """T video frames with everything known at each of them; frame 0 is the start.

    Args:
        frames: uint8 [T, V, 3, H, W] RGB.
        commands: float32 [T, 14], the absolute command in force when the frame was taken; row t + 1 is the
            action taken at t.
        achieved: float32 [T, 14], flange poses the arms really had.
        states: float32 [T, 16], see schema.STATE_DIM.
        intrinsic: float32 [V, 3, 3] pixels.
        c2w: float32 [T, V, 4, 4] camera to world, OpenCV convention.
        success: bool [T], true from the frame on at which the task's condition has held long enough.
        progress: float32 [T] in 0..1.
        objects: float32 [T, N, 4] true places (schema.OBJECT_DIM), NaN where nobody knows them, or a thing
            has no heading; simulators learn contact from them, judges and policies where to look; none is
            told them while it acts.
        instruction, seed, behaviour: words, the episode's seed, who acted ("expert", "noisy", "random",
            "policy-<n>", or a foreign source).
        views: names of the V cameras.
        fps: frames per second.
        seen: bool [T], frames of which there is a picture; others are black. All by default.
        recorded: float32 [T, A], actions as the source has them, if it has others than end-effector poses.
        recorded_layout: what those are: "joints" for [L7, Lg, R7, Rg] (layouts.CommandLayout), else the
            source's own name.

    What a source does not know is NaN throughout: states, commands, or the pose of a camera.

    Raises:
        EpisodeError: if lengths disagree, or numbers are missing here and there.
    """

    frames: NDArray[np.uint8]
    commands: NDArray[np.float32]
    achieved: NDArray[np.float32]
    states: NDArray[np.float32]
    intrinsic: NDArray[np.float32]
    c2w: NDArray[np.float32]
    success: NDArray[np.bool_]
    progress: NDArray[np.float32]
    objects: NDArray[np.float32]
    instruction: str
    seed: int
    behaviour: str
    views: tuple[str, ...]
    fps: float
    seen: NDArray[np.bool_] = None  # type: ignore[assignment]
    recorded: NDArray[np.float32] | None = None
    recorded_layout: str = ""

    def __post_init__(self) -> None:
        length, views = self.frames.shape[:2]
        if views != len(self.views):
            raise EpisodeError(
                f"episode {self.seed}: frames hold {views} views, but {list(self.views)} are named"
            )
        shapes = {
            "commands": (length, ACTION_DIM),
            "achieved": (length, ACTION_DIM),
            "states": (length, STATE_DIM),
            "c2w": (length, views, 4, 4),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise EpisodeError(f"episode {self.seed}: {name} has shape {value.shape}, expected {shape}")
            known = np.isfinite(value)
            # A camera's 16 numbers are known together; of other fields all are, or none.
            whole = (
                known.all(axis=(0, 2, 3)) | np.isnan(value).all(axis=(0, 2, 3))
                if name == "c2w"
                else known.all() | np.isnan(value).all()
            )
            if not whole.all():
                raise EpisodeError(
                    f"episode {self.seed}: {name} holds NaN or infinite values in some places; what is unknown must be NaN throughout"
                )
        if self.seen is None:
            self.seen = np.ones(length, bool)
        if self.seen.shape != (length,) or (self.recorded is not None and len(self.recorded) != length):
            raise EpisodeError(f"episode {self.seed}: seen and recorded must have {length} rows")
        if self.recorded is not None and not np.isfinite(self.recorded).all():
            raise EpisodeError(f"episode {self.seed}: recorded actions hold NaN or infinite values")

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def succeeded(self) -> bool:
        """True if the episode ended in success."""
        return bool(self.success[-1])

    @classmethod
    def from_track(cls, track: Track, behaviour: str, views: tuple[str, ...], fps: float) -> Episode:
        """The episode a bench recorded."""
        rows: dict[str, Any] = {name: np.stack(values) for name, values in track.rows.items()}
        floats = {
            name: rows[name].astype(np.float32)
            for name in ("commands", "achieved", "states", "c2w", "progress", "objects")
        }
        return cls(
            frames=rows["frames"],
            success=rows["success"].astype(bool),
            intrinsic=track.intrinsic.astype(np.float32),
            instruction=track.instruction,
            seed=track.seed,
            behaviour=behaviour,
            views=views,
            fps=fps,
            **floats,
        )
