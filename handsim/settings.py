"""`Settings`: the options of a verb, checked by their annotations wherever they come from.

A verb has one frozen dataclass of them: the keyword arguments of its function and the JSON beside its output.
Its command has the same options, some of them under words that are easier to type.
"""

from __future__ import annotations

import dataclasses
import functools
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Self, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from handsim._checks import check_choice, check_count, check_number, check_type, unexpected
from handsim._plugins import plugin_name

UNIONS: Final = (Union, types.UnionType)
"""Origins of annotations of several types."""
_NO_CHANGE: Final[Mapping[str, Any]] = types.MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds of a number, or of every number of a tuple: `Annotated[int, Limits(0)]`."""

    low: float
    high: float = np.inf
    above: bool = False
    """Whether `low` itself is refused."""
    ascends: bool = False
    """Whether the numbers of a tuple must not decrease."""


@dataclass(frozen=True, slots=True)
class Expected:
    """How errors describe a field of several types: `Annotated[A | str, Expected("an A, or its name")]`."""

    words: str
    names: Callable[[], Iterable[str]] = tuple
    """The valid names."""


@dataclass(frozen=True, slots=True)
class Spelled:
    """The form of a field on the command line, if its own type has none.

    An example is `Annotated[A | None, Spelled(bool, True)]`. In Python the field takes such values, too.
    """

    kind: Any = None
    """Type of the option; the field's own type when None."""
    default: Any = None
    """Default of the option."""
    name: str | None = None
    """The option's name; empty for a group whose fields stand among the others."""


class Settings:
    """Base of the frozen dataclasses of settings.

    Each field is checked by its annotation when an object is made: numbers by their `Limits`, names by their
    `Literal`, others by their type, which errors describe as `Expected`. A group of settings may be given as
    a mapping of the fields that differ from its default, as on the command line, a tuple as a list, an array
    or its only item, a path as a string, a number as one of numpy's.

    Raises:
        ArgumentError: A field has another type, is out of range, or is none of the valid names.
    """

    __slots__ = ()
    noun: ClassVar[str] = "setting"
    """The noun for an unknown field in errors."""

    def __post_init__(self) -> None:
        hints = _annotations(type(self))  # type: ignore[arg-type]  # a class is hashable
        for field in dataclasses.fields(self):  # type: ignore[arg-type]  # every subclass is a dataclass
            value = getattr(self, field.name)
            checked = _checked_value(field.name, value, hints[field.name], field)
            if checked is not value:
                object.__setattr__(self, field.name, checked)
        self.check()

    def check(self) -> None:
        """Refuse fields that contradict each other."""

    @classmethod
    def of(cls, settings: Self | None = None, options: Mapping[str, Any] = _NO_CHANGE) -> Self:
        """Settings, or the usual ones, with some fields given by name.

        Raises:
            ArgumentError: It is no such object, a name is unknown, or a field is refused.
        """
        if settings is not None:
            check_type("settings", settings, cls, f"a {cls.__name__}; its fields can be given by name")
        changed: Self = _changed(cls, settings, options, cls.noun)
        return changed

    @classmethod
    def from_json(cls, record: Mapping[str, Any]) -> Self:
        """The settings in a record, whose other keys are ignored.

        A setting that was given as an object is recorded by its name, which is looked up here.
        """
        known = {field.name for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
        return cls(**{name: value for name, value in record.items() if name in known})

    def record(self) -> dict[str, Any]:
        """The settings as JSON, objects by their names."""
        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        return {field.name: _as_json(getattr(self, field.name)) for field in fields}

    def changed(self, *names: str) -> list[str]:
        """The names among these of fields whose values differ from their defaults."""
        defaults = {field.name: field.default for field in dataclasses.fields(self)}  # type: ignore[arg-type]
        return [name for name in names if getattr(self, name) != defaults[name]]


class Mixture(Settings):
    """Base of shares of kinds, which are normalized; a share that is not named keeps its default."""

    __slots__ = ()

    @property
    def shares(self) -> NDArray[np.float64]:
        """The fields in order, their sum being 1."""
        shares = np.array(dataclasses.astuple(self), dtype=np.float64)  # type: ignore[call-overload]
        return np.asarray(shares / shares.sum())

    def check(self) -> None:
        """Refuse shares that are negative, or all 0."""
        shares: dict[str, float] = dataclasses.asdict(self)  # type: ignore[call-overload]
        for name, share in shares.items():
            check_number(name, share, 0.0)
        check_number(f"the sum of {', '.join(shares)}", sum(shares.values()), 0.0, above=True)


def _as_json(value: Any) -> Any:
    """A field's value as JSON; an object by its name."""
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Settings):
        return value.record()
    if isinstance(value, Mapping):
        return {key: _as_json(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_as_json(item) for item in value]
    name = getattr(value, "name", None)
    return name if isinstance(name, str) else plugin_name(value)


@functools.cache
def _annotations(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _checked_value(name: str, value: Any, hint: Any, field: dataclasses.Field[Any] | None = None) -> Any:
    """A value, converted to the type of its annotation; an `ArgumentError` if it does not fit."""
    limits, expected = None, None
    while get_origin(hint) is Annotated:
        hint, *extras = get_args(hint)
        limits = next((one for one in extras if isinstance(one, Limits)), limits)
        expected = next((one for one in extras if isinstance(one, Expected)), expected)
    if isinstance(value, np.ndarray | np.generic):  # else records would hold their names
        value = value.tolist()
    origin = get_origin(hint)
    if origin in UNIONS:
        return _checked_union(name, value, get_args(hint), limits, expected, field)
    if origin is Literal:
        check_choice(value, get_args(hint), noun=name.replace("_", " "))
        return value
    if origin in (tuple, Sequence):  # items of a sequence are left to `check`
        return _checked_tuple(name, value, get_args(hint) if origin is tuple else (object, ...), limits)
    if hint in (int, float):
        return _checked_number(name, value, hint, limits)
    if dataclasses.is_dataclass(hint) and isinstance(value, Mapping):
        return _from_map(name, value, hint, field)
    return _checked_object(name, value, hint, expected)


def _checked_object(name: str, value: Any, kind: Any, expected: Expected | None) -> Any:
    """A value of one type; a path may be a string, and a protocol is anything with its public members."""
    if kind is Path and isinstance(value, str):
        return Path(value)
    if get_origin(kind) is Mapping:
        check_type(name, value, Mapping, "names with their values")
        return {key: _checked_value(f"{name}: {key}", item, get_args(kind)[1]) for key, item in value.items()}
    if getattr(kind, "_is_protocol", False):
        if not all(hasattr(value, member) for member in _members(kind)):
            raise unexpected(name, value, _type_words(kind, expected))
    elif isinstance(kind, type) and get_origin(kind) is None:
        check_type(name, value, kind, _type_words(kind, expected), expected.names() if expected else ())
    return value  # values of a generic type are left to `check`


def _checked_union(
    name: str,
    value: Any,
    arms: tuple[Any, ...],
    limits: Limits | None,
    expected: Expected | None,
    field: dataclasses.Field[Any] | None,
) -> Any:
    """A value of one of several types."""
    if value is None and types.NoneType in arms:
        return None
    others = [arm for arm in arms if arm is not types.NoneType]
    if len(others) == 1:
        return _checked_value(name, value, Annotated[others[0], limits, expected], field)
    for arm in others:
        if _is_of_type(value, arm):
            return _checked_value(name, value, Annotated[arm, limits], field)
    words = " or ".join(_type_words(arm, None) for arm in others) if expected is None else expected.words
    raise unexpected(name, value, words, () if expected is None else expected.names())


def _is_of_type(value: Any, hint: Any) -> bool:
    """Whether a value is of a type, without a check of the range of its numbers."""
    origin = get_origin(hint)
    if origin is Annotated:
        return _is_of_type(value, get_args(hint)[0])
    if origin is Literal:
        return value in get_args(hint)
    if origin in (tuple, Sequence):
        kinds = get_args(hint)[:1] if origin is tuple else (object,)
        return isinstance(value, tuple | list) and all(_is_of_type(item, *kinds) for item in value)
    if hint in (int, float):
        return isinstance(value, int | float) and not isinstance(value, bool)
    if getattr(hint, "_is_protocol", False):
        return all(hasattr(value, member) for member in _members(hint))
    kinds = (hint, str) if hint is Path else (origin or hint,)
    return isinstance(value, kinds) or (dataclasses.is_dataclass(hint) and isinstance(value, Mapping))


def _members(protocol: Any) -> list[str]:
    """The members that an object needs to fulfill a protocol."""
    return [name for name in vars(protocol) if not name.startswith("_")] or ["__call__"]


def _checked_tuple(name: str, value: Any, arms: tuple[Any, ...], limits: Limits | None) -> tuple[Any, ...]:
    """A tuple of any or of a fixed length; a single string becomes a tuple of one."""
    any_length = len(arms) == 2 and arms[1] is Ellipsis
    items = (value,) if isinstance(value, str) and any_length else value
    check_type(name, items, (tuple, list), "a tuple" if any_length else f"{len(arms)} values")
    if not any_length and len(items) != len(arms):
        raise unexpected(name, value, f"{len(arms)} values")
    kinds = arms[:1] * len(items) if any_length else arms
    found = tuple(
        _checked_value(name, item, Annotated[kind, limits]) for item, kind in zip(items, kinds, strict=True)
    )
    if limits is not None and limits.ascends and list(found) != sorted(found):
        raise unexpected(name, value, "the smaller number first")
    return found


def _checked_number(name: str, value: Any, kind: type, limits: Limits | None) -> Any:
    if kind is int:
        if limits is None:
            check_type(name, value, int, "a whole number")
        else:
            check_count(name, value, int(limits.low), limits.high)
        return value
    bounds = Limits(-np.inf) if limits is None else limits
    check_number(name, value, bounds.low, bounds.high, above=bounds.above)
    return value


def _from_map(name: str, changes: Mapping[str, Any], kind: Any, field: dataclasses.Field[Any] | None) -> Any:
    """A group of settings from a mapping of the fields that differ from its default."""
    usual = None
    if field is not None and field.default_factory is not dataclasses.MISSING:
        usual = field.default_factory()
    return _changed(kind, usual if isinstance(usual, kind) else None, changes, f"setting of {name}")


def _changed(kind: Any, usual: Any, changes: Mapping[str, Any], noun: str) -> Any:
    """An object of settings, or the usual one of its class, with some fields given by name."""
    known = [field.name for field in dataclasses.fields(kind)]
    for name in changes:
        check_choice(name, known, noun=noun)
    changes = {name: tuple(value) if isinstance(value, list) else value for name, value in changes.items()}
    return kind(**changes) if usual is None else dataclasses.replace(usual, **changes)


def _type_words(kind: Any, expected: Expected | None) -> str:
    """How errors describe a type."""
    if expected is not None:
        return expected.words
    plain = {str: "a string", bool: "True or False", int: "a whole number", float: "a number", Path: "a path"}
    if kind in plain:
        return plain[kind]
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, get_args(kind)))}"
    name = getattr(kind, "__name__", str(kind))
    return f"{'an' if name[0] in 'AEIOU' else 'a'} {name}"
