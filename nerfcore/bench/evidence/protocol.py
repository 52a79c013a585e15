"""The protocol as data (`protocol.toml`), and the trials it asks for."""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from ...errors import SettingError
from ..scenes import scene_name

FILE = Path(__file__).with_name("protocol.toml")
EVALUATION_SECONDS = 6.0  # for the estimate, of methods that the profile says nothing of
SECONDS_PER_RAY = {
    "quick": 0.004,
    "evening": 0.003,
    "cpu": 0.003,
    "gpu": 2e-5,
}  # for the estimate of trials that are to see so many rays


class Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SceneEntry(Part):
    held_out: str
    source: str


class Variant(Part):
    """A baseline by its name, or “ours” with settings changed. `labelled`: only for scenes with labels."""

    method: str
    title: str
    settings: dict[str, str] = {}
    labelled: bool = False
    baked: bool = False


class Table(Part):
    """Scenes × variants × noise at one budget: seconds, or rays."""

    name: Literal["time", "rays", "noise", "ablation", "extras"]
    scenes: list[str]
    variants: list[str]
    noise: list[float] = [0.0]
    seconds: float | None = None
    rays: int | None = None


class Profile(Part):
    """`clock`: “processor” counts the time of the processors, which other programs on the machine do not change.

    image_size: longest side of all pictures; held_out: how many held-out photos are compared, spread over all of them;
    rays: of a training step of a baseline, where step_rays does not say another number (grids count samples, 16 a ray);
    settings: of ours, in all its variants.
    """

    about: str
    clock: Literal["clock", "processor"]
    image_size: int
    held_out: int
    seeds: list[int] = Field(min_length=2)
    rays: int
    settings: dict[str, str] = {}
    step_rays: dict[str, int] = {}
    tables: list[Table]
    evaluation_seconds: dict[str, float] = {}


class Protocol(Part):
    scenes: dict[str, SceneEntry]
    variants: dict[str, Variant]
    profiles: dict[str, Profile]


class Trial(Part):
    """One training and what it is measured by; two tables that ask for the same share it."""

    scene: str
    variant: str
    method: str
    settings: dict[str, str]
    baked: bool
    noise: float
    seed: int
    seconds: float | None
    rays: int | None
    clock: str
    image_size: int
    held_out: int
    step_rays: int

    @property
    def budget(self) -> str:
        if self.rays:
            return f"{self.rays} rays"
        return f"{self.seconds:g} {'s of a processor' if self.clock == 'processor' else 's'}"

    @property
    def title(self) -> str:
        noise = f", noise {self.noise:g}" if self.noise else ""
        return f"{self.scene} {self.variant}{noise}, {self.budget}, seed {self.seed}"

    @property
    def name(self) -> str:
        """Name of its files: another one for each setting."""
        digest = hashlib.sha256(json.dumps(self.model_dump(mode="json"), sort_keys=True).encode()).hexdigest()[:6]
        return re.sub(r"[^\w.-]+", "-", f"{self.scene}-{self.variant}-{self.noise:g}-{self.seed}-{digest}")


@cache
def protocol() -> Protocol:
    return Protocol.model_validate(tomllib.loads(FILE.read_text(encoding="utf-8")))


def trials_of(
    profile: str,
    scenes: Sequence[str] | None = None,
    variants: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
    seconds: float | None = None,
    settings: dict[str, str] | None = None,
    tables: Sequence[str] | None = None,
) -> list[tuple[str, Trial]]:
    """(table, trial) of a profile, in its order; one trial may be of several tables.

    `scenes`: instead of those of the tables; `variants`: only these; `seconds`: of all trials limited by time;
    `settings`: of ours, after those of the profile; `tables`: only these.

    Raises:
        SettingError: there is no such variant or table.
    """
    known = protocol()
    plan = known.profiles[profile]
    for name in variants or []:
        if name not in known.variants:
            raise SettingError(f"The suite evidence has no variant “{name}”.", f"It has: {', '.join(known.variants)}.")
    there = [table.name for table in plan.tables]
    for name in tables or []:
        if name not in there:
            raise SettingError(f"The profile {profile} has no table “{name}”.", f"It has: {', '.join(there)}.")
    found = []
    for table in plan.tables:
        if tables is not None and table.name not in tables:
            continue
        chosen = [name for name in table.variants if variants is None or name in variants]
        named = [scene_name(scene) for scene in scenes or table.scenes]
        for scene, name, noise, seed in product(named, chosen, table.noise, seeds or plan.seeds):
            variant = known.variants[name]
            own = {**plan.settings, **(settings or {}), **variant.settings} if variant.method == "ours" else {}
            trial = Trial(
                scene=scene,
                variant=name,
                method=variant.method,
                settings=own,
                baked=variant.baked,
                noise=noise,
                seed=seed,
                seconds=None if table.seconds is None else seconds or table.seconds,
                rays=table.rays,
                clock=plan.clock,
                image_size=plan.image_size,
                held_out=plan.held_out,
                step_rays=plan.step_rays.get(name, plan.rays),
            )
            found.append((table.name, trial))
    return found


def expected_seconds(trial: Trial, profile: str) -> float:
    """How long a trial takes, roughly: training and comparing."""
    plan = protocol().profiles[profile]
    training = trial.seconds or (trial.rays or 0) * SECONDS_PER_RAY[profile]
    return training + plan.evaluation_seconds.get(trial.variant, EVALUATION_SECONDS)


def planned(trials: Sequence[Trial], profile: str, there: Sequence[bool]) -> list[str]:
    """The plan in lines for the user, with the time it will take."""
    lines = [f"{'there' if known else 'to do'}: {trial.title}" for trial, known in zip(trials, there)]
    left = sum(expected_seconds(trial, profile) for trial, known in zip(trials, there) if not known) / 60
    duration = f"{left:.0f} minutes" if left < 120 else f"{left / 60:.1f} hours"
    clock = (
        " of a processor, more where other programs run" if protocol().profiles[profile].clock == "processor" else ""
    )
    return [
        *lines,
        f"{len(trials) - sum(there)} of {len(trials)} trials to do, one after the other: about {duration}{clock}.",
    ]
