"""What the verbs of instances and relations are asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from .base import Params, RunName


class InstancesParams(Params):
    project: Path
    run: RunName = "main"
    rename: list[str] = Field(default=[], description="OLD and NEW: give the instance OLD the name NEW")
    merge: list[str] = Field(default=[], description="names of instances of one class that are one thing")
    split: str = Field(
        default="", max_length=200, description="instance whose unconnected pieces are things of their own"
    )

    @model_validator(mode="after")
    def _one_change(self) -> Self:
        if bool(self.rename) + bool(self.merge) + bool(self.split) > 1:
            raise ValueError("give one of rename, merge and split")
        if self.rename and len(self.rename) != 2:
            raise ValueError(
                "rename takes an old and a new name: one with a comma in it stands in quotes, as in '\"a, b\",c'"
            )
        return self


class RelationsParams(Params):
    project: Path
    run: RunName = "main"
    query: str = Field(
        default="", max_length=500, description="question to answer: “everything on the table”, “vase next to wall.001”"
    )
