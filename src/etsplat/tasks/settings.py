"""What the settings of all tasks have in common: limits declared at the fields, one check, changes by name, files.

A config is a frozen dataclass over `Settings`. A field of it is a setting, with a docstring that becomes its help, or a
group of them, a frozen dataclass. A setting's name is dotted: "optimizer.lr_vertices". Imports no torch, since the
command line reads configs for its help.
"""

import difflib
import inspect
import math
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args, get_origin, get_type_hints

from etsplat.core.errors import InputError
from etsplat.io.json_text import parse_json
from etsplat.io.run_directory import FORMAT, KERNEL_FILE

Device = Literal["cpu", "cuda"]

SoftMethod = Literal["elastic", "bilateral", "single-sided"]
"""The kernels of soft triangles, as both tasks name them."""

AnySettings = TypeVar("AnySettings", bound="Settings")

_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a word", Path: "a path"}

_LARGEST = {int: 1e9, float: 1e30}
"""Of numbers that are not bounded otherwise: nobody counts further, and float32 holds what is computed from it."""


@dataclass(frozen=True)
class Range:
    """At a field: the least and the largest value that it may have, as in ``Annotated[float, Range(0, 1)]``."""

    low: float
    high: float = math.inf

    @property
    def text(self) -> str:
        """As it follows "it must be"."""
        if self.high < math.inf:
            return f"between {self.low:g} and {self.high:g}"
        return f"at least {self.low:g}" if self.low > -math.inf else "finite"


@dataclass(frozen=True)
class OneOf:
    """At a field of words: which there are by now, as more may be registered, and what a file that will do ends in."""

    names: Callable[[], tuple[str, ...]]
    suffix: str | None = None


@dataclass(frozen=True)
class Only:
    """At a field: the condition under which it has an effect; where it has none, it may not be changed.

    Attributes:
        words: the condition, as it follows "only"; or what gives it, where it spells an `option`.
        holds: for a whole config.
    """

    words: str | Callable[[], str]
    holds: Callable[[Any], bool]

    @property
    def text(self) -> str:
        """The condition in words."""
        return self.words if isinstance(self.words, str) else self.words()


class Rare:
    """At a field: ``--help`` leaves it out, and ``--help-all`` has it, as the settings in groups."""


@dataclass(frozen=True)
class Setting:
    """What a field declares.

    Attributes:
        kind: bool, int, float, str or Path.
        optional: whether it may be None.
        names: gives all values; none where any of its kind and range will do.
        range: of numbers.
        only: when it has an effect.
        suffix: of a file that will do instead of a word.
        default: of its class.
    """

    kind: type
    optional: bool
    names: Callable[[], tuple[Any, ...]]
    range: Range | None
    only: Only | None
    suffix: str | None
    default: Any

    @property
    def choices(self) -> tuple[Any, ...]:
        """The values that there are by now."""
        return self.names()

    def problem(self, value: Any) -> str | None:
        """What is wrong with a value, or None."""
        if value is None and self.optional:
            return None
        if choices := self.choices:
            if value in choices or (self.suffix and str(value).lower().endswith(self.suffix)):
                return None
            others = [*([None] if self.optional else []), *choices, *([f"FILE{self.suffix}"] if self.suffix else [])]
            return f"choose one of {', '.join(map(str, others))}"
        kinds = (int, float) if self.kind is float else self.kind
        if not isinstance(value, kinds) or isinstance(value, bool) != (self.kind is bool):
            return f"it must be {_KINDS[self.kind]}"
        if self.kind in _LARGEST and isinstance(value, int | float):
            limits = self.range or Range(-math.inf)
            if not limits.low <= value <= limits.high:
                return f"it must be {limits.text}"
            if limits.high == math.inf and not abs(value) <= _LARGEST[self.kind]:
                return f"it must be at most {_LARGEST[self.kind]:g}"
        return None

    def check(self, name: str, value: Any) -> None:
        """Raises InputError where there is a problem with a value."""
        if problem := self.problem(value):
            shown = repr(value) if isinstance(value, str) or self.choices else value
            raise InputError(f"{name}: is {shown}; {problem}")

    def read(self, text: str) -> Any:
        """The value that a text stands for; the text itself if it stands for none, of which `problem` complains."""
        if self.optional and text.lower() == "none":
            return None
        if self.kind is bool:
            return {"true": True, "false": False}.get(text.lower(), text)
        try:
            number = float(text) if self.kind is int else None
            return self.kind(text) if number is None or not number.is_integer() else int(number)
        except ValueError:
            return text


@dataclass(frozen=True)
class Settings:
    """Base of the configs: frozen dataclasses of settings and groups.

    Raises InputError where a setting is out of its range, is none of its choices, or would have no effect.
    """

    TASK: ClassVar[str] = ""
    """What a run with these settings is called in its config.json."""
    LABELS: ClassVar[tuple[str, ...]] = ()
    """Settings that others start from. The first is the preset: it is named before others are set, or not at all."""

    def __new__(cls: type[AnySettings], *_: Any, **given: Any) -> AnySettings:
        """Refuses a preset's name without the settings that it stands for."""
        if len(given) < len(fields(cls)):
            cls._check_preset(given, cls)
        return object.__new__(cls)

    def __post_init__(self) -> None:
        for name, kind in groups_of(type(self)).items():
            if not isinstance(getattr(self, name), kind):
                changed = f"{type(self).__name__}().changed({{{name!r}: {{...}}}}) takes some by name"
                raise InputError(f"{name}: is a group of settings, {kind.__name__}; {changed}")
        known = settings_of(type(self))
        for name, setting in known.items():
            value = get(self, name)
            if isinstance(value, str) and value not in setting.choices and "." not in name + value:
                value = value.replace("_", "-")  # single_sided, as the rasterizer has it
                object.__setattr__(self, name, value)
            setting.check(name, value)
        implied = self.implied_by(*(getattr(self, name) for name in self.LABELS))
        for name, setting in known.items():
            value = get(self, name)
            untouched = value in (setting.default, implied.get(name, setting.default))
            if setting.only and not untouched and not setting.only.holds(self):
                raise InputError(f"{name}: has an effect only {setting.only.text}; leave it out, or change that")
        if problem := self.contradiction():
            raise InputError(problem)

    @classmethod
    def of(cls: type[AnySettings], *labels: str) -> AnySettings:
        """The settings of a preset, and of the other labels of the class.

        Raises:
            InputError: there is none of that name.
        """
        labels += tuple(getattr(cls, name) for name in cls.LABELS[len(labels) :])
        named = dict(zip(cls.LABELS, labels, strict=True))
        for name, label in named.items():
            settings_of(cls)[name].check(name, label)
        return _replaced(cls(), {**cls.implied_by(*labels), **named}, "")

    @classmethod
    def implied_by(cls, *labels: str) -> Mapping[str, Any]:
        """The settings, by name, that differ from the class's defaults because of its labels; none for unknown ones."""
        return {}

    def contradiction(self) -> str | None:
        """What is wrong with settings that are right one by one."""
        return None

    @classmethod
    def based_on(cls: type[AnySettings], settings: Mapping[str, Any]) -> AnySettings:
        """The config that some settings are changes of: of the preset that they name, or the default one."""
        return cls.of(*(settings.get(name, getattr(cls, name)) for name in cls.LABELS))

    def changed(self: AnySettings, changes: Mapping[str, Any]) -> AnySettings:
        """The config with some settings changed.

        Args:
            changes: by dotted name, or with a mapping for a group: ``{"optimizer": {"lr_vertices": 5e-3}}``.

        Raises:
            InputError: there is no such setting, or its value cannot be used; `changes` is no mapping.
        """
        if not isinstance(changes, Mapping):
            raise InputError(f"changes: are of type {type(changes).__name__}; they must be values by name, as a dict")
        known, flat = settings_of(type(self)), flatten(changes)
        for name in flat:
            if any(other.startswith(f"{name}.") for other in known):
                raise InputError(f"{name}: is a group of settings; name one of them, with its value")
            if name not in known:
                raise InputError(f"{name}: is no setting{did_you_mean(name, known)}")
        self._check_preset(flat, self)
        return _replaced(self, {name: _typed(known[name], value) for name, value in flat.items()}, "")

    @classmethod
    def read_changes(cls, text: str) -> dict[str, Any]:
        """Changes, for `changed`, from a text such as "iterations=1000,start.limit=none".

        Raises:
            InputError: that is not how changes are written.
        """
        known, changes = settings_of(cls), {}
        for item in filter(None, text.split(",")):
            name, equals, value = item.partition("=")
            if not equals:
                raise InputError(f"{item}: is not a setting and its value; write NAME=VALUE,NAME=VALUE")
            changes[name] = known[name].read(value) if name in known else value
        return changes

    @classmethod
    def _check_preset(cls, given: Mapping[str, Any], present: object) -> None:
        """Refuses another preset than that present: its name would stand beside the other's settings."""
        for name in cls.LABELS[:1]:
            preset = given.get(name, getattr(present, name))
            if preset != getattr(present, name) and preset in settings_of(cls)[name].choices:
                others = (given.get(label, getattr(present, label)) for label in cls.LABELS[1:])
                start = f"{cls.__name__}.{preset}({', '.join(map(repr, others))})"
                raise InputError(f"{name}: {preset!r} stands for other settings too; begin with {start}")

    def to_dict(self) -> dict[str, Any]:
        """All settings as JSON has them, with a dictionary for each group."""
        return asdict(self, dict_factory=lambda items: {k: str(v) if isinstance(v, Path) else v for k, v in items})

    @classmethod
    def from_file(
        cls: type[AnySettings], path: str | Path, named: Mapping[str, str] = {}, given: Mapping[str, str] = {}
    ) -> AnySettings:
        """The settings of a run, from its config.json; or those of a JSON file with some of them.

        Such a file has the form of "config" in config.json. Settings that it lacks are those of the preset that it
        names, or of the default one.

        Args:
            path: of the file.
            named: the preset, where neither the file nor `given` name one.
            given: the preset that somebody asks for beside the file, which must not name another.

        Raises:
            InputError: it cannot be read, is of another kind of run, or has settings that there are not.
        """
        if (Path(path).parent / KERNEL_FILE).is_file():
            from etsplat.io.kernel_files import adopt_kernel_of  # imports torch

            adopt_kernel_of(Path(path).parent)
        found = _read(path, cls.TASK)
        for name, asked in given.items():
            if found.get(name, asked) != asked:
                raise InputError(f"{name}: {path} is of {name} {found[name]} already; leave one of them out")
        try:
            return cls.based_on({**named, **given, **found}).changed(found)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error


def _read(path: str | Path, task: str) -> dict[str, Any]:
    """What a file that `Settings.from_file` takes says, unchecked."""
    try:
        found = parse_json(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a run's config.json") from error
    except ValueError as error:
        raise InputError(f"{path}: is not JSON ({error}); name a run's config.json") from error
    if not isinstance(found, dict):
        raise InputError(f"{path}: holds no settings; name a run's config.json")
    if found.get("format") != FORMAT:
        return found
    if found.get("task") != task:
        raise InputError(f"{path}: has the settings of `etsplat {found.get('task')}`; name a run of `etsplat {task}`")
    if not isinstance(found.get("config"), dict):
        raise InputError(f"{path}: holds no settings; name a run's config.json")
    return found["config"]


@cache
def settings_of(kind: type) -> dict[str, Setting]:
    """All settings of a config class or group by their dotted names, in the order of the fields."""
    found: dict[str, Setting] = {}
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        hint = hints[field.name]
        if is_dataclass(hint):
            found |= {f"{field.name}.{name}": setting for name, setting in settings_of(hint).items()}
        else:
            found[field.name] = _setting(hint, field.default)
    return found


@cache
def groups_of(kind: type) -> dict[str, type]:
    """The groups of a config class by name, in the order of the fields."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in fields(kind) if is_dataclass(hints[field.name])}


def kernel_methods() -> tuple[str, ...]:
    """The methods of soft triangles: ours, and what was given to `register_kernel`, if anybody has imported that."""
    kernels = sys.modules.get("etsplat.core.kernels")
    registered = [name for name, kernel in kernels.KERNELS.items() if kernel.table is not None] if kernels else []
    return (*get_args(SoftMethod), *registered)


def training_engines() -> tuple[str, ...]:
    """The engines that have gradients; before anything of torch is imported, those that come with the package."""
    choice = sys.modules.get("etsplat.engines.choice")
    return ("reference", "cpu", "cuda") if choice is None else choice.training_engines()


def engine_names() -> tuple[str, ...]:
    """All engines; before anything of torch is imported, those that come with the package."""
    choice = sys.modules.get("etsplat.engines.choice")
    return (*training_engines(), "webgpu") if choice is None else choice.engine_names()


def docs_of(kind: type) -> dict[str, str]:
    """The docstrings of a class's fields, those that it inherits too."""
    import docstring_parser

    docs: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        found = docstring_parser.parse_from_object(base).params
        docs |= {entry.arg_name: inspect.cleandoc(entry.description or "") for entry in found}
    return docs


def get(config: object, name: str) -> Any:
    """The value of a setting, by its dotted name."""
    for part in name.split("."):
        config = getattr(config, part)
    return config


def flatten(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Nested settings by their dotted names."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            flat |= {f"{name}.{inner}": entry for inner, entry in flatten(value).items()}
        else:
            flat[name] = value
    return flat


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """For the end of an error: the name that was probably meant, if one is close, whichever group it is in."""
    names = list(known)
    last = {name.rpartition(".")[2]: name for name in reversed(names)}
    close = difflib.get_close_matches(word, names, 1) or [
        last[found] for found in difflib.get_close_matches(word.rpartition(".")[2], last, 1)
    ]
    return f"; did you mean {close[0]}?" if close else ""


def _setting(hint: Any, default: Any) -> Setting:
    extras: list[Any] = []
    if get_origin(hint) is Annotated:
        hint, *extras = get_args(hint)
    parts = get_args(hint)
    optional = NoneType in parts
    if optional:
        (hint,) = (part for part in parts if part is not NoneType)
    choices = get_args(hint) if get_origin(hint) is Literal else ()
    words = next((extra for extra in extras if isinstance(extra, OneOf)), OneOf(lambda: choices))
    limits = next((extra for extra in extras if isinstance(extra, Range)), None)
    only = next((extra for extra in extras if isinstance(extra, Only)), None)
    return Setting(type(choices[0]) if choices else hint, optional, words.names, limits, only, words.suffix, default)


def _typed(setting: Setting, value: Any) -> Any:
    """A value as its setting has it: of JSON, which has no paths and may have floats without a point, or of numpy."""
    if getattr(value, "shape", None) == ():
        value = value.item()
    if setting.kind is float and isinstance(value, int) and not isinstance(value, bool):
        with suppress(OverflowError):  # and then its check complains of the integer
            return float(value)
    return Path(value) if setting.kind is Path and isinstance(value, str) else value


def _replaced(group: Any, changes: Mapping[str, Any], prefix: str) -> Any:
    own = {}
    for field in fields(group):
        name, value = prefix + field.name, getattr(group, field.name)
        if is_dataclass(value) and any(change.startswith(f"{name}.") for change in changes):
            own[field.name] = _replaced(value, changes, f"{name}.")
        elif name in changes:
            own[field.name] = changes[name]
    return replace(group, **own)
