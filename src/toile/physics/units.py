"""Network units of the paper (section 3.1.3) and SI.

In network units an interior vertex weighs 1, an edge is 1 long and a step takes 1. With m the interior mass
[kg], L the grid spacing [m] and Δt the step [s], forces scale by m L / Δt², energies by m L² / Δt².
"""

from __future__ import annotations

from dataclasses import dataclass

# The published fit takes every video frame as 0.02 s. Stiffnesses are quoted at this time unit whatever the
# frame rate of a video, so that the same number is the same fabric [s].
PAPER_TIME_STEP = 0.02


@dataclass(frozen=True)
class NetworkUnits:
    """Conversion between network units and SI for one cloth and one time step.

    Attributes:
        mass: interior vertex mass [kg].
        length: grid spacing [m].
        time: time unit [s]; PAPER_TIME_STEP wherever stiffnesses are reported.
    """

    mass: float
    length: float
    time: float

    @property
    def stretching(self) -> float:
        """N/m per network unit of Y."""
        return self.mass / self.time**2

    @property
    def energy(self) -> float:
        """N·m per network unit of S, B and any other energy."""
        return self.mass * self.length**2 / self.time**2

    def of(self, unit: str) -> float:
        """SI per network unit of a quantity with that SI unit.

        Raises:
            KeyError: no such quantity has network units.
        """
        return {"N/m": self.stretching, "N·m": self.energy, "N": self.force, "": 1.0}[unit]

    @property
    def force(self) -> float:
        """N per network unit of force."""
        return self.mass * self.length / self.time**2
