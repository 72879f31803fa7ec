from datetime import UTC, datetime

import pytest

from schemas.api.jobs import JobState
from schemas.api.status import MAX_SILENCE_S, DispatcherStatus, ServiceStatus
from service.figures import Figures


def service(num_running, *workers, silent=0):
    """A service whose dispatchers have that many CPUs; ``silent`` ones belong to one that is gone."""
    dispatchers = [
        DispatcherStatus(
            id="d",
            host="h",
            pid=1,
            code_version="1",
            num_workers=number,
            started_at=datetime.now(UTC),
            heartbeat_age_s=age_s,
        )
        for number, age_s in [*((number, 0.0) for number in workers), (silent, MAX_SILENCE_S)]
    ]
    return ServiceStatus(
        jobs=dict.fromkeys(JobState, 0),
        queued_segments=0,
        running_segments=num_running,
        oldest_queued_age_s=None,
        running_by_stage={},
        segments_per_hour=0,
        sweeps_per_hour=0,
        failures_by_error={},
        dispatchers=tuple(dispatchers),
    )


def test_the_price_is_cpus_by_time_by_share():
    figures = Figures(1000.0)
    figures.look(1000.0 + 1800, 3, service(3, 8, 4))  # half an hour of 12 CPUs, all ours
    assert figures.core_hours == pytest.approx(6)
    figures.look(1000.0 + 5400, 1, service(4, 8, 4))  # an hour, a quarter ours
    assert figures.core_hours == pytest.approx(9)
    figures.look(1000.0 + 9000, 0, service(5, 8))
    figures.look(1000.0 + 9900, 2, service(2, silent=64))
    assert figures.core_hours == pytest.approx(9)
    assert figures.elapsed_s == 9900


def test_a_count_that_lags_behind_is_no_more_than_all():
    figures = Figures(0.0)
    figures.look(3600.0, 5, service(4, 2))
    assert figures.core_hours == pytest.approx(2)


def test_rate_rest_and_expected_price_follow_from_what_ended():
    figures = Figures(0.0)
    figures.look(7200.0, 1, service(1, 10))
    assert figures.per_hour(4) == pytest.approx(2)
    assert figures.eta_s(4, 6) == pytest.approx(3 * 3600)
    assert figures.expected_core_hours(4, 6) == pytest.approx(50)
    assert figures.expected_core_hours(4, 0) == figures.core_hours == pytest.approx(20)


def test_nothing_is_made_up_before_anything_ended():
    figures = Figures(0.0)
    assert figures.per_hour(3) is None  # no time has passed
    figures.look(60.0, 1, service(1, 10))
    assert figures.per_hour(0) is figures.eta_s(0, 5) is figures.expected_core_hours(0, 5) is None
