"""Typed settings: the base class of every component's options."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from coliags_plugin.errors import did_you_mean


class Settings(BaseModel):
    """Frozen, strictly typed options; an unknown key is an error that names the nearest known one.

    Sequences are tuples (YAML lists are converted before they arrive here).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, arbitrary_types_allowed=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        unknown = [key for key in data if key not in cls.model_fields]
        if unknown:
            known = ", ".join(cls.model_fields) or "none"
            raise ValidationError.from_exception_data(
                cls.__name__,
                [
                    InitErrorDetails(
                        type=PydanticCustomError(
                            "unknown_key",
                            "unknown key '{key}'; known keys: {known}. {hint}",
                            {
                                "key": str(key),
                                "known": known,
                                "hint": did_you_mean(str(key), cls.model_fields),
                            },
                        ),
                        loc=(key,),
                        input=data[key],
                    )
                    for key in unknown
                ],
            )
        return data
