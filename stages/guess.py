"""The material as the configuration states it: where learning starts, and what a scene without a recording moves by."""

from dataclasses import dataclass

from physics3d.log import Log
from physics3d.world import Estimate, World


@dataclass(frozen=True, kw_only=True)
class Guess:
    """The configured parameters as an estimate, nothing learned."""

    world: World

    def __call__(self, *, log: Log) -> Estimate:
        """Raises ValueError if a parameter is impossible."""
        return self.world.estimate()
