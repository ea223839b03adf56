"""Base class of all typed settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Generic, get_args

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError
from typing_extensions import TypeVar

from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.core.json_files import read_json

Model = TypeVar("Model", bound=BaseModel)


class Settings(BaseModel):
    """Frozen, strictly typed options; an unknown key is an error that names the nearest known one.

    Sequences are tuples (YAML lists are converted before they arrive here).
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, arbitrary_types_allowed=True
    )

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, data: object) -> object:
        if not isinstance(data, dict):
            return data
        names = ", ".join(cls.model_fields) or "none"
        details = [
            InitErrorDetails(
                type=PydanticCustomError(
                    "unknown_key",
                    "unknown key '{key}'; known keys: {known}. {hint}",
                    {"key": str(key), "known": names, "hint": cls._meant(str(key), data)},
                ),
                loc=(key,),
                input=value,
            )
            for key, value in data.items()
            if key not in cls.model_fields
        ]
        if details:
            raise ValidationError.from_exception_data(cls.__name__, details)
        return data

    @classmethod
    def _meant(cls, key: str, data: Mapping[str, object]) -> str:
        """The hint at an unknown key of some data."""
        return did_you_mean(key, cls.model_fields)


#: Learning rates by parameter group: options of ``optimizers`` in method configs, the rate ``lr`` among them.
Rates = Mapping[str, Mapping[str, Any]]
#: Settings of a component's base class.
SettingsT = TypeVar("SettingsT", bound=Settings, default=Any)


class Configurable(Generic[SettingsT]):
    """Base class of what has options: ``class EdgesLoss(Loss[EdgesSettings])`` names their class, ``Settings``."""

    Settings: ClassVar[type[Settings]]
    #: Default learning rates of a component that learns.
    rates: ClassVar[Rates] = {}
    settings: SettingsT

    def __init_subclass__(cls, **options: object) -> None:
        """Take ``Settings`` from the brackets behind a base class, unless the class sets them itself."""
        super().__init_subclass__(**options)
        for base in vars(cls).get("__orig_bases__", ()):
            for argument in get_args(base):
                if "Settings" not in vars(cls) and isinstance(argument, type) and issubclass(argument, Settings):
                    cls.Settings = argument


#: Types of the errors whose messages are this package's own, and say all.
_TELLING = frozenset({"no_name", "unknown_key", "unknown_component", "no_settings", "value_error", "zero_end"})


@contextmanager
def invalid_reported(
    place: str | Callable[[Sequence[object]], str], expected: str = "", do: str = "", content: str = "content"
) -> Iterator[None]:
    """Report what a validation in the block refuses as an InputError.

    Args:
        place: Text before the key that is wrong, of which the first is reported; or a function from the path of a key
            to that text, as for configs, of which all are.
        expected: What would be valid.
        do: What the user can do.
        content: What the whole is called, where no key is to blame.
    """
    try:
        yield
    except ValidationError as error:
        items = error.errors()
        if isinstance(place, str):
            lines = [f"{place}{_problem(items[0], content)}"]
        else:
            lines = [f"{place(item['loc'])}{_problem(item, content)}" for item in items]
        raise InputError("\n".join(lines), expected, do) from error


def _problem(item: Mapping[str, Any], content: str) -> str:
    """A key and what is wrong with its value."""
    key, value = ".".join(map(str, item["loc"])), item["input"]
    message = item["msg"].removeprefix("Value error, ").strip()
    if item["type"] == "missing":
        message = "is missing"
    elif item["type"] not in _TELLING and not isinstance(value, (dict, list, BaseModel)):
        message = f"{message}, got {value!r}"
    return f"{key or content}: {message}"


def validated(kind: type[Model], values: Mapping[str, object], place: str, do: str = "") -> Model:
    """Settings of plain values by name; ``place`` is what messages call one of them, for instance ``lamp option``."""
    with invalid_reported(f"{place} ", do=do):
        return kind.model_validate(dict(values))


def read_validated(kind: type[Model], file: Path, expected: str) -> Model:
    """Read a JSON file as a model, strictly; InputError names the file and the key that is wrong."""
    with invalid_reported(f"{file}: ", expected):
        return kind.model_validate(read_json(file, expected), strict=True)


def refuse_zero_ends(settings: Settings, start: str, end: str) -> None:
    """Refuse a logarithmic schedule with an end that is not above 0 (docs/methods.md 2.3), at the key to blame.

    ``start`` and ``end`` name the values at the first and the last step; without a value at ``end`` there is no
    schedule.
    """
    first, last = getattr(settings, start), getattr(settings, end)
    if last is None or (first > 0 and last > 0):
        return
    problem = PydanticCustomError(
        "zero_end",
        "{end} {last} with {start} {first}: a logarithmic schedule cannot reach or leave 0; give both above 0, or "
        "leave {end} out (null) for a constant {start}",
        {"start": start, "first": str(first), "end": end, "last": str(last)},
    )
    key, value = (start, first) if last > 0 else (end, last)
    raise ValidationError.from_exception_data(
        type(settings).__name__, [InitErrorDetails(type=problem, loc=(key,), input=value)]
    )
