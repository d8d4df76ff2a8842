"""Composes the Hydra config from configs/ and the command line, and turns mistakes into sentences."""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from envs.targets import TARGET, ConfigError, nearest, target

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
IF_CHOSEN = "if_chosen"  # options by group and choice, which count where that is what was chosen
_DATA = ("task", "extra_starts", "finetune", "imagined")  # sections whose `data` are folders
_SECTIONS = {"distiller": "distill"}  # of groups whose choices fill a part of one


def load_config(overrides: Sequence[str]) -> dict[str, Any]:
    """The resolved config as plain containers.

    Args:
        overrides: Hydra overrides, such as experiment=smoke rl.lr=1e-4.

    Raises:
        ConfigError: for unknown keys or choices and values that cannot work, naming the nearest fix.
    """
    cfg = read_config(overrides)
    from pipeline.checks import faults  # needs torch, which an unknown key should not wait for
    from pipeline.decided import decided

    cfg = decided(cfg)
    if wrong := faults(cfg):
        raise ConfigError("\n".join(wrong))
    return cfg


def read_config(overrides: Sequence[str]) -> dict[str, Any]:
    """The resolved config, whose values nobody has looked at.

    Raises:
        ConfigError: for unknown keys or choices, naming the nearest fix.
    """
    try:
        return composed(overrides)
    except ConfigError:
        raise
    except Exception as error:  # for simulator=null and the like Hydra raises a bare ValueError
        said = _unknown_choice(overrides) or _unknown_key(overrides) or _unreadable(overrides, error)
        raise ConfigError(said) from error


def groups() -> list[str]:
    """Names of the folders of choices."""
    return sorted(p.name for p in CONFIGS.iterdir() if p.is_dir() and not p.name.startswith("_"))


def choices(group: str, overrides: Sequence[str] = ()) -> list[str]:
    """What can be chosen for a group, such as policy: in configs/, and in folders that
    hydra.searchpath=[file://FOLDER] among the overrides names.
    """
    folders = [CONFIGS, *_searched(overrides)]
    return sorted({path.stem for folder in folders for path in (folder / group).glob("*.yaml")})


def offered(group: str, choice: str, overrides: Sequence[str]) -> bool:
    """Whether a group has a choice: in configs/, or in a folder or package that hydra.searchpath names."""
    if choice in choices(group, overrides):
        return True
    elsewhere = [word for word in overrides if word.startswith("hydra.searchpath=")]
    try:
        return bool(elsewhere) and bool(composed([*elsewhere, f"{group}={choice}"]))
    except Exception:  # Hydra has an error of its own for each way of not finding it
        return False


def composed(overrides: Sequence[str]) -> dict[str, Any]:
    """The resolved config, unchecked; an experiment's options of what was chosen are put in, and a folder of
    data is a list of one.
    """
    words = [part for word in overrides for part in _replacing(word)]
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        made = compose("config", words, return_hydra_config=True)
    with open_dict(made):
        chosen, section = made.pop("hydra").runtime.choices, made.pop(IF_CHOSEN)
    given = [word.split("=")[0].lstrip("+~") for word in overrides]
    given = [key for key in given if key not in chosen]  # judge=proxy says which, and no option of it
    for group, option, value in _of_chosen(OmegaConf.to_container(section), chosen, overrides):
        path = f"{_SECTIONS.get(group, group)}.{option}"
        if any(key == path or path.startswith(f"{key}.") or key.startswith(f"{path}.") for key in given):
            continue
        try:
            OmegaConf.update(made, path, value)
        except OmegaConfBaseException as error:
            raise ConfigError(
                f"{IF_CHOSEN}.{group}.{chosen[group]}.{option} is no option of {group}={chosen[group]}"
            ) from error
    plain = OmegaConf.to_container(made, resolve=True)
    assert isinstance(plain, dict)
    for name in _DATA:
        if isinstance(plain[name], dict) and isinstance(folder := plain[name].get("data"), str):
            plain[name]["data"] = [folder] if folder else []  # as is said for one
    return {str(key): value for key, value in plain.items()}


def _replacing(word: str) -> list[str]:
    """What Hydra is told instead of an override: one that names another class (`_target_`) replaces the whole
    section, as the options of two classes do not mix.
    """
    key, _, value = word.partition("=")
    if "_target_" not in value or key.startswith(("+", "~")) or key in groups():
        return [word]
    try:
        said = OverridesParser.create().parse_override(word).value()
    except HydraException:  # is told when all of it is composed
        return [word]
    # Hydra merges a mapping into one that is there, and refuses keys that this one has not
    return [f"{key}=null", word] if isinstance(said, Mapping) and "_target_" in said else [word]


def _of_chosen(
    section: Any, chosen: Mapping[str, Any], overrides: Sequence[str]
) -> Iterator[tuple[str, str, Any]]:
    """Groups, paths and values of those options in the section if_chosen that belong to what was chosen.

    Raises:
        ConfigError: for a group or a choice that there is not.
    """
    for group, by_choice in section.items():
        if group not in chosen:
            if group in groups():  # a section of one's own stands there: ~task +task={...}
                continue
            raise ConfigError(f"{IF_CHOSEN}.{group} is no group of choices{nearest(group, groups())}")
        for name in by_choice:
            if name != chosen[group] and not offered(group, name, overrides):
                near = nearest(name, choices(group, overrides))
                raise ConfigError(f"{IF_CHOSEN}.{group}.{name} is no choice of {group}{near}")
        for path, value in _leaves(by_choice.get(chosen[group], {})):
            yield group, path, value


def _leaves(section: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in section.items():
        if isinstance(value, Mapping):
            yield from ((f"{key}.{path}", inner) for path, inner in _leaves(value))
        else:
            yield str(key), value


def _searched(overrides: Sequence[str]) -> list[Path]:
    """Folders with choices of somebody's own."""
    values = [word.partition("=")[2] for word in overrides if word.startswith("hydra.searchpath=")]
    names = [part.strip(" '\"") for value in values for part in value.strip("[]").split(",")]
    return [Path(name.removeprefix("file://")) for name in names if name.startswith("file://")]


def _unknown_choice(overrides: Sequence[str]) -> str:
    """What to say of the first override that chooses what its group does not offer, "" if none does."""
    for word in overrides:
        key, _, value = word.partition("=")
        name = bool(re.fullmatch(r"[\w./-]+", value)) and value != "null"
        if key in groups() and name and not offered(key, value, overrides):
            return f"{word} is not a choice of configs/{key}{nearest(value, choices(key, overrides))}"
    return ""


def _choosing(name: str, overrides: Sequence[str]) -> list[str]:
    """Overrides that choose what has a name, or the nearest one, whatever its group."""
    every = {f"{group}={choice}": choice for group in groups() for choice in choices(group, overrides)}
    near = difflib.get_close_matches(name, every.values(), 1, 0.75)
    return [word for word, choice in every.items() if choice in near]


def _unknown_key(overrides: Sequence[str]) -> str:
    """What to say of the first override whose key does not exist, "" if all do."""
    chosen = [word for word in overrides if word.split("=")[0] in (*groups(), "hydra.searchpath")]
    try:
        base = composed(chosen)
    except Exception:  # a choice is what is wrong
        return ""
    paths = list(_paths(base))
    for word in overrides:
        key = word.split("=")[0]
        if not key:
            return f"{word} names no key; say key=value"
        if word in chosen or key.startswith(("+", "~")) or key in paths:
            continue
        if "=" not in word and (near := _choosing(word, overrides)):
            return f"{word} is not a key; did you mean {' or '.join(near)}?"
        if _takes(base, key):
            return f"{key} is an option that the config does not name; say +{word}"
        if elsewhere := _other_choices(key, chosen):
            return f"{key} is no key of the {key.partition('.')[0]} that is chosen, but of {elsewhere}"
        parent = key.rpartition(".")[0]
        siblings = [path for path in paths if path.rpartition(".")[0] == parent]
        same = [path for path in paths if path.rpartition(".")[2] == key.rpartition(".")[2]]
        near = difflib.get_close_matches(key, paths, 3, 0.75)
        if near or same:
            return f"{key} is not a key; did you mean {' or '.join(list(dict.fromkeys(near + same))[:3])}?"
        return f"{key} is not a key{nearest(key, siblings or [*base, *groups()])}"
    return ""


def _takes(cfg: Mapping[str, Any], key: str) -> bool:
    """Whether a dotted key is an option of the class of the section around it, with a default there."""
    *around, option = key.split(".")
    section: Any = cfg
    for part in around:
        section = section.get(part) if isinstance(section, Mapping) else None
    if not isinstance(section, Mapping) or TARGET not in section:
        return False
    with suppress(ConfigError, TypeError, ValueError):  # a class that is not there is told by itself
        parameter = inspect.signature(target(section, key)).parameters.get(option)
        return parameter is not None and parameter.default is not parameter.empty
    return False


def _other_choices(key: str, chosen: Sequence[str]) -> str:
    """Which other choices of its group have a key, such as simulator=gesim; "" if none has."""
    group = key.partition(".")[0]
    if group not in groups():
        return ""
    found = []
    for name in choices(group, chosen):
        others = [word for word in chosen if word.split("=")[0] != group]
        with suppress(Exception):  # one that does not go with the others is no advice
            if key in _paths(composed([*others, f"{group}={name}"])):
                found.append(f"{group}={name}")
    return " or ".join(found)


def _unreadable(overrides: Sequence[str], error: Exception) -> str:
    """What to say of the first override that does not go with those before it; where choices lie comes first,
    then they.
    """
    taken: list[str] = []
    where = ""
    order = sorted(overrides, key=lambda word: word.split("=")[0] not in groups())
    for word in sorted(order, key=lambda word: not word.startswith("hydra.")):  # where choices lie
        try:
            composed([*taken, word])
        except Exception as found:
            where, error = f"{word} cannot be read: ", found
            break
        taken.append(word)
    if "Ambiguous value" in str(error):
        word = where.removesuffix(" cannot be read: ")
        key, _, value = word.partition("=")
        return f"{word} names several values, and a run takes one: say a list as {key}=[{value}], or run each"
    text = str(error).split("\nSee https")[0].split("\nfull_key")[0].strip()
    return (
        f"{where}{text}\nGroups are {', '.join(groups())}; `worldloop config` prints every key and its value."
    )


def _paths(section: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for key, value in section.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _paths(value, f"{prefix}{key}.")
