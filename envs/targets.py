"""From a config section to an object: `_target_` names a class by its import path, the other keys are its
options.

A class of somebody else's package is therefore a line of YAML. Nothing here imports torch, so worker
processes start fast.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

T = TypeVar("T")
TARGET = "_target_"


class ConfigError(ValueError):
    """A value in the config cannot work; the message names the key and the fix."""


def target(section: Mapping[str, Any], key: str) -> Callable[..., Any]:
    """The class (or function) that `section._target_` names.

    Args:
        section: of the config, with `_target_: package.module.Class`.
        key: where the section stands, for messages.

    Raises:
        ConfigError: if there is no `_target_`, or it does not import.
    """
    path = section.get(TARGET)
    if not path or "." not in str(path):
        raise ConfigError(
            f"{key}.{TARGET}={path!r} must be the import path of a class, such as package.module.Class"
        )
    module, _, name = str(path).rpartition(".")
    try:
        found = importlib.import_module(module)
    except ImportError as error:
        raise ConfigError(
            f"{key}.{TARGET}={path} does not import: {error}. Install the package that holds it, or correct"
            " the path."
        ) from error
    if not hasattr(found, name):
        names = [k for k, v in vars(found).items() if inspect.isclass(v)]
        raise ConfigError(f"{key}.{TARGET}={path}: {module} has no {name}{nearest(name, names)}")
    return getattr(found, name)  # type: ignore[no-any-return]


def build(section: Mapping[str, Any], key: str, **context: Any) -> Any:
    """The object that a config section describes: target(**context, **other keys).

    Args:
        section: `_target_` and the class's options; lists become tuples, nested sections stay dictionaries.
        key: where the section stands, for messages.
        context: what the caller knows and no config says, such as spec=...

    Raises:
        ConfigError: naming the key, the class and the fix.
    """
    factory = target(section, key)
    given = {str(name): to_plain(value) for name, value in section.items() if name != TARGET}
    doubled = sorted(given.keys() & context.keys())
    if doubled:
        raise ConfigError(f"{key}.{doubled[0]} is filled in by Worldloop; leave it out of the config")
    _check_names(factory, section[TARGET], given, context, key)
    try:
        return factory(**context, **given)
    except ConfigError:
        raise
    except (TypeError, ValueError, ImportError) as error:
        raise ConfigError(f"{key} ({section[TARGET]}): {error}") from error


def options(kind: type[T], section: Mapping[str, Any], key: str) -> T:
    """A dataclass from a config section; lists become tuples.

    Raises:
        ConfigError: naming the key that is unknown, missing or cannot work.
    """
    given = {str(name): to_plain(value) for name, value in section.items()}
    _check_names(kind, kind.__name__, given, {}, key)
    try:
        return kind(**given)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{key}: {error}") from error


def nearest(name: str, names: Iterable[str]) -> str:
    """What to say of a name that is not among others: the nearest ones, or all."""
    known = sorted(names)
    near = difflib.get_close_matches(name, known, 3, 0.5)
    return f"; did you mean {' or '.join(near)}?" if near else f"; there are {known}"


def to_plain(value: Any) -> Any:
    """A config value with tuples in place of lists, also inside nested sections."""
    if isinstance(value, Mapping):
        return {str(name): to_plain(part) for name, part in value.items()}
    return tuple(to_plain(part) for part in value) if isinstance(value, (list, tuple)) else value


def _check_names(
    factory: Callable[..., Any],
    name: str,
    given: Mapping[str, Any],
    context: Mapping[str, Any],
    key: str,
) -> None:
    """Refuse options that `factory` does not take, and missing ones, by name."""
    try:
        parameters = inspect.signature(factory).parameters
    except (TypeError, ValueError):  # built in C
        return
    kinds = {parameter.kind for parameter in parameters.values()}
    known = [k for k in parameters if k not in context]
    if inspect.Parameter.VAR_KEYWORD not in kinds:
        alien = sorted(context.keys() - parameters.keys())
        if alien:
            raise ConfigError(
                f"{key}.{TARGET}={name} takes no argument {alien[0]!r}, which every {key} is given;"
                " wrap it in a class that does"
            )
        for option in given:
            if option not in known:
                raise ConfigError(f"{key}.{option} is not an option of {name}{nearest(option, known)}")
    named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    for option in known:
        parameter = parameters[option]
        if parameter.default is parameter.empty and parameter.kind in named and option not in given:
            raise ConfigError(f"{key}.{option} is missing; {name} needs it")
