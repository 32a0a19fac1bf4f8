"""Settings of solar energy on roofs."""

from __future__ import annotations

from pipeline.parameters import Parameters, parameter


class SolarSettings(Parameters):
    """How far planes look, how often they are sampled, and what the air and the ground are like."""

    reach_m: float = parameter(
        100.0, "Buildings within this distance in plan shade a plane.", unit="m", minimum=0.0, maximum=2000.0
    )
    samples: int = parameter(16, "About so many points of each plane look at the sky.", minimum=1, maximum=1000)
    albedo: float = parameter(0.2, "Share of the light that the ground reflects.", minimum=0.0, maximum=1.0)
    linke_turbidity: float | None = parameter(
        None, "Haze of the clear sky, all year; without it the monthly map of pvlib.", minimum=1.0, maximum=10.0
    )

    def cross_faults(self) -> list[str]:
        """The range of the turbidity, which has no default to take its type from."""
        value = self.linke_turbidity
        if value is not None and not 1.0 <= value <= 10.0:
            return [f"linke_turbidity is {value:g}: use 1 to 10"]
        return []
