"""A real server in a thread, and a client written from the protocol's description alone, as strangers write
theirs.
"""

from __future__ import annotations

import asyncio
import io
import json
import socket
import threading
from typing import Any

import numpy as np
import requests
import torch
from aiohttp import web
from PIL import Image

from actors.serving.app import Server
from actors.serving.sessions import ServeConfig, SessionHost
from envs.conditioning.joint_commands import JointCommands
from envs.simulators.dit.engine import DiTSimulator
from envs.simulators.state_experts.flow import StateExpert
from tests.embodiments import EMBODIMENTS, world_spec

# four commands of two_arms_poses
POSES = np.tile(np.array([0.3, 0.2, 0.4, 0, 0, 0, 0.5, 0.3, -0.2, 0.4, 0, 0, 0, 0.5], np.float32), (4, 1))
SERVE: dict[str, Any] = {
    "host": "127.0.0.1",
    "port": 0,
    "sessions": 12,
    "batch": 8,
    "linger_ms": 500.0,
    "idle_s": 900.0,
    "grace_s": 10.0,
    "body_mb": 8.0,
    "seed": 0,
    "fixed_seed": False,
}


def serve_config(**options: Any) -> ServeConfig:
    return ServeConfig(**(SERVE | options))


def tiny_world(robot: str = "two_arms_poses") -> DiTSimulator:
    """An untrained world whose frames depend on seed, commands and history."""
    torch.manual_seed(0)
    net = {"layers": 3, "heads": 2, "head_dim": 24, "adaln_rank": 8, "patch": 2, "stem": 0}
    denoising = {"prediction": "clean", "sampler": "euler", "steps": 2, "shift": 2.0}
    denoising |= {"foreground": 0.0, "augment": 0.0}
    spec = world_spec(EMBODIMENTS[robot])
    world = DiTSimulator(spec, 3, net, {"channels": 8, "width": 16}, denoising)
    with torch.no_grad():
        world.net.proj_out.weight.mul_(40)
        world.codec.decoder[-1].weight.mul_(3)
    return world.eval()


def make(world: DiTSimulator, joints: JointCommands | None = None, **config: Any) -> Running:
    return Running(SessionHost(world, tiny_expert(world), serve_config(**config), joints, bf16=False))


def tiny_expert(world: DiTSimulator) -> StateExpert:
    torch.manual_seed(1)
    return StateExpert(world, layers=1, heads=2, head_dim=16, steps=2).eval()


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


class Running:
    """Serves a SessionHost until `stop`."""

    def __init__(self, host: SessionHost):
        self.host, self.port = host, free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.loop = asyncio.new_event_loop()
        ready = threading.Event()

        async def begin() -> None:
            self.runner = web.AppRunner(Server(host, "test").app(), access_log=None, shutdown_timeout=2.0)
            await self.runner.setup()
            await web.TCPSite(self.runner, "127.0.0.1", self.port).start()
            ready.set()

        def run() -> None:
            asyncio.set_event_loop(self.loop)
            self.loop.run_until_complete(begin())
            self.loop.run_forever()

        self.thread = threading.Thread(target=run, daemon=True)
        self.thread.start()
        assert ready.wait(10)

    def stop(self) -> None:
        asyncio.run_coroutine_threadsafe(self.runner.cleanup(), self.loop).result(10)
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(10)


def block(data: bytes) -> bytes:
    return len(data).to_bytes(4, "big") + data


def jpeg(frame: np.ndarray) -> bytes:
    """A float frame (3, V, H, W) in 0..1 as the tiled JPEG of the protocol."""
    tiled = np.concatenate(
        [(view.transpose(1, 2, 0) * 255).round().astype(np.uint8) for view in frame.transpose(1, 0, 2, 3)],
        axis=1,
    )
    buffer = io.BytesIO()
    Image.fromarray(tiled).save(buffer, format="JPEG", quality=95)
    return buffer.getvalue()


class Stranger:
    """A client of the released protocol that knows nothing of Worldloop."""

    def __init__(self, url: str, user: str = "stranger", **more: Any):
        self.url, self.http = url, requests.Session()
        self.id = self.http.post(f"{url}/init", json={"user_name": user, **more}, timeout=30).json()[
            "client_id"
        ]

    def post(self, path: str, **payload: Any) -> requests.Response:
        return self.http.post(self.url + path, json={"client_id": self.id, **payload}, timeout=30)

    def send(self, path: str, body: bytes) -> requests.Response:
        return self.http.post(
            self.url + path, data=body, headers={"Content-Type": "application/octet-stream"}, timeout=60
        )

    def first_frame(self, frame: np.ndarray) -> bytes:
        return block(jpeg(frame)) + block(
            json.dumps({"client_id": self.id, "frame_shape": list(frame.shape)}).encode()
        )

    def trajectory(self, traj: np.ndarray, c2w: np.ndarray) -> bytes:
        pictures = b"".join(block(jpeg(traj[:, :, t])) for t in range(traj.shape[2]))
        meta = {"client_id": self.id, "traj_shape": list(traj.shape), "c2w_shape": list(c2w.shape)}
        return block(pictures) + block(c2w.astype("<f4").tobytes()) + block(json.dumps(meta).encode())

    def actions(self, actions: np.ndarray, **more: Any) -> bytes:
        meta = {"client_id": self.id, "action_shape": list(actions.shape), **more}
        return block(actions.astype("<f4").tobytes()) + block(json.dumps(meta).encode())

    def prepare(
        self, views: int = 3, size: tuple[int, int] = (32, 32), frames: int = 4, seed: int = 0
    ) -> None:
        """Cameras, a first frame and a trajectory of random pictures."""
        rng = np.random.default_rng(seed)
        k = [[60.0, 0, size[1] / 2], [0, 60, size[0] / 2], [0, 0, 1]]
        assert self.post("/set_camera_params", intrinsic=[k] * views).status_code == 200
        smooth = np.repeat(
            np.repeat(rng.random((3, views, size[0] // 8, size[1] // 8), np.float32), 8, -1), 8, -2
        )
        assert self.send("/set_episode_data", self.first_frame(smooth)).status_code == 200
        c2w = np.tile(np.eye(4, dtype=np.float32), (views, frames, 1, 1))
        assert (
            self.send(
                "/set_episode_traj",
                self.trajectory(np.full((3, views, frames, *size), 50 / 255, np.float32), c2w),
            ).status_code
            == 200
        )

    def step(self, actions: np.ndarray, **more: Any) -> tuple[np.ndarray, np.ndarray | None]:
        answer = self.send("/step", self.actions(actions, **more))
        assert answer.status_code == 200, answer.text
        return self.read(answer.content)

    @staticmethod
    def read(body: bytes) -> tuple[np.ndarray, np.ndarray | None]:
        blocks, at = [], 0
        while at < len(body):
            size = int.from_bytes(body[at : at + 4], "big")
            blocks.append(body[at + 4 : at + 4 + size])
            at += 4 + size
        meta = json.loads(blocks[0])
        count, _, views, height, width = meta["frame_shape"]
        pictures = [
            np.asarray(Image.open(io.BytesIO(data))).reshape(height, views, width, 3)
            for data in blocks[1 : 1 + count]
        ]
        state = np.frombuffer(blocks[-1], "<f4").reshape(meta["state_shape"]) if meta["state_shape"] else None
        return np.stack(pictures).transpose(0, 4, 2, 1, 3), state
