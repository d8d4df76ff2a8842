"""Parts carried as a whole: nothing moves at first, a shift moves by its pixels, fingertips are seen where they are."""

from __future__ import annotations

import torch

from envs.geometry import fingertips, project
from envs.simulators.transport import Carried, Transport, in_view, tip_tracks, track_loss


def carry(shift: tuple[float, float]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A Transport whose network moves its one mask by `shift` half-pictures per frame, whatever it sees."""
    torch.manual_seed(0)
    transport = Transport(chunk=2, slots=1)
    bias = transport.moves[-1].bias
    assert isinstance(bias, torch.nn.Parameter)
    with torch.no_grad():
        bias.copy_(torch.tensor([*shift, 0.0, 0.0] * 2) / 0.2)  # the network's output counts in fifths
    masks, picture = torch.zeros(1, 1, 32, 32), torch.rand(1, 3, 32, 32)
    masks[:, :, 10:14, 8:12] = 1.0
    carried = transport(masks, picture, torch.zeros(1, 5, 2, 2))
    return masks, picture, carried.colours, carried.cover


def test_nothing_moves_at_first() -> None:
    masks, picture, colours, cover = carry((0.0, 0.0))
    assert torch.allclose(cover[:, :, 1, 0], masks, atol=1e-4)
    assert torch.allclose(colours[0, 0, 1], picture[0], atol=1e-3)


def test_shifts_add_up_over_the_chunk() -> None:
    masks, picture, colours, cover = carry((2 / 16, -1 / 16))  # two pixels right and one up, per frame
    for frame, (down, right) in enumerate(((-1, 2), (-2, 4))):
        moved = masks.roll((down, right), (2, 3))
        assert torch.allclose(cover[:, :, frame, 0], moved, atol=1e-3)
        inside = moved[0, 0] > 0
        assert torch.allclose(colours[0, 0, frame][:, inside], picture[0].roll((down, right), (1, 2))[:, inside], atol=1e-3)


def test_tip_tracks_are_projections_of_fingertips() -> None:
    command = torch.zeros(1, 14)
    command[:, [2, 9]], command[:, 7] = 1.0, 0.2
    ahead = command[:, None].repeat(1, 2, 1)
    ahead[:, 1, 0] = 0.1
    intrinsic = torch.tensor([[40.0, 0, 32], [0, 40.0, 16], [0, 0, 1]]).expand(1, 1, 3, 3)
    c2w = torch.eye(4).expand(1, 1, 4, 4)
    tracks = tip_tracks(command, ahead, intrinsic, c2w, c2w[:, None].expand(1, 2, 1, 4, 4), (32, 64))
    assert tracks.shape == (1, 1, 5, 2, 2)
    pixels, _ = project(fingertips(ahead[0, 1]), intrinsic[0, 0], c2w[0, 0])
    assert torch.allclose(tracks[0, 0, 2], pixels / torch.tensor([32.0, 16.0]) - 1, atol=1e-5)
    assert torch.equal(tracks[0, 0, 0], tracks[0, 0, 4])  # a camera that stands still sees present tips where they are


def test_track_loss_wants_parts_where_objects_are() -> None:
    intrinsic = torch.tensor([[32.0, 0, 16], [0, 32.0, 16], [0, 0, 1]]).expand(1, 1, 3, 3)
    c2w = torch.eye(4).expand(1, 1, 1, 4, 4)
    objects = torch.tensor([[[[0.1, 0.0, 0.5]]]])  # at 0.1 / 0.5 * 32 / 16 = 0.4 half-pictures
    now = in_view(objects, intrinsic, c2w, (32, 32)).of(0)
    valid = torch.ones(1, 1, dtype=torch.bool)
    masks = torch.zeros(1, 1, 32, 32)
    masks[0, 0, 14:17, 20:23] = 1.0  # nine pixels; 5 cm cover ten

    def loss(u: float, shift: float) -> float:
        empty = torch.zeros(0)
        return float(track_loss(Carried(masks, empty, empty, torch.tensor([[[u, 0.0]]]), torch.tensor([[[[shift, 0.0]]]])), now, now, valid))

    assert loss(0.4, 0.0) < 1e-5
    assert abs(loss(0.5, 0.0) - 0.1) < 1e-5 and abs(loss(0.4, 0.2) - 0.2) < 1e-5
    unknown = in_view(objects * torch.nan, intrinsic, c2w, (32, 32)).of(0)
    empty = torch.zeros(0)
    assert float(track_loss(Carried(masks, empty, empty, torch.zeros(1, 1, 2), torch.zeros(1, 1, 1, 2)), unknown, unknown, valid)) == 0.0
