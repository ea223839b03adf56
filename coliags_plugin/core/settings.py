"""Base class of all typed settings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

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
        known = ", ".join(cls.model_fields) or "none"
        details = [
            InitErrorDetails(
                type=PydanticCustomError(
                    "unknown_key",
                    "unknown key '{key}'; known keys: {known}. {hint}",
                    {"key": str(key), "known": known, "hint": cls._meant(str(key), data)},
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


#: Settings of a component's base class.
SettingsT = TypeVar("SettingsT", bound=Settings, default=Any)


@contextmanager
def invalid_reported(place: str, expected: str = "", do: str = "") -> Iterator[None]:
    """Report the first problem that a validation in the block finds as an InputError, ``place`` before its key."""
    try:
        yield
    except ValidationError as error:
        first = error.errors()[0]
        key, value = ".".join(map(str, first["loc"])), first["input"]
        got = "" if isinstance(value, (dict, list, BaseModel)) else f" (got {value!r})"
        raise InputError(f"{place}{key or 'content'}: {first['msg']}{got}", expected, do) from error


def validated(kind: type[Model], values: Mapping[str, object], place: str, do: str = "") -> Model:
    """Settings of plain values by name; ``place`` is what messages call one of them, for instance ``mesh option``."""
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
