"""Composes the Hydra config from configs/ and the command line, and turns mistakes into sentences."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from envs.targets import ConfigError, nearest

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
IF_CHOSEN = "if_chosen"  # options by group and choice, which count where that is what was chosen


def load_config(overrides: Sequence[str]) -> dict[str, Any]:
    """The resolved config as plain containers.

    Args:
        overrides: Hydra overrides, such as experiment=smoke rl.lr=1e-4.

    Raises:
        ConfigError: for unknown keys or choices and values that cannot work, naming the nearest fix.
    """
    try:
        cfg = composed(overrides)
    except ConfigError:
        raise
    except Exception as error:  # for simulator=null and the like Hydra raises a bare ValueError
        raise ConfigError(_unknown_key(overrides) or _unreadable(overrides, error)) from error
    from pipeline.checks import faults  # needs torch, which an unknown key should not wait for

    if wrong := faults(cfg):
        raise ConfigError("\n".join(wrong))
    return cfg


def groups() -> list[str]:
    """Names of the folders of choices."""
    return sorted(p.name for p in CONFIGS.iterdir() if p.is_dir() and not p.name.startswith("_"))


def choices(group: str) -> list[str]:
    """What can be chosen for a group, such as policy."""
    return sorted(path.stem for path in (CONFIGS / group).glob("*.yaml"))


def offered(group: str, choice: str, overrides: Sequence[str]) -> bool:
    """Whether a group has a choice: in configs/, or in a folder that hydra.searchpath names."""
    if choice in choices(group):
        return True
    elsewhere = [word for word in overrides if word.startswith("hydra.searchpath=")]
    try:
        return bool(elsewhere) and bool(composed([*elsewhere, f"{group}={choice}"]))
    except Exception:  # Hydra has an error of its own for each way of not finding it
        return False


def composed(overrides: Sequence[str]) -> dict[str, Any]:
    """The resolved config, unchecked; an experiment's options of what was chosen are put in."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        made = compose("config", list(overrides), return_hydra_config=True)
    with open_dict(made):
        chosen, section = made.pop("hydra").runtime.choices, made.pop(IF_CHOSEN)
    given = [word.split("=")[0].lstrip("+~") for word in overrides]
    given = [key for key in given if key not in chosen]  # judge=proxy says which, and no option of it
    for path, value in _of_chosen(OmegaConf.to_container(section), chosen):
        if any(key == path or path.startswith(f"{key}.") or key.startswith(f"{path}.") for key in given):
            continue
        try:
            OmegaConf.update(made, path, value)
        except OmegaConfBaseException as error:
            group, _, option = path.partition(".")
            raise ConfigError(
                f"{IF_CHOSEN}.{group}.{chosen[group]}.{option} is no option of {group}={chosen[group]}"
            ) from error
    plain = OmegaConf.to_container(made, resolve=True)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


def _of_chosen(section: Any, chosen: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Paths and values of those options in the section if_chosen that belong to what was chosen.

    Raises:
        ConfigError: for a group of choices that there is not.
    """
    for group, by_choice in section.items():
        if group not in chosen:
            raise ConfigError(f"{IF_CHOSEN}.{group} is no group of choices{nearest(group, groups())}")
        for path, value in _leaves(by_choice.get(chosen[group], {})):
            yield f"{group}.{path}", value


def _leaves(section: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in section.items():
        if isinstance(value, Mapping):
            yield from ((f"{key}.{path}", inner) for path, inner in _leaves(value))
        else:
            yield str(key), value


def _unknown_key(overrides: Sequence[str]) -> str:
    """What to say of the first override whose key does not exist, "" if all do."""
    choices = [word for word in overrides if word.split("=")[0] in groups()]
    try:
        base = composed(choices)
    except Exception:  # a choice is what is wrong
        return ""
    paths = list(_paths(base))
    for word in overrides:
        key = word.split("=")[0]
        if not key:
            return f"{word} names no key; say key=value"
        if word in choices or key.startswith(("+", "~")) or key in paths:
            continue
        parent = key.rpartition(".")[0]
        siblings = [path for path in paths if path.rpartition(".")[0] == parent]
        same = [path for path in paths if path.rpartition(".")[2] == key.rpartition(".")[2]]
        near = difflib.get_close_matches(key, paths, 3, 0.75)
        if near or same:
            return f"{key} is not a key; did you mean {' or '.join((near + same)[:3])}?"
        return f"{key} is not a key{nearest(key, siblings or [*base, *groups()])}"
    return ""


def _unreadable(overrides: Sequence[str], error: Exception) -> str:
    """What to say of the first override that does not go with those before it; choices come first."""
    taken: list[str] = []
    where = ""
    for word in sorted(overrides, key=lambda word: word.split("=")[0] not in groups()):
        try:
            composed([*taken, word])
        except Exception as found:
            where, error = f"{word} cannot be read: ", found
            break
        taken.append(word)
    text = str(error).split("\nSee https")[0].split("\nfull_key")[0].strip()
    return (
        f"{where}{text}\nGroups are {', '.join(groups())}; `worldloop config` prints every key and its value."
    )


def _paths(section: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for key, value in section.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _paths(value, f"{prefix}{key}.")
