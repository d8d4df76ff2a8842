"""Where things are, and where commands will push them: found in the first picture by sight, moved by contact.

A video network learns contact slowly, from every pixel at once, and shows its doubt as fading; networks that are given
object and fingertips in metres learn it from all frames of a data set in a minute. So every engine is told where the
objects of its view will be, as it is told where the hands will be, and is left to draw them. Episodes without object
places (NaN) teach nothing here, and a world without them does without.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from envs.schema import OBJECT_DIM, first_objects
from envs.simulators.contact import Contact
from envs.simulators.sight import Sight


class Places(nn.Module):
    """Objects of a world.

    Args:
        sides: of each that is followed; see Sight.

    Attributes:
        taught: whether it was ever shown object places; until then all are NaN.
    """

    taught: Tensor

    def __init__(self, sides: tuple[int, ...]):
        super().__init__()
        self.count = len(sides)
        self.register_buffer("taught", torch.zeros((), dtype=torch.bool))
        self.sight = Sight(sides)
        self.contact = Contact(sides)

    def of(self, objects: Tensor) -> Tensor:
        """The followed ones [..., S, 4] of recorded objects [..., N, 4], NaN where there are fewer."""
        return first_objects(objects, self.count)

    def find(self, frames: Tensor, intrinsic: Tensor, c2w: Tensor) -> Tensor:
        """Places [B, S, 4] in pictures of one camera (Sight.find), NaN before it was taught."""
        if not self.count:
            return torch.zeros((len(frames), 0, OBJECT_DIM), device=frames.device)
        return torch.where(self.taught, self.sight.find(frames, intrinsic, c2w), torch.nan)

    def push(self, places: Tensor, recent: Tensor, commands: Tensor, luck: Tensor) -> Tensor:
        """Where objects will be; see Contact.push."""
        return self.contact.push(places, recent, commands, luck)
