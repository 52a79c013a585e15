"""What the presets mean, and the ladder of harder attempts when photos stay without a pose."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Level:
    """Settings of one attempt.

    `size` is the long side at which features are found, `features` their number, `octave` SIFT's first octave (−1
    doubles the picture), `affine` adds affine shape and domain-size pooling, `exhaustive` matches all pairs; `joined`
    means that affine features of some photos were added to these.
    """

    name: str
    size: int = 1600
    features: int = 4096
    octave: int = 0
    affine: bool = False
    exhaustive: bool = False
    joined: bool = False

    @property
    def database(self) -> str:
        """Attempts with the same features share one database."""
        kind = ("_affine" if self.affine else "") + ("_joined" if self.joined else "")
        return f"features_{self.size}_{self.features}_{self.octave}{kind}.db"


FAST = Level("fast", size=1000, features=2048)
STANDARD = Level("standard")
MORE_PAIRS = Level("all pairs", exhaustive=True)
MORE_FEATURES = Level("more features", features=8192, octave=-1, exhaustive=True)
AFFINE = replace(MORE_FEATURES, name="affine features", affine=True)

# The first entry always runs; the next ones only while too few photos have a pose.
LADDERS: dict[str, tuple[Level, ...]] = {
    "fast": (FAST, replace(FAST, name="all pairs", exhaustive=True), MORE_FEATURES),
    "standard": (STANDARD, MORE_PAIRS, MORE_FEATURES, AFFINE),
    "robust": (MORE_FEATURES, AFFINE),
}
# Sizes, numbers of features and limits: docs/experiments.md, “What the pose stage was made of”; not tuned further.
ENOUGH = 0.9  # share of photos with a pose at which the climbing stops
EXHAUSTIVE_UP_TO = 40  # photos; beyond, pairs are chosen by retrieval
EXHAUSTIVE_AT_MOST = 250  # photos; more pairs than that take hours even as a last resort
