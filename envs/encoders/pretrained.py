"""Networks of `transformers` from folders on disk, whole or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from envs.targets import ConfigError

_SHOWN = 4  # names of weights in a message


def read_pretrained(kind: Any, folder: Path | str, key: str, **options: Any) -> Any:
    """A network as `save_pretrained` left it, in evaluation mode.

    Args:
        kind: a class of transformers with `from_pretrained`, which fills weights that the folder does not
            hold with random numbers.
        key: of the config that names the folder.
        options: of `from_pretrained`.

    Raises:
        ConfigError: if the folder lacks weights of the network, as of another architecture.
        OSError, ValueError, RuntimeError, KeyError: what transformers raises where it cannot read them.
    """
    network, info = kind.from_pretrained(
        folder, local_files_only=True, use_safetensors=True, output_loading_info=True, **options
    )
    if missing := sorted(info["missing_keys"]):
        others = sorted(info["unexpected_keys"])
        more = f", and holds {len(others)} others, such as {others[:_SHOWN]}" if others else ""
        raise ConfigError(
            f"{key}={folder} is of another architecture than its config.json says: it lacks {len(missing)} of"
            f" the weights of {type(network).__name__}, such as {missing[:_SHOWN]}{more}; name a folder that"
            " save_pretrained of that class wrote"
        )
    return network.eval()
