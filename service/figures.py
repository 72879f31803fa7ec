"""Rate, rest and price of a backfill, from what the service tells at each look."""

from typing import Final

from schemas.api.status import ServiceStatus

HOUR_S: Final = 3600.0


class Figures:
    """What was seen so far. Times are seconds of any one clock."""

    def __init__(self, now_s: float) -> None:
        self._start_s = self._looked_s = now_s
        self.core_hours = 0.0

    def look(self, now_s: float, num_running: int, service: ServiceStatus) -> None:
        """Count what the CPUs of the service did since the last look, by the share that is ours of what runs now."""
        num_cpus = sum(dispatcher.num_workers for dispatcher in service.dispatchers if dispatcher.is_fresh)
        share = num_running / max(num_running, service.running_segments, 1)
        self.core_hours += num_cpus * share * (now_s - self._looked_s) / HOUR_S
        self._looked_s = now_s

    @property
    def elapsed_s(self) -> float:
        """From the beginning to the last look."""
        return self._looked_s - self._start_s

    def per_hour(self, num_ended: int) -> float | None:
        """Return the rate of segments that ended since the beginning; None: too early to tell."""
        return num_ended / self.elapsed_s * HOUR_S if num_ended and self.elapsed_s > 0 else None

    def eta_s(self, num_ended: int, num_left: int) -> float | None:
        """Return how long the rest takes at that rate."""
        rate = self.per_hour(num_ended)
        return None if rate is None else num_left / rate * HOUR_S

    def expected_core_hours(self, num_ended: int, num_left: int) -> float | None:
        """Return the price of all, at that of those that ended."""
        return self.core_hours * (1 + num_left / num_ended) if num_ended else None
