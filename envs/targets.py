"""From a config section to an object: `_target_` names a class by its import path, the other keys are its
options.

A class of somebody else's package is therefore a line of YAML. Nothing here imports torch, so worker
processes start fast.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, is_dataclass
from functools import lru_cache, partial
from typing import Any, TypeVar, get_type_hints

T = TypeVar("T")
TARGET = "_target_"
ROOMS = ("envs", "actors", "learners", "pipeline")  # packages of this repository
_signature = lru_cache(inspect.signature)  # each section of each config asks for its class's
_PLAIN = (TypeError, ValueError, ImportError, OSError)  # whose texts are sentences; a KeyError's is the key


@dataclass(frozen=True)
class OptionsOf:
    """Marks a mapping as the options of a class: Annotated[Mapping[str, Any], OptionsOf(Denoising)]."""

    kind: Callable[..., Any]


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
    except Exception as error:
        missing = isinstance(error, ImportError)
        if not missing and module.split(".")[0] in ROOMS:
            raise
        fix = ". Install the package that holds it, or correct the path." if missing else ""
        raise ConfigError(f"{key}.{TARGET}={path} does not import: {_said(error, module)}{fix}") from error
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
        ConfigError: naming the key, the class and the fix; whatever somebody else's class raises is told so.
    """
    factory = target(section, key)
    given = {str(name): to_plain(value) for name, value in section.items() if name != TARGET}
    doubled = sorted(given.keys() & context.keys())
    if doubled:
        raise ConfigError(f"{key}.{doubled[0]} is filled in by Worldloop; leave it out of the config")
    _check_names(factory, section[TARGET], given, context, key)
    if wrong := value_faults(factory, given, key):
        raise ConfigError("; ".join(wrong))
    try:
        return factory(**context, **given)
    except ConfigError:
        raise
    except Exception as error:
        if not isinstance(error, _PLAIN) and str(section[TARGET]).split(".")[0] in ROOMS:
            raise
        said = _said(error, getattr(factory, "__module__", ""))
        raise ConfigError(f"{key} ({section[TARGET]}): {said}") from error


def options(kind: type[T], section: Mapping[str, Any], key: str) -> T:
    """A dataclass from a config section; lists become tuples.

    Raises:
        ConfigError: naming the key that is unknown, missing or cannot work.
    """
    given = {str(name): to_plain(value) for name, value in section.items()}
    _check_names(kind, kind.__name__, given, {}, key)
    if wrong := value_faults(kind, given, key):
        raise ConfigError("; ".join(wrong))
    try:
        return kind(**given)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{key}: {error}") from error


def section_faults(section: Mapping[str, Any], key: str, around: Iterable[str] = ()) -> list[str]:
    """What can be seen to be wrong with a section of `_target_` before it is built, and with those in it.

    Args:
        section: of the config.
        key: where it stands, for messages.
        around: keys that belong to whoever builds it, not to the class.

    Returns:
        A sentence for each.
    """
    try:
        factory = target(section, key)
    except ConfigError as error:
        return [str(error)]
    given = {name: value for name, value in section.items() if name != TARGET and name not in around}
    kind = getattr(factory, "config_type", factory)
    out = unknown_names(kind, given, str(section[TARGET]), key) + value_faults(kind, given, key)
    for name, value in section.items():
        if isinstance(value, Mapping) and TARGET in value:
            out += section_faults(value, f"{key}.{name}")
    return out


def unknown_names(kind: Callable[..., Any], given: Iterable[str], name: str, key: str) -> list[str]:
    """A sentence for each option that a class does not take."""
    try:
        parameters = _signature(kind).parameters
    except (TypeError, ValueError):  # built in C
        return []
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        return []
    return [
        f"{key}.{option} is not an option of {name}{nearest(option, parameters)}"
        for option in given
        if option not in parameters
    ]


def value_faults(kind: Callable[..., Any], given: Mapping[str, Any], key: str) -> list[str]:
    """What is wrong with values, by the types and ranges (envs/ranges.py) that a class says at their names.

    Args:
        kind: a dataclass, or any class or function with annotations.
        given: values by name; names that it does not have are not looked at.
        key: where they stand, for messages.

    Returns:
        A sentence for each, naming key, value and what is allowed.
    """
    from pydantic import ValidationError  # physics workers do without it

    out = []
    checks, within = _checks(kind), _within(kind)
    for name, value in given.items():
        if name in within and isinstance(value, Mapping):
            inner = within[name]
            out += unknown_names(inner, value, getattr(inner, "__name__", name), f"{key}.{name}")
            out += value_faults(inner, value, f"{key}.{name}")
        if name not in checks:
            continue
        try:
            checks[name](to_plain(value))
        except ValidationError as error:
            out += _sentences(error.errors(include_url=False), value, f"{key}.{name}".lstrip("."))
    return out


@lru_cache
def _within(kind: Callable[..., Any]) -> dict[str, Callable[..., Any]]:
    """The classes whose options a class takes as mappings, by the names that it takes them under."""
    return {
        name: mark.kind
        for name, hint in _hints(kind).items()
        for mark in getattr(hint, "__metadata__", ())
        if isinstance(mark, OptionsOf)
    }


@lru_cache
def _checks(kind: Callable[..., Any]) -> dict[str, Callable[[Any], Any]]:
    """What raises pydantic's ValidationError for values that do not fit, by the names that a class takes."""
    from pydantic import ConfigDict, PydanticUserError, TypeAdapter

    out: dict[str, Callable[[Any], Any]] = {}
    for name, hint in _hints(kind).items():
        plain = is_dataclass(hint)  # its own type has no configuration of ours
        how = None if plain else ConfigDict(arbitrary_types_allowed=True, allow_inf_nan=False)
        try:
            adapter: TypeAdapter[Any] = TypeAdapter(hint, config=how)
        except (PydanticUserError, TypeError):  # a type that cannot be checked
            continue
        out[name] = partial(adapter.validate_python, strict=not plain)
    return out


def _sentences(found: Iterable[Mapping[str, Any]], value: Any, key: str) -> list[str]:
    """What pydantic found wrong with a value, one sentence for each place in it."""
    places: dict[str, tuple[Any, list[str]]] = {}
    for error in found:
        path, inner = key, value
        for part in error["loc"]:  # names of a union's branches stand between those of places
            named = isinstance(inner, Mapping) and part in inner
            if named or (isinstance(part, int) and _has(inner, part)):
                path, inner = f"{path}.{part}", inner[part]
        places.setdefault(path, (inner, []))[1].append(_allowed(error))
    return [f"{path}={wrong!r} should {' or '.join(allowed)}" for path, (wrong, allowed) in places.items()]


def _allowed(error: Mapping[str, Any]) -> str:
    """What pydantic wants instead, as it goes on after "should"."""
    if error["type"] == "missing":
        last = error["loc"][-1]
        return "be longer" if isinstance(last, int) else f"have {last}"
    message = re.sub("an instance of Sequence|a valid tuple", "a list", str(error["msg"]))
    wanted = re.sub(r"^\w+ should ", "", message)
    return wanted if wanted != message else f"be something else: {message}"


def _said(error: Exception, module: str) -> str:
    """What an error says, and where a module of somebody else raised it, as " (my_suite.py, line 34)"."""
    said = str(error) if isinstance(error, _PLAIN) else f"{type(error).__name__}: {error}"
    # a SyntaxError, and whoever looks for a package, names the place itself
    if module.split(".")[0] in ROOMS or isinstance(error, (SyntaxError, ImportError)):
        return said
    file = getattr(sys.modules.get(module), "__file__", None)
    steps = [step for step in traceback.extract_tb(error.__traceback__) if file in (None, step.filename)]
    return said + "".join(f" ({step.filename}, line {step.lineno})" for step in steps[-1:])


def _has(value: Any, position: int) -> bool:
    return isinstance(value, (list, tuple)) and position < len(value)


def _hints(kind: Callable[..., Any]) -> dict[str, Any]:
    """Types of what a class or function takes, by name."""
    made = inspect.isclass(kind) and not is_dataclass(kind)
    try:
        return get_type_hints(kind.__init__ if made else kind, include_extras=True)  # type: ignore[misc]
    except (NameError, TypeError):  # types that only type checkers see
        return {}


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
        parameters = _signature(factory).parameters
    except (TypeError, ValueError):  # built in C
        return
    kinds = {parameter.kind for parameter in parameters.values()}
    known = [k for k in parameters if k not in context]
    if inspect.Parameter.VAR_KEYWORD not in kinds:
        if alien := sorted(context.keys() - parameters.keys()):
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
