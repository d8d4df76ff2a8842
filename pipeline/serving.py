"""Which world `worldloop serve` serves: the experiment's last, or a released checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from actors.factory import ConfigError, build_simulator, build_state_decoder, joints_to_hands, options
from actors.serving.sessions import ServeConfig, SessionHost
from pipeline.loop import build_loop


def build_session_host(cfg: Mapping[str, Any], root: Path) -> tuple[SessionHost, ServeConfig]:
    """The sessions of the configured simulator.

    Raises:
        ConfigError: if it has no weights yet, or is itself remote.
    """
    engine = cfg["simulator"]["engine"]
    if engine == "remote":
        raise ConfigError("simulator=remote is served already; serve unet, dit or gesim")
    config = options(ServeConfig, cfg["serve"], "serve")
    graph, last = build_loop(dict(cfg), root), cfg["rounds"]["count"]
    weights, decoder_weights = (
        graph.folder(f"{stage}-{last}") / "weights.safetensors" for stage in ("vision", "state")
    )
    if not weights.exists() and not cfg["simulator"].get("checkpoint"):
        raise ConfigError(
            f"{weights} does not exist; run this experiment first, or serve released weights by simulator=gesim simulator.checkpoint=<folder>"
        )
    simulator = build_simulator(cfg, weights if weights.exists() else None)
    decoder = build_state_decoder(cfg, simulator, decoder_weights if decoder_weights.exists() else None)
    return SessionHost(
        simulator, decoder.eval(), config, joints_to_hands(cfg), cfg["simulator"]["bf16"]
    ), config
